//! Errors of commands as Python exceptions.

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
    let mut text = what;
    if let Some(place) = &place {
        text += &format!("\n  where: {place}");
    }
    if let Some(help) = &help {
        text += &format!("\n  help: {help}");
    }
    let text = keywords(&text);
    match cause {
        Cause::Request => PyValueError::new_err(text),
        Cause::Argument => PyTypeError::new_err(text),
        Cause::Data => FormatError::new_err(text),
        Cause::Mismatch => SensorMismatch::new_err(text),
        Cause::Exists => PyFileExistsError::new_err((EXISTS, text, place)),
        Cause::System(Some(number)) => PyOSError::new_err((number, text, place)),
        Cause::System(None) => PyOSError::new_err(text),
    }
}

/// Returns a text with keyword arguments in place of flags: `sum=7` for `--sum 7`, `pack_axis` for
/// `--pack-axis`.
pub(crate) fn keywords(text: &str) -> String {
    let mut out = String::new();
    let text = text.replace("overwrite it with --force", "overwrite it with overwrite=True");
    let mut rest = text.as_str();
    while let Some(at) = rest.find("--") {
        let (before, flag) = rest.split_at(at);
        out += before;
        let letters = |c: char| c.is_ascii_lowercase() || c == '-';
        let name = &flag[2..flag[2..].find(|c| !letters(c)).map_or(flag.len(), |end| end + 2)];
        // A dash between words, or a rule of dashes, is no flag.
        if name.is_empty()
            || name.starts_with('-')
            || before.ends_with(|c: char| c != ' ' && c != '(' && c != '`')
        {
            out += "--";
            rest = &flag[2..];
            continue;
        }
        out += &name.trim_end_matches('-').replace('-', "_");
        rest = &flag[2 + name.len()..];
        let value = rest.strip_prefix(' ').unwrap_or("");
        let end = value.find([' ', ',', ';', ')', '\n', '`']).unwrap_or(value.len());
        let value = &value[..end];
        let is_number = value.parse::<f64>().is_ok();
        let is_name = value.contains('-') || value.contains(|c: char| c.is_ascii_digit());
        let is_stand_in = !value.is_empty() && value.chars().all(|c| c.is_ascii_uppercase());
        if is_number || is_name || is_stand_in {
            out += &if is_number || is_stand_in {
                format!("={value}")
            } else {
                format!("=\"{value}\"")
            };
            rest = &rest[1 + value.len()..];
        }
    }
    out + rest
}
