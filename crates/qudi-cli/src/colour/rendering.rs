//! Colours for the eye: gains, matrix, and the curve of sRGB.

use super::Gains;
use super::white_balance::guessed_gains;
use qudi_core::Frame;
use qudi_core::colour::SensorColour;
use qudi_core::restorer::Acquisition;
use qudi_io::capture::{Capture, Summary};

/// What turns sensor colours in linear light into colours for the eye.
#[derive(Clone, Debug)]
pub(crate) struct Rendering {
    pub(crate) gains: Gains,
    /// Where the gains are known from, in words.
    pub(crate) gains_source: &'static str,
    pub(crate) colour: SensorColour,
}

impl Rendering {
    /// Takes the gains that are given or the sensor's own, or guesses them.
    pub(crate) fn new(
        given: Option<Gains>,
        capture: &Capture,
        summary: &Summary,
        acquisition: &Acquisition,
    ) -> Self {
        let colour = acquisition.sensor.colour.clone().unwrap_or_default();
        let known = given.map(|gains| (gains, "given"));
        let known = known.or(colour.white_balance.map(|gains| (Gains(gains), "of the sensor")));
        if known.is_none() && capture.filter().is_none() {
            let gains_source = "none: planes as they are";
            return Self { gains: Gains([1.0; 3]), gains_source, colour };
        }
        let (gains, gains_source) = known.unwrap_or_else(|| {
            let guessed = guessed_gains(capture, summary, acquisition);
            (guessed, "a guess: the brightest things are taken for gray")
        });
        Self { gains, gains_source, colour }
    }

    /// Returns linear sRGB of sensor colours in linear light.
    pub(crate) fn rendered(&self, scene: &[Frame; 3]) -> [Frame; 3] {
        self.colour.rendered(self.gains.0, scene)
    }

    /// Describes gains and matrix in words.
    pub(crate) fn describe(&self) -> String {
        let [red, green, blue] = self.gains.0;
        let matrix = match self.colour.matrix {
            Some(_) => "sRGB by the sensor's matrix",
            None => "sensor RGB, without a matrix",
        };
        format!("gains {red:.3}, {green:.3}, {blue:.3} ({}), {matrix}", self.gains_source)
    }
}
