//! Where a capture comes from, and opening it with its sensor.

use super::Input;
use crate::args::Sum;
use crate::error::{CliError, Result};
use crate::settings::Settings;
use qudi_core::sensor::Sensor;
use qudi_io::capture::Capture;
use qudi_io::description::ReadOptions;
use std::io::IsTerminal;
use std::path::Path;

/// A capture as a command names it.
#[derive(Debug)]
pub(crate) struct Source<'a> {
    /// What it is read from.
    pub(crate) input: Input,
    /// Options for reading it.
    pub(crate) options: &'a ReadOptions,
    /// The number of frames summed into one, if given.
    pub(crate) sum: Option<Sum>,
    /// The sensor by name, if given.
    pub(crate) sensor: Option<&'a str>,
    /// Bytes of frames that are judged at most, before any is used.
    pub(crate) judged: u64,
}

/// A capture with its sensor, if that is known.
pub(crate) struct OpenedCapture {
    pub(crate) capture: Capture,
    pub(crate) sensor: Option<Sensor>,
}

impl Source<'_> {
    /// Opens the capture with the sensor that is named, or else known, all overrides of `[sensor]` applied.
    pub(crate) fn open(&self, settings: &Settings) -> Result<OpenedCapture> {
        let named = self.sensor.map(|name| settings.sensor(name)).transpose()?;
        if self.input.is_pipe() {
            self.open_pipe(named, settings)
        } else {
            self.open_file(named, settings)
        }
    }

    /// Opens the capture with signed counts, and judges its frames.
    fn open_judged(&self, sensor: Option<&Sensor>) -> Result<Capture> {
        let options = ReadOptions { signed: true, ..self.options.clone() };
        let mut capture = self.input.open(&options, sensor)?;
        if self.judged == 0 {
            return Ok(capture);
        }
        let known = sensor.or(capture.info().sensor.as_ref()).cloned();
        capture.judge_frames(self.judged, self.options, known.as_ref())?;
        Ok(capture)
    }

    fn open_file(&self, named: Option<Sensor>, settings: &Settings) -> Result<OpenedCapture> {
        let capture = self.open_judged(named.as_ref())?;
        if named.is_some() {
            return Ok(OpenedCapture { capture, sensor: named });
        }
        match known_sensor(&capture)? {
            Some(sensor) if settings.overrides_sensor() => {
                let sensor = settings.adjusted(sensor)?;
                // Opened again: a dark map that is set decides which pixels are repaired.
                let capture = self.open_judged(Some(&sensor))?;
                Ok(OpenedCapture { capture, sensor: Some(sensor) })
            }
            sensor => Ok(OpenedCapture { capture, sensor }),
        }
    }

    fn open_pipe(&self, named: Option<Sensor>, settings: &Settings) -> Result<OpenedCapture> {
        let mut capture = self.input.open(self.options, named.as_ref())?;
        if self.judged > 0 {
            capture.judge_while_reading();
        }
        let known = named.or(known_sensor(&capture)?);
        let sensor = known.map(|sensor| settings.adjusted(sensor)).transpose()?;
        Ok(OpenedCapture { capture, sensor })
    }
}

/// Returns the sensor that a record names, or the camera that the format belongs to.
fn known_sensor(capture: &Capture) -> Result<Option<Sensor>> {
    let about = capture.info();
    match (&about.sensor, about.preset) {
        (Some(sensor), _) => Ok(Some(sensor.clone())),
        (None, Some(preset)) => {
            let mut sensor = Sensor::load(preset)?;
            // The rate of this capture, where the file knows it.
            sensor.fps = about.exposure_rate().or(sensor.fps);
            Ok(Some(sensor))
        }
        (None, None) => Ok(None),
    }
}

/// Returns the sensor that is known, or an error that asks for it.
pub(crate) fn required_sensor(capture: &Capture) -> Result<Sensor> {
    known_sensor(capture)?.ok_or_else(|| unknown_sensor(capture))
}

/// Returns the error of a capture whose sensor has to be known.
pub(crate) fn unknown_sensor(capture: &Capture) -> CliError {
    CliError::new(
        "the file does not say which camera took it",
        capture.path().display(),
        "name its sensor, as in --sensor swissspad2 (`qudi info --sensors`)",
    )
}

/// Returns true if a path stands for standard input.
pub(crate) fn is_pipe(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Refuses to wait for a capture from a terminal; `example` is a command that pipes one in.
pub(crate) fn refuse_terminal(example: &str) -> Result<()> {
    if !std::io::stdin().is_terminal() {
        return Ok(());
    }
    Err(CliError::new(
        "standard input is a terminal, and a capture comes through a pipe",
        "-",
        format!("pipe one in, as in `{example}`, or name a file"),
    ))
}
