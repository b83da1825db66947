//! Detections that other detections cause, cross-talk and afterpulses, and the time after a detection in
//! which a counter sees nothing: their laws inverted.

use super::{Response, Sensor};

/// Iterations that invert the factor of echoes.
const ITERATIONS: usize = 20;

impl Sensor {
    /// Returns by what factor cross-talk and afterpulses raise `detections` per pixel and native frame, in a
    /// flat scene.
    pub fn echo_factor(&self, detections: f64) -> f64 {
        let (crosstalk, afterpulse) = (self.defects.crosstalk, self.defects.afterpulse);
        if self.response == Response::Linear {
            return 1.0 + 4.0 * crosstalk;
        }
        if crosstalk == 0.0 && afterpulse == 0.0 {
            return 1.0;
        }
        let detections = detections.max(1e-9);
        let fired = -(-detections).exp_m1();
        let fired = 1.0 - (1.0 - fired) * (1.0 - crosstalk * fired).powi(4);
        let fired = fired / (1.0 - (1.0 - fired) * afterpulse).max(1e-9);
        -(-fired.min(1.0 - 1e-12)).ln_1p() / detections
    }

    /// Returns the factor where `seen` detections per pixel and native frame are seen, echoes among them.
    pub fn echo_factor_of_seen(&self, seen: f64) -> f64 {
        let mut factor = 1.0;
        for _ in 0..ITERATIONS {
            factor = self.echo_factor(seen / factor);
        }
        factor
    }

    /// Replaces cross-talk and afterpulses by as many detections of light and dark counts as they add where
    /// `detections` per pixel and native frame are expected without them: all methods invert that.
    #[must_use]
    pub fn without_echoes(&self, detections: f64) -> Self {
        let factor = self.echo_factor(detections);
        let mut sensor = self.clone();
        sensor.quantum_efficiency *= factor;
        sensor.dark = sensor.dark.times(factor);
        (sensor.defects.crosstalk, sensor.defects.afterpulse) = (0.0, 0.0);
        sensor
    }

    /// Returns the dead time of a counter in exposures; 0 for none.
    pub(crate) fn dead_time(&self) -> f64 {
        self.defects.dead_time_ns * 1e-9 * self.fps.unwrap_or(0.0)
    }
}

/// Returns the mean count of a counter that starts live, with a dead time of `dead` exposures (Cox 1962).
pub(super) fn counted(detections: f64, dead: f64) -> f64 {
    let rate = detections / (1.0 + detections * dead);
    rate + 0.5 * (dead * rate).powi(2)
}

/// Returns the detections whose mean count is `count`: the inverse of [`counted`].
pub(super) fn detections_of_counted(count: f64, dead: f64) -> f64 {
    let rate = 2.0 * count / (1.0 + (1.0 + 2.0 * dead * dead * count).sqrt());
    // A counter that is always dead tells nothing but a lower bound.
    rate / (1.0 - dead * rate).max(1e-3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dead_time_is_inverted() {
        for detections in [0.1, 5.0, 20.0, 60.0] {
            let back = detections_of_counted(counted(detections, 0.01), 0.01);
            assert!((back / detections - 1.0).abs() < 1e-9, "{back} {detections}");
        }
        let mut sensor = Sensor::load("ideal").unwrap();
        (sensor.bits, sensor.fps, sensor.defects.dead_time_ns) = (8, Some(1e5), 100.0);
        let law = crate::sensor::CountLaw::new(&sensor, 1.0);
        let flux = sensor.estimate_flux(law.mean(20.0), 1, 1.0, 0.0);
        assert!((flux / 20.0 - 1.0).abs() < 1e-3, "{flux}");
    }

    #[test]
    fn echoes_are_counted_as_light() {
        let mut sensor = Sensor::load("swissspad2").unwrap();
        (sensor.defects.crosstalk, sensor.defects.afterpulse) = (0.02, 0.01);
        for light in [0.01, 0.3, 1.5] {
            let factor = sensor.echo_factor(light);
            assert!(factor > 1.02 && factor < 1.1, "{factor}");
            assert!((sensor.echo_factor_of_seen(light * factor) - factor).abs() < 1e-9);
        }
        assert_eq!(Sensor::load("swissspad2").unwrap().echo_factor(0.3), 1.0);
    }
}
