//! An open capture.

use crate::errors::exception;
use crate::source::Source;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use qudi_core::sensor::Sensor;
use qudi_io::capture::Capture as Opened;
use serde_json::json;
use std::sync::{Mutex, PoisonError};

/// A capture whose frames are read when they are asked for.
#[pyclass(frozen)]
pub(crate) struct Capture {
    opened: Mutex<Opened>,
    sensor: Option<Sensor>,
}

#[pymethods]
impl Capture {
    /// Opens the capture that the arguments of `qudi restore` name, or `source`.
    #[new]
    #[pyo3(signature = (arguments, source=None))]
    fn new(
        py: Python<'_>,
        arguments: Vec<String>,
        source: Option<&Bound<'_, Source>>,
    ) -> PyResult<Self> {
        let source = source.map(Bound::get);
        let input = source.map(Source::input);
        let opened = py.detach(|| qudi_cli::open(&arguments, input));
        if let Some(raised) = source.and_then(Source::raised) {
            return Err(raised);
        }
        let (opened, sensor) = opened.map_err(exception)?;
        Ok(Self { opened: Mutex::new(opened), sensor })
    }

    /// Returns frames, rows and columns.
    fn shape(&self, py: Python<'_>) -> (u64, usize, usize) {
        self.with(py, |capture| {
            let size = capture.size();
            (capture.frames(), size.height, size.width)
        })
    }

    /// Returns what is known of it, as JSON.
    fn info(&self, py: Python<'_>) -> String {
        let sensor = &self.sensor;
        self.with(py, |capture| {
            let info = capture.info();
            let size = capture.size();
            let text = json!({
                "path": capture.path(),
                "format": info.format,
                "title": info.title,
                "reasons": info.reasons,
                "frames": capture.frames(),
                "height": size.height,
                "width": size.width,
                "native_frames": capture.native_frames(),
                "summed": capture.summed(),
                "max_count": capture.max_count(),
                "binary": info.binary,
                "packed": info.packing.is_some(),
                "fps": capture.fps(),
                "ppp": info.ppp,
                "gain": info.gain,
                "sensor": sensor,
                "notes": info.notes,
                "repaired_pixels": capture.bad_pixels().len(),
            });
            text.to_string()
        })
    }

    /// Returns the counts of a frame as bytes, little-endian uint16 in C order.
    fn read<'py>(&self, py: Python<'py>, frame: u64) -> PyResult<Bound<'py, PyBytes>> {
        let counts = self.with(py, |capture| {
            let mut counts = vec![0; capture.size().pixels()];
            capture.read(frame, &mut counts).map(|()| little_endian(&counts))
        });
        let bytes = counts.map_err(|error| exception(error.into()))?;
        Ok(PyBytes::new(py, &bytes))
    }
}

impl Capture {
    /// Runs `run` without holding the interpreter: reading may call back into Python, or take long.
    fn with<T: Send>(&self, py: Python<'_>, run: impl FnOnce(&mut Opened) -> T + Send) -> T {
        py.detach(|| run(&mut self.opened.lock().unwrap_or_else(PoisonError::into_inner)))
    }
}

fn little_endian(counts: &[u16]) -> Vec<u8> {
    counts.iter().flat_map(|count| count.to_le_bytes()).collect()
}
