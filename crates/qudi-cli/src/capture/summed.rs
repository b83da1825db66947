//! Captures whose frames are summed: as many as given, or as light and motion allow.

use super::source::{OpenedCapture, Source, unknown_sensor};
use crate::args::Sum;
use crate::error::{CliError, Result};
use crate::report::Report;
use qudi_core::sensor::Sensor;
use qudi_io::capture::{Capture, SumChoice, choose_sum};
use qudi_io::description::ReadOptions;

/// Frames of a pipe that are awaited before the number of summed frames is chosen.
const PIPED_FRAMES: u64 = 256;

/// A capture whose frames are sums, with its sensor, if that is known.
pub(crate) struct SummedCapture {
    pub(crate) capture: Capture,
    pub(crate) sensor: Option<Sensor>,
    /// Number of frames that light and motion allow to sum, where no number is given: perhaps one.
    pub(crate) choice: Option<SumChoice>,
}

impl SummedCapture {
    /// Sums the frames of `opened` as `source` says. Without a number, the capture chooses one, unless a
    /// record names its sensor, it holds sums already, or it is a pipe, whose frames are not held back
    /// unasked.
    pub(crate) fn new(opened: OpenedCapture, source: &Source<'_>) -> Result<Self> {
        let OpenedCapture { capture, sensor } = opened;
        let about = capture.info();
        let recorded = about.sensor.is_some() || about.is_recorded() && about.max_count != Some(1);
        let asked = source.sum == Some(Sum::Auto);
        let chooses = asked || source.sum.is_none() && !source.input.is_pipe() && !recorded;
        if !chooses {
            return Ok(Self { capture, sensor, choice: None });
        }
        let (capture, choice) = sum_by_itself(capture, source.options, sensor.as_ref(), asked)?;
        Ok(Self { capture, sensor, choice })
    }

    /// Returns why several frames are summed, where no number is given.
    pub(crate) fn sum(&self) -> Option<&SumChoice> {
        self.choice.as_ref().filter(|choice| choice.frames > 1)
    }

    /// Returns the sensor, or an error that asks for it.
    pub(crate) fn required_sensor(&self) -> Result<Sensor> {
        self.sensor.clone().ok_or_else(|| unknown_sensor(&self.capture))
    }

    /// Prints how many frames are summed, if the capture chose it.
    pub(crate) fn remark_sum(&self, report: &Report) {
        if let Some(choice) = self.sum() {
            let text = describe_sum(choice, &self.capture, self.sensor.as_ref());
            report.remark(&format!("note: {text}"));
        }
    }
}

/// Sums as many frames as the capture chooses, and returns the choice. A capture that cannot choose is
/// refused if it is `asked` to.
pub(crate) fn sum_by_itself(
    mut capture: Capture,
    options: &ReadOptions,
    sensor: Option<&Sensor>,
    asked: bool,
) -> Result<(Capture, Option<SumChoice>)> {
    // A pipe shows what has come through it.
    capture.wait_for(PIPED_FRAMES)?;
    let part = capture.longest_part();
    match capture.in_part(&part, choose_sum)? {
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

/// Describes how many frames are summed, and why.
pub(crate) fn describe_sum(
    choice: &SumChoice,
    capture: &Capture,
    sensor: Option<&Sensor>,
) -> String {
    let native = capture.info().fps.or(sensor.and_then(|sensor| sensor.fps));
    let rate = native.map_or(String::new(), |fps| {
        let summed = (1e4 * fps / f64::from(choice.frames)).round() / 1e4;
        format!(", which makes {summed} frames per second")
    });
    format!(
        "{} frames are summed into one{rate}: {}; --sum N sums another number",
        choice.frames,
        choice.reason()
    )
}
