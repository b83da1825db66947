//! Errors of commands as Python exceptions.

use crate::keywords::keywords;
use pyo3::create_exception;
use pyo3::exceptions::{
    PyFileExistsError, PyKeyboardInterrupt, PyOSError, PyTimeoutError, PyTypeError, PyValueError,
};
use pyo3::prelude::*;
use qudi_cli::{Cause, CliError};

create_exception!(
    qudi_spad,
    FormatError,
    PyValueError,
    "A file or array does not hold what a capture holds."
);
create_exception!(
    qudi_spad,
    SensorMismatch,
    PyValueError,
    "A capture that the named sensor cannot have taken."
);

/// Python's `errno.EEXIST`.
const EXISTS: i32 = 17;

/// Returns the exception for an error. Its message has the three parts of all errors, a line each.
pub(crate) fn exception(error: CliError) -> PyErr {
    let (what, place, help, cause) = match error {
        CliError::Error { what, place, help, cause } => (what, place, help, cause),
        CliError::Missed(what) => return PyValueError::new_err(what),
        CliError::Interrupted => return PyKeyboardInterrupt::new_err("stopped"),
        CliError::TimeOver(what) => return PyTimeoutError::new_err(what),
        CliError::Stopped(what) => return PyKeyboardInterrupt::new_err(what),
        CliError::BrokenPipe => return PyOSError::new_err("the reader has gone"),
    };
    let what = keywords(&what);
    let help = help.map_or(String::new(), |help| format!("\n  help: {}", keywords(&help)));
    let found = place.as_deref().map_or(String::new(), |place| {
        // Files keep their names, flags are keywords.
        let is_flag = place.starts_with("--");
        let place = if is_flag { keywords(place).replace('`', "") } else { place.to_owned() };
        format!("\n  where: {place}")
    });
    // Python adds the name of the file to errors of the system.
    let of_system = |number| (number, format!("{what}{help}\n  where"), place.clone());
    let text = format!("{what}{found}{help}");
    match cause {
        Cause::Request => PyValueError::new_err(text),
        Cause::Argument => PyTypeError::new_err(text),
        Cause::Data => FormatError::new_err(text),
        Cause::Mismatch => SensorMismatch::new_err(text),
        Cause::Exists => PyFileExistsError::new_err(of_system(EXISTS)),
        Cause::System(Some(number)) => PyOSError::new_err(of_system(number)),
        Cause::System(None) => PyOSError::new_err(text),
    }
}
