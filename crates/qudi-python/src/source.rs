//! What Python holds: arrays, of which frames are fetched when they are read, and streams of frames.

use crate::errors::FormatError;
use pyo3::exceptions::PyStopIteration;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use qudi_cli::Input;
use qudi_core::npy::Sample;
use qudi_core::{Error, Result};
use qudi_io::capture::Capture;
use qudi_io::codec::GivenArray;
use std::io::{Cursor, Read};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// Name of arrays in messages.
const ARRAY: &str = "the array";

/// The first exception of a function of Python that Rust called.
type Raised = Arc<Mutex<Option<PyErr>>>;

/// An array or a stream of frames that Python holds.
#[pyclass(frozen)]
pub(crate) struct Source {
    input: Input,
    raised: Raised,
}

#[pymethods]
impl Source {
    /// Makes a source of an array of `shape` with samples `dtype`, as in `<u2`. `fetch(first, count)` returns
    /// the bytes of frames in C order.
    #[staticmethod]
    fn array(dtype: &str, shape: Vec<usize>, fetch: Py<PyAny>) -> PyResult<Self> {
        let sample = sample(dtype)?;
        let raised = Raised::default();
        let (fetch, errors) = (Arc::new(fetch), raised.clone());
        let open = move |options: &_, sensor: Option<&_>| {
            let (fetch, errors) = (fetch.clone(), errors.clone());
            let array = GivenArray {
                name: ARRAY.to_owned(),
                sample,
                shape: shape.clone(),
                fetch: Box::new(move |first, count| call(&fetch, (first, count), &errors)),
            };
            Capture::from_array(array, options, sensor)
        };
        Ok(Self { input: Input::array(open), raised })
    }

    /// Makes a source of a stream: each call of `next` returns the bytes of one more frame, or raises
    /// `StopIteration`.
    #[staticmethod]
    fn stream(next: Py<PyAny>) -> Self {
        let raised = Raised::default();
        let (next, errors) = (Arc::new(next), raised.clone());
        let open = move |options: &_, sensor: Option<&_>| {
            let frame = Cursor::new(Vec::new());
            let reader = Stream { next: next.clone(), errors: errors.clone(), frame };
            Capture::from_pipe(reader, options, sensor)
        };
        Self { input: Input::pipe(open), raised }
    }
}

impl Source {
    /// Returns the input for a command.
    pub(crate) fn input(&self) -> Input {
        self.input.clone()
    }

    /// Takes the exception that a function of Python raised, if one did.
    pub(crate) fn raised(&self) -> Option<PyErr> {
        self.raised.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

/// Calls a function that returns bytes; an exception is kept for the caller.
fn call(
    function: &Py<PyAny>,
    arguments: impl for<'py> pyo3::call::PyCallArgs<'py>,
    errors: &Raised,
) -> Result<Vec<u8>> {
    let result = Python::attach(|py| {
        let bytes = function.bind(py).call1(arguments)?;
        Ok::<_, PyErr>(bytes.cast::<PyBytes>()?.as_bytes().to_vec())
    });
    result.map_err(|error| {
        let text = error.to_string();
        errors.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        Error::data(text, Path::new(ARRAY), "the array raised this exception")
    })
}

/// A reader of the frames that an iterator makes.
struct Stream {
    next: Arc<Py<PyAny>>,
    errors: Raised,
    frame: Cursor<Vec<u8>>,
}

impl Read for Stream {
    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        let n = self.frame.read(bytes)?;
        if n > 0 || bytes.is_empty() {
            return Ok(n);
        }
        let next = Python::attach(|py| match self.next.bind(py).call0() {
            Ok(bytes) => Ok(Some(bytes.cast::<PyBytes>()?.as_bytes().to_vec())),
            Err(error) if error.is_instance_of::<PyStopIteration>(py) => Ok(None),
            Err(error) => Err(error),
        });
        match next {
            Ok(None) => Ok(0),
            Ok(Some(frame)) => {
                self.frame = Cursor::new(frame);
                self.frame.read(bytes)
            }
            Err(error) => {
                let text = error.to_string();
                self.errors.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                Err(std::io::Error::other(text))
            }
        }
    }
}

/// Returns the type of samples of a NumPy dtype.
fn sample(dtype: &str) -> PyResult<Sample> {
    let big_endian = dtype.starts_with('>');
    let integer = |bytes, signed| Sample::Integer { bytes, signed, big_endian };
    Ok(match dtype.get(1..).unwrap_or_default() {
        "b1" => Sample::Bool,
        "u1" => Sample::U8,
        "u2" => Sample::U16 { big_endian },
        "u4" => integer(4, false),
        "u8" => integer(8, false),
        "i1" => integer(1, true),
        "i2" => integer(2, true),
        "i4" => integer(4, true),
        "i8" => integer(8, true),
        "f4" => Sample::F32 { big_endian },
        "f8" => Sample::F64 { big_endian },
        _ => {
            return Err(FormatError::new_err(format!(
                "the array holds `{dtype}`\n  where: {ARRAY}\n  help: counts are bool, integers, or floats of 4 or 8 bytes"
            )));
        }
    })
}
