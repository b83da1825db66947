//! The native module of the Python package `qudi_spad` (`python/`, docs/python.md).
//!
//! Arguments are the flags of the command line; arrays cross as bytes. Everything else is written in Python.

mod capture;
mod errors;
mod keywords;
mod metrics;
mod run;
mod source;
mod write;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use qudi_core::sensor::Sensor;
use std::ffi::OsString;

/// See [`qudi_cli::keep_freed_pages`].
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

#[pymodule]
mod _native {
    #[pymodule_export]
    use super::capture::Capture;
    #[pymodule_export]
    use super::errors::{FormatError, SensorMismatch};
    #[pymodule_export]
    use super::metrics::{Lpips, compare};
    #[pymodule_export]
    use super::run::Run;
    #[pymodule_export]
    use super::source::Source;
    #[pymodule_export]
    use super::write::write_frames;
    #[pymodule_export]
    use super::{main, methods, sensor, sensor_toml, version};
    use pyo3::prelude::*;

    #[pymodule_init]
    #[expect(clippy::unnecessary_wraps, reason = "PyO3 asks for a result")]
    fn init(_module: &Bound<'_, PyModule>) -> PyResult<()> {
        qudi_cli::keep_freed_pages();
        Ok(())
    }
}

/// Runs the program with the arguments of a process, and returns its exit code.
#[pyfunction]
fn main(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
    py.detach(|| qudi_cli::main(&arguments))
}

/// Returns version, commit, features, kernels and system, a line each.
#[pyfunction]
fn version() -> &'static str {
    qudi_cli::version()
}

/// Returns the names of all methods, each with a line about it.
#[pyfunction]
fn methods() -> Vec<(&'static str, &'static str)> {
    qudi_cli::methods()
}

/// Returns a sensor as JSON: a preset by name, or a TOML file by path.
#[pyfunction]
fn sensor(name: &str) -> PyResult<String> {
    let sensor = qudi_cli::sensor(name).map_err(errors::exception)?;
    Ok(serde_json::to_string(&sensor).unwrap_or_default())
}

/// Returns a sensor given as JSON as the text of a TOML file.
#[pyfunction]
fn sensor_toml(json: &str) -> PyResult<String> {
    let report = |error: &dyn std::fmt::Display| PyValueError::new_err(error.to_string());
    let sensor: Sensor = serde_json::from_str(json).map_err(|error| report(&error))?;
    toml::to_string(&sensor).map_err(|error| report(&error))
}
