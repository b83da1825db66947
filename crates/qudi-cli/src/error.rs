//! Errors of commands: what happened, where, what to do.

pub(crate) mod fields;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use fields::{flags, flags_in_text};
use qudi_core::Error;
use qudi_core::nearest::nearest;
use qudi_model::{MatrixUnits, MatrixUnitsError};
use std::fmt::Display;
use std::io;

pub(crate) type Result<T, E = CliError> = std::result::Result<T, E>;

/// Anything that ends a command early.
#[derive(Debug)]
pub enum CliError {
    /// Three parts for the user.
    Error {
        /// What happened.
        what: String,
        /// The file, sensor or option that it concerns.
        place: Option<String>,
        /// What to do about it.
        help: Option<String>,
        /// The kind of cause, for programs.
        cause: Cause,
    },
    /// It worked, but a bar that was set has been missed; the results are out already.
    Missed(String),
    /// Ctrl-C, after what was done has been saved.
    Stopped(String),
    /// The time that was asked for is over, and what was done has been saved.
    TimeOver(String),
    /// Ctrl-C.
    Interrupted,
    /// The reader of our output has gone.
    BrokenPipe,
}

/// The kind of what caused an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// Options or values that cannot be.
    Request,
    /// A file or array that does not hold what it should.
    Data,
    /// A capture that the sensor, or the cameras that weights were trained for, cannot have taken.
    Mismatch,
    /// The operating system refused; with its error number, if there is one.
    System(Option<i32>),
}

impl CliError {
    pub(crate) fn new(what: impl Display, place: impl Display, help: impl Display) -> Self {
        Self::Error {
            what: what.to_string(),
            place: Some(place.to_string()),
            help: Some(help.to_string()),
            cause: Cause::Request,
        }
    }

    /// Creates the error of a capture that a sensor cannot have taken.
    pub(crate) fn mismatch(what: impl Display, place: impl Display, help: impl Display) -> Self {
        Self::Error {
            what: what.to_string(),
            place: Some(place.to_string()),
            help: Some(help.to_string()),
            cause: Cause::Mismatch,
        }
    }
}

impl CliError {
    /// Returns the error for a value that a flag cannot have, in the three parts of all errors.
    pub(crate) fn of_value(refusal: &clap::Error) -> Option<Self> {
        let text = |kind| refusal.get(kind).map(ToString::to_string);
        let argument = text(ContextKind::InvalidArg)?;
        let flag = argument.split_whitespace().next().unwrap_or_default();
        let value = text(ContextKind::InvalidValue).filter(|value| !value.is_empty())?;
        let help = match (refusal.kind(), refusal.get(ContextKind::ValidValue)) {
            (ErrorKind::ValueValidation, _) => std::error::Error::source(refusal)?.to_string(),
            (ErrorKind::InvalidValue, Some(ContextValue::Strings(all))) => {
                let names: Vec<&str> = all.iter().map(String::as_str).collect();
                let hint = nearest(&value, &names);
                let hint = hint.map_or(String::new(), |n| format!("did you mean `{n}`?  "));
                format!("{hint}there are {}", names.join(", "))
            }
            _ => return None,
        };
        Some(Self::new(format!("{flag} is {value}"), flag, help))
    }
}

impl From<Error> for CliError {
    fn from(e: Error) -> Self {
        match &e {
            Error::Interrupted => Self::Interrupted,
            Error::Io { source, .. } if source.kind() == io::ErrorKind::BrokenPipe => {
                Self::BrokenPipe
            }
            _ => Self::Error {
                what: flags_in_text(&e.to_string()),
                place: e.place().map(|place| match &e {
                    Error::Request { .. } | Error::Mismatch { .. } => flags(&place),
                    _ => place,
                }),
                help: e.help().map(|help| flags_in_text(&help)),
                cause: match &e {
                    Error::Io { source, .. } => Cause::System(source.raw_os_error()),
                    Error::Data { .. } => Cause::Data,
                    Error::Mismatch { .. } => Cause::Mismatch,
                    _ => Cause::Request,
                },
            },
        }
    }
}

impl From<MatrixUnitsError> for CliError {
    fn from(e: MatrixUnitsError) -> Self {
        let help = match e {
            MatrixUnitsError::Unknown(_) => "use f32, avx512bf16 or amx",
            MatrixUnitsError::Unavailable(_) => "unset it to use what this machine has",
        };
        Self::new(e, MatrixUnits::VARIABLE, help)
    }
}

impl From<rayon::ThreadPoolBuildError> for CliError {
    fn from(e: rayon::ThreadPoolBuildError) -> Self {
        Self::new(format!("cannot start threads: {e}"), "--threads", "ask for fewer threads")
    }
}

/// Returns the error of writing results to standard output.
pub(crate) fn stdout_error(e: io::Error) -> CliError {
    match e.kind() {
        io::ErrorKind::BrokenPipe => CliError::BrokenPipe,
        _ => CliError::new(
            format!("cannot write the result: {e}"),
            "standard output",
            "check where it is redirected to",
        ),
    }
}
