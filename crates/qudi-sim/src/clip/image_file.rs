//! PNG, JPEG and TIFF images as gray frames.

use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, Limits};
use qudi_core::Transfer;
use qudi_core::limits::IMAGE_PIXELS;
use qudi_core::regular_file::open_regular;
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size};
use std::io::BufReader;
use std::path::Path;

/// Extensions of image files.
pub(super) const EXTENSIONS: &[&str] = &["png", "jpg", "jpeg", "tif", "tiff"];

/// Returns true for a file whose name ends like an image's.
pub fn is_image(path: &Path) -> bool {
    has_image_name(path) && path.is_file()
}

/// Returns true if the name ends like an image file's, whatever it is.
pub(super) fn has_image_name(path: &Path) -> bool {
    let known = |e: &std::ffi::OsStr| EXTENSIONS.iter().any(|known| e.eq_ignore_ascii_case(known));
    path.extension().is_some_and(known)
}

/// Reads one image as gray values in [0, 1]; an alpha channel is ignored.
///
/// # Errors
/// [`Error`] if it cannot be read, is damaged, or is too large.
pub fn read_still(path: &Path, transfer: Transfer) -> Result<Frame> {
    Ok(read_scaled(path, transfer, None)?.0)
}

/// Reads one image as gray values, of which `white` becomes 1, with the white that was assumed.
///
/// # Errors
/// As [`read_still`].
pub(super) fn read_scaled(
    path: &Path,
    transfer: Transfer,
    white: Option<f32>,
) -> Result<(Frame, AssumedWhite)> {
    to_gray(decode_image(path, IMAGE_PIXELS)?, path, transfer, white)
}

/// White of samples of more than 8 bits where nobody says it: the full scale of their type, which 10, 12 or
/// 14 bits stored in 16 do not reach.
pub type AssumedWhite = Option<f32>;

/// Decodes one image of at most `pixels` pixels, turned as its metadata say.
///
/// # Errors
/// [`Error`] if it cannot be read, is damaged, or is too large.
pub fn decode_image(path: &Path, pixels: u64) -> Result<DynamicImage> {
    let file = BufReader::new(open_regular(path, "open the image")?);
    let guessed = ImageReader::new(file).with_guessed_format();
    let reader = guessed.map_err(|e| Error::io("open the image", path, e))?;
    // A few kilobytes can decode to gigabytes of pixels: the size in the header is checked first.
    let mut decoder = reader.into_decoder().map_err(|e| unreadable(e, path))?;
    let (width, height) = decoder.dimensions();
    if u64::from(width) * u64::from(height) > pixels {
        return Err(Error::data(
            format!("an image of {height} x {width} pixels is over the limit of {pixels} pixels"),
            path,
            "cut it into smaller images",
        ));
    }
    let most = Limits::default().max_alloc.unwrap_or(u64::MAX);
    if decoder.total_bytes() > most {
        return Err(Error::data(
            format!("an image of {} bytes is over the limit of {most}", decoder.total_bytes()),
            path,
            "cut it into smaller images, or save it with fewer channels",
        ));
    }
    let orientation = decoder.orientation().map_err(|e| unreadable(e, path))?;
    let mut image = DynamicImage::from_decoder(decoder).map_err(|e| unreadable(e, path))?;
    image.apply_orientation(orientation);
    Ok(image)
}

/// Creates the error for an image that cannot be decoded.
fn unreadable(e: ImageError, path: &Path) -> Error {
    match e {
        ImageError::IoError(e) if e.kind() != std::io::ErrorKind::UnexpectedEof => {
            Error::io("read the image", path, e)
        }
        other => Error::data(
            format!("not a readable image: {other}"),
            path,
            "open it in a viewer to see whether it is damaged, and save it again as PNG",
        ),
    }
}

/// The way from the samples of pixels to gray values.
struct Gray {
    channels: usize,
    /// Channels that are no opacity.
    colours: usize,
    white: f32,
    transfer: Transfer,
}

impl Gray {
    fn values<T: Copy + Into<f32>>(&self, samples: &[T]) -> Vec<f32> {
        let value = |pixel: &[T]| {
            let of = |channel: usize| pixel[channel].into() / self.white;
            match self.colours {
                1 => self.transfer.decode(of(0)),
                _ => self.transfer.gray([of(0), of(1), of(2)]),
            }
        };
        samples.chunks_exact(self.channels).map(value).collect()
    }
}

fn to_gray(
    image: DynamicImage,
    path: &Path,
    transfer: Transfer,
    white: Option<f32>,
) -> Result<(Frame, AssumedWhite)> {
    let size =
        Size::new(image.height() as usize, image.width() as usize, &path.display().to_string())?;
    let deep = matches!(
        image,
        DynamicImage::ImageLuma16(_)
            | DynamicImage::ImageLumaA16(_)
            | DynamicImage::ImageRgb16(_)
            | DynamicImage::ImageRgba16(_)
    );
    let assumed = (deep && white.is_none()).then_some(65535.0);
    let channels = usize::from(image.color().channel_count());
    let colours = channels - usize::from(image.color().has_alpha());
    let of = |full: f32| Gray { channels, colours, white: white.unwrap_or(full), transfer };
    let data = match &image {
        DynamicImage::ImageLuma8(_)
        | DynamicImage::ImageLumaA8(_)
        | DynamicImage::ImageRgb8(_)
        | DynamicImage::ImageRgba8(_) => of(255.0).values(image.as_bytes()),
        DynamicImage::ImageLuma16(i) => of(65535.0).values(i.as_raw()),
        DynamicImage::ImageLumaA16(i) => of(65535.0).values(i.as_raw()),
        DynamicImage::ImageRgb16(i) => of(65535.0).values(i.as_raw()),
        DynamicImage::ImageRgba16(i) => of(65535.0).values(i.as_raw()),
        DynamicImage::ImageRgb32F(i) => of(1.0).values(i.as_raw()),
        DynamicImage::ImageRgba32F(i) => of(1.0).values(i.as_raw()),
        other => {
            return Err(Error::data(
                format!("an image of unsupported type {:?}", other.color()),
                path,
                "save it as 8- or 16-bit gray or RGB",
            ));
        }
    };
    check_values(&data, path)?;
    Ok((Frame { size, data }, assumed))
}

/// Checks that floating-point values are in [0, 1], as in all scenes.
pub(super) fn check_values(data: &[f32], path: &Path) -> Result<()> {
    let Some(bad) = data.iter().find(|v| !(0.0..=1.0).contains(*v)) else { return Ok(()) };
    Err(Error::data(
        format!("a value of {bad}, where scenes lie between 0 (black) and 1 (white)"),
        path,
        "replace missing values; for other scales give the value of white, such as 255",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates a PNG whose header claims `side` x `side` gray pixels, without any.
    fn empty_png(side: u32) -> Vec<u8> {
        let mut header = b"IHDR".to_vec();
        header.extend(side.to_be_bytes());
        header.extend(side.to_be_bytes());
        header.extend([8, 0, 0, 0, 0]);
        let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
        for chunk in [header.as_slice(), b"IDAT"] {
            png.extend((chunk.len() as u32 - 4).to_be_bytes());
            png.extend(chunk);
            png.extend(crc32fast::hash(chunk).to_be_bytes());
        }
        png
    }

    #[test]
    fn refuses_images_of_too_many_pixels_before_decoding() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bomb.png");
        std::fs::write(&path, empty_png(20_000)).unwrap();
        let error = decode_image(&path, IMAGE_PIXELS).unwrap_err().to_string();
        assert!(error.contains("over the limit of 67108864 pixels"), "{error}");
        std::fs::write(&path, empty_png(20)).unwrap();
        assert!(
            decode_image(&path, IMAGE_PIXELS)
                .unwrap_err()
                .to_string()
                .contains("not a readable image")
        );
    }

    /// EXIF orientation 6: the first row of the picture is the right column of what is stored.
    #[test]
    fn turns_images_as_their_metadata_say() {
        let stored = image::RgbImage::from_fn(16, 8, |x, _| image::Rgb([16 * x as u8; 3]));
        let mut jpeg = Vec::new();
        let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 100);
        stored.write_with_encoder(encoder).unwrap();
        let mut exif = b"\xff\xe1\x00\x22Exif\0\0MM\0\x2a\0\0\0\x08\0\x01".to_vec();
        exif.extend(b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0");
        jpeg.splice(2..2, exif);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        std::fs::write(&path, jpeg).unwrap();
        let frame = read_still(&path, Transfer::AsIs).unwrap();
        assert_eq!(frame.size, Size { height: 16, width: 8 });
        assert!(frame.data[0] < 0.05 && frame.data[15 * 8] > 0.9, "dark above, bright below");
    }

    #[cfg(unix)]
    #[test]
    fn refuses_devices() {
        let error = decode_image(Path::new("/dev/zero"), 9).unwrap_err().to_string();
        assert_eq!(error, "cannot open the image: not a regular file");
    }
}
