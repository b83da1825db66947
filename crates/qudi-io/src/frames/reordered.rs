//! Frames of a stack whose pages are not its frames, but the rows or columns of all frames.

use super::count_frames::CountFrames;
use super::frame_bytes::strewn;
use super::samples::{MONO, SampleFrames, Scale};
use crate::description::Axes;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result, Size};
use std::io::{BufWriter, Write};
use std::path::Path;

/// Reorders the counts of `inner`, an array of pages, rows and columns whose meaning `axes` gives. All counts
/// are stored in an unnamed file first.
pub(crate) fn reordered(
    mut inner: Box<dyn CountFrames>,
    axes: Option<Axes>,
    path: &Path,
) -> Result<Box<dyn CountFrames>> {
    let axes = axes.unwrap_or_default();
    if axes == Axes::Thw {
        return Ok(inner);
    }
    let page = inner.size();
    let pages = inner.frames();
    let io = |e| Error::io("store the frames of", path, e);
    let mut file = BufWriter::with_capacity(1 << 18, tempfile::tempfile().map_err(io)?);
    let mut counts = vec![0u16; page.pixels()];
    for number in 0..pages {
        inner.read(number, &mut counts)?;
        for count in &counts {
            file.write_all(&count.to_le_bytes()).map_err(io)?;
        }
    }
    let file = file.into_inner().map_err(|e| io(e.into_error()))?;
    let dims = [pages as usize, page.height, page.width];
    let ([height, width], layout) = axes.split(dims);
    let size = Size::new(height, width, &path.display().to_string())?;
    let bytes = strewn(path, Some(file), 0, 2, layout);
    let sample = Sample::U16 { big_endian: false };
    let (transposed, scale) = (axes.transposed(), Scale::Counts);
    Ok(Box::new(SampleFrames::new(bytes, sample, size, transposed, MONO, scale, path)))
}
