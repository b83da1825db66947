//! Captures as commands open them: with the sensor that is named or known, and with remarks for the user.

pub(crate) mod acquisition;
pub(crate) mod aligned;
pub(crate) mod warnings;

use crate::args::Sum;
use crate::error::fields::flags_in_text;
use crate::error::{CliError, Result};
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::sensor::Sensor;
use qudi_io::capture::{Capture, SumChoice, choose_sum};
use qudi_io::description::ReadOptions;
use std::io::IsTerminal;
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

/// A capture with its sensor, and how many frames are summed by themselves.
pub(crate) struct OpenedCapture {
    pub(crate) capture: Capture,
    pub(crate) sensor: Option<Sensor>,
    /// Why so many frames are summed, where nobody said so.
    pub(crate) sum: Option<SumChoice>,
    /// What light and motion want, where nobody said how many frames are summed: perhaps a single one.
    pub(crate) choice: Option<SumChoice>,
}

/// Opens a capture as [`open_capture`] does. Frames are summed as `sum` says; if it says nothing, the capture
/// chooses, unless a record beside it names its sensor or holds sums already. `None` opens standard input,
/// whose frames are not held back unasked.
pub(crate) fn open_summed(
    path: Option<&Path>,
    options: &ReadOptions,
    sum: Option<Sum>,
    sensor: Option<&str>,
    settings: &Settings,
) -> Result<OpenedCapture> {
    let (capture, sensor) = if let Some(path) = path {
        open_capture(path, options, sensor, settings)?
    } else {
        let named = sensor.map(|name| settings.sensor(name)).transpose()?;
        let capture = Capture::from_pipe(std::io::stdin(), options, named.as_ref())?;
        let known = named.or(known_sensor(&capture)?);
        (capture, known.map(|sensor| settings.adjusted(sensor)).transpose()?)
    };
    let about = capture.info();
    let recorded = about.sensor.is_some() || about.is_recorded() && about.max_count != Some(1);
    let chooses = sum.is_none() && !recorded && path.is_some();
    let sum = if chooses { Some(Sum::Auto) } else { sum };
    let of_sensor = sensor.as_ref();
    let (capture, choice) = match sum {
        Some(Sum::Auto) => sum_by_itself(capture, options, of_sensor, !chooses)?,
        Some(Sum::Frames(_)) | None => (capture, None),
    };
    let sum = choice.clone().filter(|choice| choice.frames > 1);
    Ok(OpenedCapture { capture, sensor, sum, choice })
}

/// The capture with as many frames summed as it chooses, and why. Where it cannot choose and is
/// `asked` to, it is refused.
pub(crate) fn sum_by_itself(
    mut capture: Capture,
    options: &ReadOptions,
    sensor: Option<&Sensor>,
    asked: bool,
) -> Result<(Capture, Option<SumChoice>)> {
    // A pipe shows what has come through it.
    capture.wait_for(PIPED)?;
    match choose_sum(&mut capture)? {
        Some(choice) if choice.frames > 1 => {
            Ok((capture.summed_by(choice.frames, options, sensor)?, Some(choice)))
        }
        None if asked => Err(CliError::new(
            "sums are chosen for binary frames whose light is known",
            "--sum",
            "leave it out; say the depth with --bits 1 if these are binary frames",
        )),
        choice => Ok((capture, choice)),
    }
}

/// Whether a path stands for standard input.
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

/// Frames of a pipe that are waited for before it is said how many are summed.
const PIPED: u64 = 256;

/// Says how many frames are summed, and why.
pub(crate) fn describe_sum(
    choice: &SumChoice,
    capture: &Capture,
    sensor: Option<&Sensor>,
) -> String {
    let native = capture.info().fps.or(sensor.and_then(|sensor| sensor.fps));
    let rate = native.map_or(String::new(), |fps| {
        format!(", which makes {:.4} frames per second", fps / f64::from(choice.frames))
    });
    format!(
        "{} frames are summed into one{rate}: {}; --sum N sums another number",
        choice.frames,
        choice.reason()
    )
}

/// Says on standard error what the user should know about a capture.
pub(crate) fn remarks(capture: &Capture, report: &Report) {
    for remark in &capture.info().notes {
        report.remark(&format!("note: {}", flags_in_text(remark)));
    }
}
