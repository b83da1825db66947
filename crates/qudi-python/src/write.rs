//! Writing restored frames.

use crate::errors::exception;
use pyo3::prelude::*;
use qudi_core::{Error, Frame, Size};
use qudi_io::writer::Planes;
use std::path::PathBuf;

/// Writes frames, each the bytes of its float32 values in C order, as `path` says by its extension. `shape`
/// has rows, columns and planes: 1 of gray frames, and 3 of colours.
#[pyfunction]
#[pyo3(signature = (path, shape, frames, *, float, fps, force))]
pub(crate) fn write_frames(
    py: Python<'_>,
    path: PathBuf,
    shape: (usize, usize, usize),
    frames: &Bound<'_, PyAny>,
    float: bool,
    fps: f64,
    force: bool,
) -> PyResult<()> {
    let (rows, columns, planes) = shape;
    let size = Size::new(rows, columns, "shape").map_err(|error| exception(error.into()))?;
    let mut raised = None;
    let mut failed = |error: PyErr| {
        let text = error.to_string();
        raised.get_or_insert(error);
        Error::request(text, "frames", "see the exception of the frames")
    };
    let mut frames = frames.try_iter()?.map(|frame| {
        py.check_signals().map_err(&mut failed)?;
        let bytes: Vec<u8> = frame.and_then(|frame| frame.extract()).map_err(&mut failed)?;
        let values = bytes.chunks_exact(4).map(|b| f32::from_ne_bytes([b[0], b[1], b[2], b[3]]));
        let plane = |k: usize| values.clone().skip(k).step_by(planes).collect();
        Ok((0..planes).map(|k| Frame { size, data: plane(k) }).collect())
    });
    let colours = if planes == 3 { Planes::Rgb } else { Planes::Gray };
    let written = qudi_cli::write_frames(&path, size, colours, float, fps, force, &mut frames);
    drop(frames);
    match raised {
        Some(raised) => Err(raised),
        None => written.map_err(exception),
    }
}
