//! The acquisition of a capture: its light from overrides, the record, or the counts.

use crate::error::{CliError, Result};
use qudi_core::USUAL_MEAN_LEVEL;
use qudi_core::fitting_mean_level;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::Sensor;
use qudi_core::windows::LONGEST_HALF;
use qudi_io::capture::{Capture, Summary};

/// What the user says about the light.
#[derive(Debug)]
pub(crate) struct LightOverrides {
    /// Incident photons per pixel and output frame.
    pub(crate) ppp: Option<f64>,
    /// DN/e-.
    pub(crate) gain: Option<f64>,
    /// Image value that receives `ppp` photons, unless the capture is to tell.
    pub(crate) mean_level: Option<f64>,
    pub(crate) seed: u64,
}

impl LightOverrides {
    /// The gain that is given, or that of the record.
    pub(crate) fn known_gain(&self, capture: &Capture) -> Option<f64> {
        self.gain.or(capture.info().gain)
    }
}

/// The acquisition of a capture, of which `summary` was measured with the known gain, and where its light comes from.
pub(crate) fn acquisition(
    overrides: &LightOverrides,
    capture: &mut Capture,
    sensor: &Sensor,
    summary: &Summary,
) -> Result<(Acquisition, &'static str)> {
    checked_mean_level(overrides.mean_level)?;
    let of_frames = capture.output_sensor(sensor)?;
    let recorded = capture.info().ppp.map(|ppp| ppp * f64::from(capture.summed()));
    let known_gain = overrides.known_gain(capture);
    let (ppp, source) = match (overrides.ppp, recorded) {
        (Some(ppp), _) => (ppp, "given"),
        (None, Some(ppp)) => (ppp, "from the record"),
        (None, None) => {
            let ppp = summary.ppp.incident.ok_or_else(|| {
                CliError::new(
                    format!(
                        "the light cannot be estimated: the gain of `{}` follows it",
                        sensor.name
                    ),
                    "--ppp",
                    "give the photons per pixel and frame, or the gain with --gain",
                )
            })?;
            (ppp, "estimated")
        }
    };
    if !(ppp.is_finite() && ppp > 0.0) {
        return Err(CliError::new(
            format!("{ppp} photons per pixel and frame"),
            "--ppp",
            "the capture is dark, or the sensor's dark rate too high: give the light, or another --sensor",
        ));
    }
    let gain = match known_gain {
        Some(gain) => gain,
        None => of_frames.gain_at(ppp)?,
    };
    let summed = of_frames.frames_summed as f32;
    let dark = capture.dark().map(|map| map.iter().map(|dark| dark * summed).collect());
    let mut acquisition = Acquisition {
        seed: overrides.seed,
        first_frame: 0,
        ppp,
        mean_level: USUAL_MEAN_LEVEL,
        sensor: of_frames,
        gain,
        dark,
    };
    // That of the record, so that what is restored has the brightness of the clip.
    let recorded = capture.info().mean_level.filter(|_| overrides.ppp.is_none());
    acquisition.mean_level = match overrides.mean_level.or(recorded) {
        Some(mean_level) => mean_level,
        None => mean_level_of(capture, &acquisition)?,
    };
    Ok((acquisition, source))
}

/// What the user says of the exposure, if it can be.
pub(crate) fn checked_mean_level(mean_level: Option<f64>) -> Result<()> {
    match mean_level {
        Some(mean_level) if !(mean_level.is_finite() && mean_level > 0.0) => Err(CliError::new(
            format!("an exposure of {mean_level}"),
            "--exposure",
            "give the mean image value, between 0 and 1",
        )),
        _ => Ok(()),
    }
}

/// What the capture says of it.
fn mean_level_of(capture: &mut Capture, acquisition: &Acquisition) -> Result<f64> {
    let size = capture.size();
    // Pipes have shown their first frames only.
    let first = 2 * LONGEST_HALF as u64 + 1;
    let frames =
        if capture.forward_only() { capture.frames().min(first) } else { capture.frames() };
    let read = |frame| {
        let mut counts = vec![0; size.pixels()];
        capture.read(frame, &mut counts)?;
        Ok(counts)
    };
    Ok(fitting_mean_level(size, frames, acquisition, read)?)
}
