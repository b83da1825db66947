//! The acquisition of a capture: its light is given, recorded, or measured from the counts.

use crate::error::{CliError, Result};
use qudi_core::USUAL_MEAN_LEVEL;
use qudi_core::fitting_mean_level;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::{Response, Sensor};
use qudi_core::windows::LONGEST_HALF;
use qudi_io::capture::{Capture, Summary};

/// The light as options give it.
#[derive(Clone, Debug)]
pub(crate) struct LightOverrides {
    /// Incident photons per pixel and output frame.
    pub(crate) ppp: Option<f64>,
    /// Gain in DN/e-.
    pub(crate) gain: Option<f64>,
    /// Image value that receives `ppp` photons, unless the capture decides.
    pub(crate) mean_level: Option<f64>,
    pub(crate) seed: u64,
    /// Incident photons of white per native frame, where the brightness is known.
    pub(crate) white: Option<f64>,
}

impl LightOverrides {
    /// Returns the gain that is given or recorded.
    fn known_gain(&self, capture: &Capture) -> Option<f64> {
        self.gain.or(capture.info().gain)
    }

    /// Measures the counts of a capture, with the known gain.
    pub(crate) fn measure(
        &self,
        capture: &mut Capture,
        sensor: Option<&Sensor>,
    ) -> Result<Summary> {
        let gain = self.known_gain(capture);
        Ok(Summary::measure(capture, sensor, gain)?)
    }
}

/// The acquisition of a capture, and where its light comes from.
pub(crate) struct CaptureAcquisition {
    pub(crate) acquisition: Acquisition,
    /// The source of the light, in words.
    pub(crate) light_source: &'static str,
}

impl CaptureAcquisition {
    /// Takes the light of a capture from `overrides`, the record, or `summary`, which
    /// [`LightOverrides::measure`] returned for this sensor.
    pub(crate) fn new(
        overrides: &LightOverrides,
        capture: &mut Capture,
        sensor: &Sensor,
        summary: &Summary,
    ) -> Result<Self> {
        checked_mean_level(overrides.mean_level)?;
        if overrides.gain.is_some() && sensor.response == Response::Binary {
            return Err(CliError::new(
                format!("`{}` is binary: its pixels fire or not, and have no gain", sensor.name),
                "--gain",
                "leave it out",
            ));
        }
        let output_sensor = capture.output_sensor(sensor)?;
        let (ppp, light_source) = light(overrides, capture, sensor, summary)?;
        let gain = match overrides.known_gain(capture) {
            Some(gain) => gain,
            None => output_sensor.gain_at(ppp)?,
        };
        let summed = output_sensor.frames_summed as f32;
        let dark = capture.dark().map(|map| map.iter().map(|dark| dark * summed).collect());
        let mut acquisition = Acquisition {
            seed: overrides.seed,
            first_frame: 0,
            ppp,
            mean_level: USUAL_MEAN_LEVEL,
            sensor: output_sensor,
            gain,
            dark,
            pedestal: 0.0,
        }
        .without_echoes()?
        .with_pedestal(capture.info().pedestal)?;
        // The recorded level gives what is restored the brightness of the clip.
        let recorded = capture.info().mean_level.filter(|_| overrides.ppp.is_none());
        let white = overrides.white.map(|white| ppp / (white * f64::from(capture.summed())));
        acquisition.mean_level = match overrides.mean_level.or(recorded).or(white) {
            Some(mean_level) => mean_level,
            None => measured_mean_level(capture, &acquisition)?,
        };
        Ok(Self { acquisition, light_source })
    }
}

/// Returns the incident photons per pixel and output frame, and where they are known from.
fn light(
    overrides: &LightOverrides,
    capture: &Capture,
    sensor: &Sensor,
    summary: &Summary,
) -> Result<(f64, &'static str)> {
    let recorded = capture.info().ppp.map(|ppp| ppp * f64::from(capture.summed()));
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
    Ok((ppp, source))
}

/// Refuses a mean level that is not positive.
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

/// Measures the mean level that fits the counts of a capture.
fn measured_mean_level(capture: &mut Capture, acquisition: &Acquisition) -> Result<f64> {
    let size = capture.size();
    // Only the first frames of a pipe have arrived.
    let first = 2 * LONGEST_HALF as u64 + 1;
    let mut mean_level = f64::INFINITY;
    for part in capture.parts() {
        let level = capture.in_part(&part, |capture| {
            let forward = capture.forward_only();
            let frames = if forward { capture.frames().min(first) } else { capture.frames() };
            let read = |frame| {
                let mut counts = vec![0; size.pixels()];
                capture.read(frame, &mut counts)?;
                Ok(counts)
            };
            if frames == 0 {
                Ok(f64::INFINITY)
            } else {
                fitting_mean_level(size, frames, acquisition, read)
            }
        })?;
        mean_level = mean_level.min(level);
    }
    Ok(mean_level)
}
