//! Turned and cropped frames: the stored pixel of each pixel of the result.

use crate::description::{Crop, Orientation};
use qudi_core::Size;
use qudi_core::colour::MosaicPlane;
use qudi_core::{Error, Result};

/// A turned and cropped frame.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct View {
    pub(crate) size: Size,
    /// Stored pixel of each pixel; `None` if they are the same.
    pub(crate) from: Option<Vec<u32>>,
}

impl View {
    /// Creates the view. `vendor` is the meaning of [`Orientation::Vendor`] for this format; of a mosaic,
    /// only the pixels of `plane` are seen.
    pub(crate) fn new(
        stored: Size,
        plane: Option<MosaicPlane>,
        orient: Orientation,
        vendor: Orientation,
        crop: Option<Crop>,
    ) -> Result<Self> {
        let orient = if orient == Orientation::Vendor { vendor } else { orient };
        let whole = MosaicPlane { step: 1, row: 0, column: 0 };
        let MosaicPlane { step, row: top, column: left } = plane.unwrap_or(whole);
        if stored.height < step || stored.width < step {
            return Err(Error::request(
                format!("a mosaic in frames of {stored}"),
                "cfa",
                "leave it out: the frames are smaller than a tile",
            ));
        }
        // Whole tiles, so that all planes have one size.
        let columns = stored.width;
        let stored = Size { height: stored.height / step, width: stored.width / step };
        let quarter =
            matches!(orient, Orientation::Rot90 | Orientation::Rot270 | Orientation::Transpose);
        let turned =
            if quarter { Size { height: stored.width, width: stored.height } } else { stored };
        let crop =
            crop.unwrap_or(Crop { top: 0, bottom: turned.height, left: 0, right: turned.width });
        if crop.bottom > turned.height || crop.right > turned.width {
            return Err(Error::request(
                format!("rows and columns {crop} of a frame of {turned}"),
                "crop",
                "the crop applies to the turned frame, and ends inside it",
            ));
        }
        let size = Size { height: crop.bottom - crop.top, width: crop.right - crop.left };
        if size == stored && step == 1 && matches!(orient, Orientation::Raw | Orientation::Vendor) {
            return Ok(Self { size, from: None });
        }
        let (last_row, last_column) = (stored.height - 1, stored.width - 1);
        let mut from = Vec::with_capacity(size.pixels());
        for y in crop.top..crop.bottom {
            for x in crop.left..crop.right {
                let (row, column) = match orient {
                    Orientation::Raw | Orientation::Vendor => (y, x),
                    Orientation::Rot90 => (x, last_column - y),
                    Orientation::Rot180 => (last_row - y, last_column - x),
                    Orientation::Rot270 => (last_row - x, y),
                    Orientation::FlipH => (y, last_column - x),
                    Orientation::FlipV => (last_row - y, x),
                    Orientation::Transpose => (x, y),
                };
                from.push(((row * step + top) * columns + column * step + left) as u32);
            }
        }
        Ok(Self { size, from: Some(from) })
    }

    /// Applies the view to a stored image.
    pub(crate) fn apply<T: Copy>(&self, stored: &[T], out: &mut [T]) {
        match &self.from {
            None => out.copy_from_slice(stored),
            Some(from) => {
                for (pixel, &i) in out.iter_mut().zip(from) {
                    *pixel = stored[i as usize];
                }
            }
        }
    }
}

impl View {
    /// Puts an image in use back to where its pixels are stored; all other pixels are `outside`.
    pub(crate) fn stored<T: Copy>(&self, image: &[T], stored: Size, outside: T) -> Vec<T> {
        let mut out = vec![outside; stored.pixels()];
        match &self.from {
            None => out.copy_from_slice(image),
            Some(from) => from.iter().zip(image).for_each(|(&i, &pixel)| out[i as usize] = pixel),
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turn(orient: Orientation, crop: Option<&str>) -> Vec<Vec<u8>> {
        let stored = Size { height: 2, width: 3 };
        let crop = crop.map(|text| text.parse().unwrap());
        let view = View::new(stored, None, orient, Orientation::Rot90, crop).unwrap();
        let mut out = vec![0; view.size.pixels()];
        view.apply(b"abcdef", &mut out);
        out.chunks(view.size.width).map(<[u8]>::to_vec).collect()
    }

    /// In NumPy, rot90([[a,b,c],[d,e,f]]) is [[c,f],[b,e],[a,d]].
    #[test]
    fn quarter_turns_match_numpy() {
        assert_eq!(turn(Orientation::Raw, None), [b"abc", b"def"]);
        assert_eq!(turn(Orientation::Rot90, None), [b"cf", b"be", b"ad"]);
        assert_eq!(turn(Orientation::Vendor, None), [b"cf", b"be", b"ad"]);
        assert_eq!(turn(Orientation::Rot180, None), [b"fed", b"cba"]);
        assert_eq!(turn(Orientation::Rot270, None), [b"da", b"eb", b"fc"]);
        assert_eq!(turn(Orientation::FlipH, None), [b"cba", b"fed"]);
        assert_eq!(turn(Orientation::FlipV, None), [b"def", b"abc"]);
        assert_eq!(turn(Orientation::Transpose, None), [b"ad", b"be", b"cf"]);
    }

    #[test]
    fn a_plane_of_a_mosaic_is_taken_before_turning() {
        let stored = Size { height: 4, width: 5 };
        let plane = Some(MosaicPlane { step: 2, row: 1, column: 0 });
        let view = View::new(stored, plane, Orientation::FlipH, Orientation::Raw, None).unwrap();
        assert_eq!((view.size.height, view.size.width), (2, 2));
        let mut out = [0; 4];
        view.apply(b"abcdefghijklmnopqrst", &mut out);
        assert_eq!(&out, b"hfrp");
        let small = Size { height: 1, width: 5 };
        assert!(View::new(small, plane, Orientation::Raw, Orientation::Raw, None).is_err());
    }

    #[test]
    fn crops_the_turned_frame() {
        assert_eq!(turn(Orientation::Rot90, Some("1:3,0:1")), [b"b", b"a"]);
        assert_eq!(turn(Orientation::Raw, Some("0:2,1:3")), [b"bc", b"ef"]);
        let stored = Size { height: 2, width: 3 };
        let outside = Some("0:3,0:3".parse().unwrap());
        assert!(View::new(stored, None, Orientation::Raw, Orientation::Raw, outside).is_err());
        assert!("3:1,0:2".parse::<Crop>().is_err() && "1:2".parse::<Crop>().is_err());
    }
}
