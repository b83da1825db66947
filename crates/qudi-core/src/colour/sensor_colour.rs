//! The colour of a sensor: its filter, and the meaning of its colours.

use super::choice::FilterChoice;
use super::filter::{Colour, ColourFilter};
use crate::error::Result;
use crate::frame::Frame;
use crate::sensor::Sensor;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The least efficiency of a filter.
const MIN_EFFICIENCY: f64 = 1e-6;

/// The least volume that the rows of a matrix span, as a share of the product of their lengths.
const MIN_VOLUME: f64 = 1e-6;

/// The colour filter array of a sensor.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SensorColour {
    /// Colour filter array: the colours of a tile row by row, and where the first tile begins (`rggb@0,0`,
    /// `quad-rggb`), or a picture of pure red, green, blue and white pixels (`.png`).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub cfa: Option<FilterChoice>,
    /// Share of the light that each filter passes: red, green, blue, white; all of it if unset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub efficiency: Option<[f64; 4]>,
    /// Gains of red, green and blue that make gray things gray, efficiencies aside (the inverse of DNG's
    /// AsShotNeutral); guessed from the picture if unset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub white_balance: Option<[f64; 3]>,
    /// Linear sRGB from balanced sensor colours, row by row; identity if unset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub matrix: Option<[[f64; 3]; 3]>,
}

impl SensorColour {
    /// Returns `filter` with the efficiencies of this sensor.
    #[must_use]
    pub fn applied_to(&self, filter: ColourFilter) -> ColourFilter {
        match self.efficiency {
            Some(efficiency) => filter.with_efficiency(efficiency),
            None => filter,
        }
    }

    /// Checks every value of `sensor`'s colour.
    ///
    /// # Errors
    /// [`Error`](crate::Error) for the first impossible value.
    pub(crate) fn validate(&self, sensor: &Sensor) -> Result<()> {
        let passed = self.efficiency.unwrap_or([1.0; 4]);
        for (colour, value) in Colour::ALL.into_iter().zip(passed) {
            let key = format!("colour.efficiency of {}", colour.name());
            sensor.within(&key, value, MIN_EFFICIENCY..=1.0)?;
        }
        for gain in self.white_balance.into_iter().flatten() {
            sensor.within("colour.white_balance", gain, 1e-3..=1e3)?;
        }
        for value in self.matrix.into_iter().flatten().flatten() {
            sensor.within("colour.matrix", value, -100.0..=100.0)?;
        }
        if self.matrix.is_some_and(is_singular) {
            return Err(sensor.fault(
                "colour.matrix is singular: it turns different colours into one".to_owned(),
                "its rows are independent: sRGB red, green and blue of balanced sensor colours",
            ));
        }
        Ok(())
    }

    /// Turns sensor colours in linear light into linear sRGB: gains, then the matrix.
    #[must_use]
    pub fn rendered(&self, gains: [f64; 3], scene: &[Frame; 3]) -> [Frame; 3] {
        let identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let matrix = self.matrix.unwrap_or(identity);
        std::array::from_fn(|row| {
            let weights: [f32; 3] = std::array::from_fn(|k| (matrix[row][k] * gains[k]) as f32);
            let mut out = Frame::filled(scene[0].size, 0.0);
            for (plane, weight) in scene.iter().zip(weights) {
                for (sum, value) in out.data.iter_mut().zip(&plane.data) {
                    *sum += weight * value;
                }
            }
            out
        })
    }
}

/// Returns true if the rows of `matrix` lie in a plane.
fn is_singular(matrix: [[f64; 3]; 3]) -> bool {
    let [a, b, c] = matrix;
    let volume = a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0]);
    let lengths: f64 =
        matrix.iter().map(|row| row.iter().map(|v| v * v).sum::<f64>().sqrt()).product();
    volume.abs() <= MIN_VOLUME * lengths
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Size;

    #[test]
    fn balances_before_the_matrix() {
        let scene = [0.1, 0.2, 0.4].map(|v| Frame::filled(Size { height: 1, width: 1 }, v));
        let matrix = Some([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]]);
        let colour = SensorColour { matrix, ..SensorColour::default() };
        let shown = colour.rendered([2.0, 1.0, 0.5], &scene).map(|plane| plane.data[0]);
        for (value, expected) in shown.iter().zip([0.4, 0.2, 0.4]) {
            assert!((value - expected).abs() < 1e-6);
        }
    }

    #[test]
    fn impossible_colours_are_refused() {
        let mut sensor = Sensor::load("qudi-paper").unwrap();
        let efficiency = Some([0.0, 1.0, 1.0, 1.0]);
        sensor.colour = Some(SensorColour { efficiency, ..SensorColour::default() });
        let error = sensor.validate().unwrap_err();
        assert!(error.to_string().contains("colour.efficiency of red is 0"), "{error}");
        assert!(
            error.help().unwrap().contains("lies between 0.000001 and 1"),
            "{:?}",
            error.help()
        );
        let matrix = Some([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]]);
        sensor.colour = Some(SensorColour { matrix, ..SensorColour::default() });
        assert!(sensor.validate().unwrap_err().to_string().contains("singular"));
    }
}
