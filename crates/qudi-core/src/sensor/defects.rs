//! Imperfect pixels: dark map, hot and dead pixels, cross-talk, afterpulsing, dead time.
//!
//! The pattern belongs to the camera, not to the capture: it is drawn from its own `seed`.

use super::{DarkRate, Response, Sensor};
use crate::error::{Error, Result};
use crate::frame::Size;
use crate::random::{Domain, Streams, uniform};
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Imperfections of the pixel array. Everything is off by default.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Defects {
    /// Seed of this camera's pixel pattern.
    pub seed: u64,
    /// Standard deviation of ln(dark rate) over the good pixels; the sensor's `dark` is their median.
    pub dark_spread: f64,
    /// `.npy` of `[height][width]` dark rates in e- per pixel and native frame, instead of drawn ones.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dark_map: Option<String>,
    /// `.npy` of `[height][width]`, nonzero where captures are repaired. The simulator does not need it: hot
    /// pixels are hot in `dark_map`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bad_pixels: Option<String>,
    /// Fraction of hot pixels.
    pub hot_fraction: f64,
    /// Dark rate of a hot pixel, as `dark`.
    pub hot_dark: DarkRate,
    /// Fraction of dead pixels, which read 0.
    pub dead_fraction: f64,
    /// Probability that a detection also fires a given one of the 4 neighbours.
    pub crosstalk: f64,
    /// Probability that a detection fires the same pixel again in the next binary frame.
    pub afterpulse: f64,
    /// Non-paralysable dead time of a photon counter, ns.
    pub dead_time_ns: f64,
}

impl Defects {
    pub(crate) fn validate(&self, sensor: &Sensor) -> Result<()> {
        sensor.within("defects.dark_spread", self.dark_spread, 0.0..=10.0)?;
        sensor.within("defects.hot_fraction", self.hot_fraction, 0.0..=1.0)?;
        sensor.within("defects.dead_fraction", self.dead_fraction, 0.0..=1.0)?;
        sensor.within("defects.hot_dark", self.hot_dark.value(), 0.0..=1e9)?;
        sensor.within("defects.crosstalk", self.crosstalk, 0.0..=1.0)?;
        sensor.within("defects.afterpulse", self.afterpulse, 0.0..=1.0)?;
        sensor.within("defects.dead_time_ns", self.dead_time_ns, 0.0..=1e12)?;
        if self.hot_fraction + self.dead_fraction > 1.0 {
            return Err(sensor.fault(
                format!("{} hot and {} dead pixels", self.hot_fraction, self.dead_fraction),
                "the two fractions add up to at most 1",
            ));
        }
        if self.hot_fraction > 0.0 && self.hot_dark.value() == 0.0 {
            return Err(sensor.fault(
                format!("hot_fraction is {}, but hot pixels have no dark rate", self.hot_fraction),
                "set `defects.hot_dark`, as in \"5000/s\"",
            ));
        }
        if self.afterpulse > 0.0 && sensor.response == Response::Linear {
            return Err(sensor.fault(
                format!("afterpulse is {} on a linear sensor", self.afterpulse),
                "only avalanche pixels (`response = \"binary\"`) trap and release carriers",
            ));
        }
        if self.dead_time_ns > 0.0 {
            if sensor.response == Response::Binary {
                return Err(sensor.fault(
                    format!("dead_time_ns is {} on a clocked binary sensor", self.dead_time_ns),
                    "a clocked pixel is dead until its frame ends anyway; for a free-running counter use `response = \"linear\"`",
                ));
            }
            if sensor.fps.is_none() {
                return Err(sensor.fault(
                    "dead_time_ns without a frame rate".into(),
                    "set `fps`, so that the dead time can be compared with the exposure",
                ));
            }
        }
        sensor.per_native_frame(self.hot_dark, "defects.hot_dark").map(drop)
    }
}

/// Properties that differ from pixel to pixel, for one array size.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PixelMaps {
    /// Dark electrons per native frame, `[height * width]`; absent if all pixels are alike.
    pub dark: Option<Vec<f32>>,
    /// Pixels that always read 0, as indices in rising order.
    pub dead: Vec<usize>,
    /// Hot pixels, as indices in rising order.
    pub hot: Vec<usize>,
}

impl PixelMaps {
    /// Returns the mean dark electrons per pixel and output frame over the array.
    ///
    /// # Errors
    /// [`Error::Sensor`] if the sensor's rate is per second and its frame rate unknown.
    pub fn mean_dark(&self, sensor: &Sensor) -> Result<f64> {
        let Some(map) = &self.dark else { return sensor.dark_per_frame() };
        let sum: f64 = map.iter().map(|&d| f64::from(d)).sum();
        Ok(sum / map.len() as f64 * f64::from(sensor.frames_summed))
    }

    /// Draws the pattern of `sensor` for an array of `size`.
    ///
    /// # Errors
    /// [`Error`] if the sensor's dark map cannot be read or has another size.
    pub fn draw(sensor: &Sensor, size: Size) -> Result<Self> {
        let defects = &sensor.defects;
        let median = sensor.per_native_frame(sensor.dark, "dark")?;
        let hot_dark = sensor.per_native_frame(defects.hot_dark, "defects.hot_dark")? as f32;
        let file = defects.dark_map.as_deref().map(|f| read_dark_map(f, size)).transpose()?;
        let uneven = defects.dark_spread > 0.0 || defects.hot_fraction > 0.0 || file.is_some();
        if !uneven && defects.dead_fraction == 0.0 {
            return Ok(Self::default());
        }
        let mut dark = file.unwrap_or_else(|| vec![median as f32; size.pixels()]);
        let from_file = defects.dark_map.is_some();
        let (mut dead, mut hot) = (Vec::new(), Vec::new());
        let streams = Streams::new(defects.seed);
        for y in 0..size.height {
            let mut rng = streams.row(Domain::Pattern, 0, y);
            for x in 0..size.width {
                let i = y * size.width + x;
                // Always three draws per pixel, so that one setting does not move another's pixels.
                let fate = uniform(&mut rng);
                let z: f64 = StandardNormal.sample(&mut rng);
                if !from_file {
                    dark[i] = (median * (defects.dark_spread * z).exp()) as f32;
                }
                if fate < defects.hot_fraction {
                    dark[i] = hot_dark;
                    hot.push(i);
                } else if fate > 1.0 - defects.dead_fraction {
                    dead.push(i);
                }
            }
        }
        Ok(Self { dark: uneven.then_some(dark), dead, hot })
    }
}

fn read_dark_map(file: &str, size: Size) -> Result<Vec<f32>> {
    let path = std::path::Path::new(file);
    let map = crate::npy::read_image(path)?;
    if map.size != size {
        return Err(Error::data(
            format!("a dark map of {} for frames of {size}", map.size),
            path,
            "use a map of the same array, or crop it to the frames",
        ));
    }
    if let Some(bad) = map.data.iter().find(|v| !(v.is_finite() && **v >= 0.0)) {
        return Err(Error::data(
            format!("a dark rate of {bad}"),
            path,
            "dark rates are finite and not negative, in electrons per pixel and frame",
        ));
    }
    Ok(map.data)
}
