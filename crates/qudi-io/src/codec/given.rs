//! Arrays that a caller holds, in memory or wherever it fetches frames from.

use super::array::{Array, Hints, Place};
use super::{ARRAY_OPTIONS, refuse_others};
use crate::description::{Axes, CaptureInfo, ReadOptions};
use crate::frames::CountFrames;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use std::path::{Path, PathBuf};

/// A function that returns the bytes of the frames from the first number on, as many as the second number.
pub type FetchFrames = Box<dyn FnMut(u64, u64) -> Result<Vec<u8>> + Send>;

/// An array of frames, whose first axis is time.
pub struct GivenArray {
    /// Name in messages.
    pub name: String,
    /// Type of its samples.
    pub sample: Sample,
    /// Its extents, frames first.
    pub shape: Vec<usize>,
    /// Fetches frames, in C order.
    pub fetch: FetchFrames,
}

impl std::fmt::Debug for GivenArray {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("GivenArray")
            .field("name", &self.name)
            .field("sample", &self.sample)
            .field("shape", &self.shape)
            .finish_non_exhaustive()
    }
}

impl GivenArray {
    /// Opens its frames.
    pub(crate) fn open(self, options: &ReadOptions) -> Result<(Box<dyn CountFrames>, CaptureInfo)> {
        let mut info = CaptureInfo::new("array", "array in memory");
        let options = &options.of_container(options.cfa.is_some());
        if let Some(name) = &options.format {
            return Err(Error::request(
                format!("an array has no format `{name}`"),
                "format",
                "leave it out: its samples are described by their type",
            ));
        }
        refuse_others(options, ARRAY_OPTIONS, "an array")?;
        if !matches!(options.axes.unwrap_or_default(), Axes::Thw | Axes::Twh) {
            return Err(Error::request(
                "frames of arrays in memory come one after the other",
                "axes",
                "move the axis of time to the front",
            ));
        }
        // An array of two axes is a single frame.
        let rows = if self.shape.len() == 2 { self.shape[0] } else { 1 };
        let frame = rows.checked_mul(self.sample.bytes());
        let extents = self.shape.iter().skip(1);
        let bytes = extents.fold(frame, |bytes, &extent| bytes?.checked_mul(extent));
        let (path, mut fetch) = (PathBuf::from(self.name), self.fetch);
        let name = path.clone();
        let fetch = move |first: u64, count: u64| {
            let fetched = fetch(first * rows as u64, count * rows as u64)?;
            let expected = bytes.and_then(|bytes| bytes.checked_mul(count as usize));
            if expected == Some(fetched.len()) { Ok(fetched) } else { Err(changed(&name)) }
        };
        let array = Array {
            path,
            sample: self.sample,
            shape: self.shape,
            fortran: false,
            axes: Axes::Thw,
            place: Place::Fetch { fetch: Box::new(fetch), group: 1 },
        };
        let frames = array.open(options, &Hints::default(), &mut info)?;
        Ok((frames, info))
    }
}

fn changed(path: &Path) -> Error {
    Error::data(
        "its frames are not as large as its shape says",
        path,
        "do not change the array while it is read",
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Capture;

    fn array(shape: &[usize], fetch: FetchFrames) -> GivenArray {
        GivenArray { name: "array".to_owned(), sample: Sample::U8, shape: shape.to_vec(), fetch }
    }

    #[test]
    fn frames_are_fetched_when_they_are_read() {
        let frame = |t: u64| (0..64 * 64u64).map(move |i| ((i + t) % 5) as u8);
        let fetch = Box::new(move |first: u64, count: u64| {
            Ok((first..first + count).flat_map(frame).collect())
        });
        let array = array(&[3, 64, 64], fetch);
        let mut capture = Capture::from_array(array, &ReadOptions::default(), None).unwrap();
        let mut counts = vec![0; 64 * 64];
        capture.read(2, &mut counts).unwrap();
        assert!(counts.iter().copied().eq(frame(2).map(u16::from)));
        assert_eq!((capture.frames(), capture.info().format), (3, "array"));
    }

    #[test]
    fn two_axes_are_one_frame() {
        let fetch = |first: u64, rows: u64| {
            assert_eq!((first, rows), (0, 64));
            Ok((0..64 * 64u64).map(|place| (place % 5) as u8).collect())
        };
        let array = array(&[64, 64], Box::new(fetch));
        let mut capture = Capture::from_array(array, &ReadOptions::default(), None).unwrap();
        let mut counts = vec![0; 64 * 64];
        capture.read(0, &mut counts).unwrap();
        assert_eq!((capture.frames(), counts[127]), (1, 2));
    }

    #[test]
    fn fetched_bytes_are_counted() {
        let short = Box::new(|_: u64, _: u64| Ok(vec![1, 2, 3]));
        let opened = Capture::from_array(array(&[3, 64, 64], short), &ReadOptions::default(), None);
        assert!(opened.unwrap_err().to_string().contains("not as large"));
    }
}
