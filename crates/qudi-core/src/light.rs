//! Amounts of light: photons per pixel (PPP) in its three meanings, and lux.

pub(crate) mod mean_level;

use crate::error::{Error, Result};
use crate::sensor::{CountLaw, Gain, Response, Sensor};
use serde::{Deserialize, Serialize};

/// The mean value of usual scenes, assumed where the true one is unknown.
pub const USUAL_MEAN_LEVEL: f64 = 0.45;

/// Meaning of a number of "photons per pixel".
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PppDefinition {
    /// Mean photons falling on a pixel per output frame, before quantum efficiency.
    #[default]
    Incident,
    /// Mean electrons per output frame, dark ones included.
    Detected,
    /// Mean output value per output frame.
    Dn,
}

/// The light of a clip: `theta = image * ppp / mean_level` photons per pixel and output frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Light {
    /// Mean incident photons per pixel and output frame.
    pub ppp: f64,
    /// The image value that receives `ppp` photons: the mean of the image over the whole clip.
    #[serde(rename = "exposure")]
    pub mean_level: f64,
}

/// CRC-32 of a clip's values, little-endian, in order.
#[derive(Clone, Debug, Default)]
pub struct Checksum(crc32fast::Hasher);

impl Checksum {
    /// Adds one frame.
    pub fn add(&mut self, values: &[f32]) {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.0.update(&bytes);
    }

    /// Returns the checksum of all values so far.
    pub fn crc32(&self) -> u32 {
        self.0.clone().finalize()
    }
}

/// Mean, histogram and checksum of a clip's values in [0, 1].
#[derive(Clone, Debug)]
pub struct ClipStatistics {
    checksum: Checksum,
    /// Count and sum of the values in each of 4096 equal bins.
    bins: Vec<(u64, f64)>,
    largest: f32,
}

const BINS: usize = 4096;

impl Default for ClipStatistics {
    fn default() -> Self {
        Self { checksum: Checksum::default(), bins: vec![(0, 0.0); BINS], largest: 0.0 }
    }
}

impl ClipStatistics {
    /// Adds one frame of values in [0, 1].
    pub fn add(&mut self, values: &[f32]) {
        for &value in values {
            let bin = &mut self.bins[((value * BINS as f32) as usize).min(BINS - 1)];
            bin.0 += 1;
            bin.1 += f64::from(value);
            self.largest = self.largest.max(value);
        }
        self.checksum.add(values);
    }

    /// Returns the CRC-32 of all values so far.
    pub fn crc32(&self) -> u32 {
        self.checksum.crc32()
    }

    /// Returns the largest value of the clip; 0 if it is empty.
    pub fn largest(&self) -> f32 {
        self.largest
    }

    /// Returns the mean value of the clip; 0 if it is empty.
    pub fn mean(&self) -> f64 {
        let (count, sum) = self.bins.iter().fold((0, 0.0), |(n, s), b| (n + b.0, s + b.1));
        if count == 0 { 0.0 } else { sum / count as f64 }
    }

    /// Returns the mean of `f(value)` over the clip; exact for 8-bit sources, else to the width of a bin.
    fn mean_of(&self, f: impl Fn(f64) -> f64) -> f64 {
        let filled = self.bins.iter().filter(|b| b.0 > 0);
        let (count, sum) = filled.fold((0, 0.0), |(n, s), &(count, sum)| {
            (n + count, s + count as f64 * f(sum / count as f64))
        });
        if count == 0 { 0.0 } else { sum / count as f64 }
    }
}

/// Finds the light that makes `value` in the sense of `definition`, for a clip of these statistics.
/// `dark` is the array's mean dark electrons per output frame.
///
/// # Errors
/// [`Error::Request`] if no light does, or if the clip is black and no exposure is given.
pub fn resolve_light(
    sensor: &Sensor,
    definition: PppDefinition,
    value: f64,
    mean_level: Option<f64>,
    clip: &ClipStatistics,
    dark: f64,
) -> Result<Light> {
    if !(value.is_finite() && (0.0..=1e6).contains(&value)) {
        return Err(Error::request(
            format!("{value} photons per pixel"),
            "ppp",
            "give a number between 0 (darkness) and 1000000",
        ));
    }
    let mean_level = mean_level.unwrap_or_else(|| clip.mean());
    if !(mean_level.is_finite() && mean_level > 0.0 && mean_level <= 1e6) {
        return Err(Error::request(
            format!(
                "an exposure of {mean_level}: the clip has no light to distribute photons over"
            ),
            "exposure",
            "give the image value that receives PPP photons, such as 0.45",
        ));
    }
    let qe = sensor.quantum_efficiency;
    let ppp = match definition {
        PppDefinition::Incident => value,
        PppDefinition::Detected if value >= dark => (value - dark) / qe,
        PppDefinition::Detected => {
            return Err(Error::request(
                format!("{value} detections per pixel, but dark counts alone are {dark:.4}"),
                "ppp",
                "raise `ppp`, or lower the sensor's `dark`",
            ));
        }
        PppDefinition::Dn => {
            let gain_follows_light = matches!(sensor.gain, Gain::Quiver | Gain::Auto);
            if sensor.response == Response::Linear && gain_follows_light {
                return Err(Error::request(
                    format!(
                        "the gain rule `{}` follows the light, so a mean output value does not fix it",
                        sensor.gain
                    ),
                    "ppp_def",
                    "give a gain that does not: `unit`, `fwc`, or a number of DN per electron",
                ));
            }
            let law = CountLaw::new(sensor, sensor.gain_at(1.0)?);
            let mean_dn = |ppp: f64| clip.mean_of(|v| law.mean(qe * ppp * v / mean_level + dark));
            light_for_mean_value(mean_dn, value)?
        }
    };
    Ok(Light { ppp, mean_level })
}

/// Inverts the rising function `mean_dn` by bisection.
fn light_for_mean_value(mean_dn: impl Fn(f64) -> f64, value: f64) -> Result<f64> {
    let unreachable = |low: f64, high: f64| {
        Error::request(
            format!(
                "a mean output value of {value} is out of reach: this sensor gives {low:.4} to {high:.4} here"
            ),
            "ppp",
            "choose a value in that range, or more bits or summed frames",
        )
    };
    let darkest = mean_dn(0.0);
    let mut high = 1.0;
    let mut at_high = mean_dn(high);
    while at_high < value && high < 1e6 {
        high *= 2.0;
        at_high = mean_dn(high);
    }
    if value < darkest || at_high < value {
        return Err(unreachable(darkest, at_high));
    }
    let mut low = 0.0;
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if mean_dn(middle) < value { low = middle } else { high = middle }
    }
    Ok(0.5 * (low + high))
}

/// Colour of the light, for converting lux into photons.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Spectrum {
    /// One wavelength in nanometres and the photopic sensitivity V there.
    Monochromatic {
        /// Wavelength in nm.
        nm: f64,
        /// Photopic luminous efficiency, 1 at 555 nm.
        v: f64,
    },
    /// Daylight from 395 to 718 nm.
    Daylight,
}

impl Spectrum {
    /// Returns the photons per lux, second and square micrometre.
    ///
    /// `lambda / (683.002 lm/W * V * h * c)`: 4091 at 555 nm. For daylight the measured range is
    /// 11,000 to 11,850; 11,400 is used.
    pub fn photons_per_lux_second_um2(self) -> f64 {
        const PLANCK: f64 = 6.626_070_15e-34;
        const LIGHT_SPEED: f64 = 299_792_458.0;
        const LUMENS_PER_WATT: f64 = 683.002;
        match self {
            Self::Monochromatic { nm, v } => {
                nm * 1e-9 / (LUMENS_PER_WATT * v * PLANCK * LIGHT_SPEED) * 1e-12
            }
            Self::Daylight => 11_400.0,
        }
    }

    /// Creates light of one wavelength, with V from the Gaussian fit to the CIE 1924 photopic curve
    /// `1.019 exp(-285.4 (um - 0.559)^2)`; good to a few per cent of the peak.
    pub fn wavelength(nm: f64) -> Self {
        if (nm - 555.0).abs() < 1e-9 {
            return Self::Monochromatic { nm, v: 1.0 };
        }
        let um = nm * 1e-3;
        Self::Monochromatic { nm, v: 1.019 * (-285.4 * (um - 0.559) * (um - 0.559)).exp() }
    }
}

/// Returns the photons per pixel and exposure at an illuminance on the sensor plane.
pub fn ppp_from_lux(lux: f64, exposure_s: f64, pitch_um: f64, spectrum: Spectrum) -> f64 {
    lux * exposure_s * pitch_um * pitch_um * spectrum.photons_per_lux_second_um2()
}

/// Converts the illuminance of a diffuse scene into the illuminance on the sensor plane behind a lens:
/// `E = E_scene * R * T / (4 N^2 (1 + m)^2)`.
pub fn sensor_lux(
    scene_lux: f64,
    reflectance: f64,
    transmission: f64,
    f_number: f64,
    magnification: f64,
) -> f64 {
    scene_lux * reflectance * transmission
        / (4.0 * f_number * f_number * (1.0 + magnification) * (1.0 + magnification))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_lux_gives_the_published_photon_flux() {
        let green = Spectrum::wavelength(555.0);
        assert!((green.photons_per_lux_second_um2() - 4091.0).abs() < 1.0);
        assert!((ppp_from_lux(1.0, 1.0 / 2000.0, 1.1, green) - 2.475).abs() < 5e-4);
    }

    fn clip_of(values: &[f32]) -> ClipStatistics {
        let mut clip = ClipStatistics::default();
        clip.add(values);
        clip
    }

    #[test]
    fn three_light_definitions_agree_on_a_clip() {
        let clip = clip_of(&[0.1, 0.5, 0.9, 0.2]);
        let mut sensor = Sensor::load("swissspad2").unwrap();
        sensor.frames_summed = 7;
        let dark = sensor.dark_per_frame().unwrap();
        let incident =
            resolve_light(&sensor, PppDefinition::Incident, 40.0, None, &clip, dark).unwrap();
        let detected = sensor.quantum_efficiency * 40.0 + dark;
        let same =
            resolve_light(&sensor, PppDefinition::Detected, detected, None, &clip, dark).unwrap();
        assert!((same.ppp - incident.ppp).abs() < 1e-9);
        let law = CountLaw::new(&sensor, 1.0);
        let dn = [0.1, 0.5, 0.9, 0.2].map(|v| law.mean(0.05 * 40.0 * v / clip.mean() + dark));
        let dn = dn.iter().sum::<f64>() / 4.0;
        let same = resolve_light(&sensor, PppDefinition::Dn, dn, None, &clip, dark).unwrap();
        assert!((same.ppp - incident.ppp).abs() < 1e-4, "{} {}", same.ppp, incident.ppp);
    }

    #[test]
    fn rejects_impossible_light() {
        let clip = clip_of(&[0.5]);
        let sensor = Sensor::load("qudi-paper").unwrap();
        let ask = |definition, value, clip: &ClipStatistics| {
            resolve_light(&sensor, definition, value, None, clip, 1.6)
        };
        assert!(ask(PppDefinition::Incident, f64::NAN, &clip).is_err());
        assert!(ask(PppDefinition::Incident, -1.0, &clip).is_err());
        assert!(ask(PppDefinition::Detected, 1.0, &clip).is_err());
        assert!(ask(PppDefinition::Dn, 3.0, &clip).is_err());
        assert!(ask(PppDefinition::Incident, 3.0, &clip_of(&[0.0, 0.0])).is_err());
    }
}
