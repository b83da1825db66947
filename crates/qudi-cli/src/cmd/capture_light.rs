//! The light of a capture, from what is said, recorded or seen: what methods are told.

use crate::error::{Fault, Result};
use qudi_sim::capture::{Capture, Summary};
use qudi_sim::restore::Context;
use qudi_sim::sensor::Sensor;

/// What the user says about it.
pub(crate) struct Stated {
    /// Incident photons per pixel and output frame.
    pub(crate) ppp: Option<f64>,
    /// DN/e-.
    pub(crate) gain: Option<f64>,
    /// Image value that receives `ppp` photons.
    pub(crate) exposure: f64,
    pub(crate) seed: u64,
}

/// What is known of light and sensor, and where the light comes from.
pub(crate) fn context(
    stated: &Stated,
    capture: &mut Capture,
    sensor: &Sensor,
) -> Result<(Context, &'static str)> {
    if !(stated.exposure.is_finite() && stated.exposure > 0.0) {
        return Err(Fault::new(
            format!("an exposure of {}", stated.exposure),
            "--exposure",
            "give the mean image value, between 0 and 1",
        ));
    }
    let of_frames = capture.output_sensor(sensor)?;
    let recorded = capture.about().ppp.map(|ppp| ppp * f64::from(capture.summed()));
    let known_gain = stated.gain.or(capture.about().gain);
    let (ppp, source) = match (stated.ppp, recorded) {
        (Some(ppp), _) => (ppp, "given"),
        (None, Some(ppp)) => (ppp, "from the record"),
        (None, None) => {
            let summary = Summary::measure(capture, Some(sensor), known_gain)?;
            let ppp = summary.ppp.incident.ok_or_else(|| {
                Fault::new(
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
        return Err(Fault::new(
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
    let context = Context {
        seed: stated.seed,
        first_frame: 0,
        ppp,
        exposure: stated.exposure,
        sensor: of_frames,
        gain,
        dark,
    };
    Ok((context, source))
}
