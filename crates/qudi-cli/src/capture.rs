//! Captures as commands open them: with the sensor that is named or known, and with remarks for the user.

pub(crate) mod acquisition;

use crate::error::fields::flags_in_text;
use crate::error::{CliError, Result};
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::sensor::Sensor;
use qudi_io::capture::{Capture, ReadOptions};
use std::path::Path;

/// The sensor that a record names, or the camera that the format belongs to.
pub(crate) fn known_sensor(capture: &Capture) -> Result<Option<Sensor>> {
    let about = capture.info();
    match (&about.sensor, about.preset) {
        (Some(sensor), _) => Ok(Some(sensor.clone())),
        (None, Some(preset)) => {
            let mut sensor = Sensor::load(preset)?;
            // The rate of this capture, where the file knows it.
            sensor.fps = about.fps.or(sensor.fps);
            Ok(Some(sensor))
        }
        (None, None) => Ok(None),
    }
}

/// The sensor that is known, where there has to be one.
pub(crate) fn required_sensor(capture: &Capture) -> Result<Sensor> {
    known_sensor(capture)?.ok_or_else(|| unknown_sensor(capture))
}

/// What is said where the sensor has to be known.
pub(crate) fn unknown_sensor(capture: &Capture) -> CliError {
    CliError::new(
        "the file does not say which camera took it",
        capture.path().display(),
        "name its sensor, as in --sensor swissspad2 (`qudi info --sensors`)",
    )
}

/// Opens a capture with the sensor that is named, or else known, all overrides of `[sensor]` applied.
pub(crate) fn open_capture(
    path: &Path,
    options: &ReadOptions,
    sensor: Option<&str>,
    settings: &Settings,
) -> Result<(Capture, Option<Sensor>)> {
    if let Some(name) = sensor {
        let sensor = settings.sensor(name)?;
        return Ok((Capture::open(path, options, Some(&sensor))?, Some(sensor)));
    }
    let capture = Capture::open(path, options, None)?;
    match known_sensor(&capture)? {
        Some(sensor) if settings.overrides_sensor() => {
            let sensor = settings.adjusted(sensor)?;
            // Opened again: a dark map that is set decides which pixels are repaired.
            Ok((Capture::open(path, options, Some(&sensor))?, Some(sensor)))
        }
        known => Ok((capture, known)),
    }
}

/// Says on standard error what the user should know about a capture.
pub(crate) fn remarks(capture: &Capture, report: &Report) {
    for remark in &capture.info().notes {
        report.remark(&format!("note: {}", flags_in_text(remark)));
    }
}
