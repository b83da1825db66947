//! The sensor: its parameters with units, and its response to light.
//!
//! Linear sensors (quanta image sensors, photon counters, CMOS):
//! `e = min(Poisson(QE * theta + dark), full_well)`, `v = e + Normal(0, read_noise)`,
//! `y = clip(round_half_even(gain * v), 0, 2^bits - 1)` (Quanta Diffusion, eq. 1, with an explicit
//! gain). Binary sensors (SPAD arrays): `P(y = 1) = 1 - exp(-(QE * theta + dark))` per binary
//! frame, `frames_summed` of which make one count (Ma et al. 2020, section 3).
//! `theta` is in photons per pixel and frame.

pub mod bad_pixels;
mod count_table;
mod defects;
mod document;
mod draw;
mod echoes;
mod law;
mod moments;
mod presets;
mod units;

pub(crate) use count_table::{CountTable, RowScratch};
pub use defects::{Defects, PixelMaps};
pub use document::{load_document, merge_documents};
pub(crate) use draw::{binomial, counted, poisson};
pub use law::CountLaw;
pub use moments::CountMoments;
pub use presets::{PRESETS, Preset, preset};
pub use units::{DarkRate, FullWell, Gain};

use crate::colour::SensorColour;
use crate::error::{Error, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Standard deviations of the read noise that are kept below zero.
const KEPT_SIGMAS: f64 = 3.0;

/// Response of a pixel to light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Response {
    /// Counts electrons, adds read noise, digitises.
    Linear,
    /// One bit per frame: at least one detection, or none.
    Binary,
}

/// A single-photon (or ordinary) image sensor. Check hand-made ones with [`Sensor::validate`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sensor {
    /// Short name, as in `swissspad2`.
    pub name: String,
    /// One line about the sensor.
    #[serde(default)]
    pub summary: String,
    /// Response of a pixel to light.
    pub response: Response,
    /// Bits per output sample of one native frame; 1 for binary sensors.
    pub bits: u8,
    /// Detections (or electrons) per photon on the pixel's pitch: PDE with fill factor.
    pub quantum_efficiency: f64,
    /// Dark electrons per pixel: a number is per native frame, `"7.5/s"` per second.
    pub dark: DarkRate,
    /// Read noise, e- rms; 0 for binary sensors.
    #[serde(default)]
    pub read_noise: f64,
    /// Full-well capacity, e-; `"unlimited"` for none.
    #[serde(default)]
    pub full_well: FullWell,
    /// Pedestal of a linear sensor in DN: added by `simulate`, subtracted when captures are read.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub offset: f64,
    /// Photon counting with an analogue camera: DN above the pedestal beyond which a sample is one detection
    /// (binary sensors).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub threshold: Option<f64>,
    /// DN per e-, or a rule: `quiver` (0.5 (2^bits - 1) / PPP), `unit` (1), `fwc` (full scale at full well),
    /// `auto` (half scale at the mean).
    #[serde(default)]
    pub gain: Gain,
    /// Native frames per second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fps: Option<f64>,
    /// Pixel pitch in micrometres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pitch_um: Option<f64>,
    /// Rows of the full array.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height: Option<usize>,
    /// Columns of the full array.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub width: Option<usize>,
    /// Binary frames summed into one output frame.
    #[serde(default = "one")]
    pub frames_summed: u32,
    /// Time from the first row to the last as a share of a native frame, 0 to 1: `simulate` exposes each row
    /// to the scene at its own time, rounded to `instants`.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub rolling_shutter: f64,
    /// Imperfect pixels; all off by default.
    #[serde(default)]
    pub defects: Defects,
    /// Colour filter array; none of a monochrome sensor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub colour: Option<SensorColour>,
    /// Sources of the numbers.
    #[serde(default)]
    pub sources: Vec<String>,
    /// Keys whose numbers no source confirms.
    #[serde(default)]
    pub unverified: Vec<String>,
}

fn one() -> u32 {
    1
}

#[allow(clippy::trivially_copy_pass_by_ref)] // serde passes a reference
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl Sensor {
    /// Returns the largest output value: `2^bits - 1`, or the number of summed binary frames.
    pub fn max_count(&self) -> u16 {
        match self.response {
            Response::Linear => ((1u32 << self.bits) - 1) as u16,
            Response::Binary => self.frames_summed as u16,
        }
    }

    /// Returns the number of bits that an output sample needs.
    pub fn output_bits(&self) -> u8 {
        (16 - self.max_count().leading_zeros()) as u8
    }

    /// Returns the dark electrons of an ordinary pixel per *output* frame (the median, where pixels differ).
    ///
    /// # Errors
    /// [`Error::Sensor`] if the rate is per second and the frame rate is unknown.
    pub fn dark_per_frame(&self) -> Result<f64> {
        Ok(self.per_native_frame(self.dark, "dark")? * f64::from(self.frames_summed))
    }

    /// Converts a dark rate into electrons per native frame.
    pub(crate) fn per_native_frame(&self, rate: DarkRate, key: &str) -> Result<f64> {
        match (rate, self.fps) {
            (DarkRate::PerFrame(electrons), _) => Ok(electrons),
            (DarkRate::PerSecond(rate), Some(fps)) => Ok(rate / fps),
            (DarkRate::PerSecond(rate), None) => Err(self.fault(
                format!("{key} is {rate} per second, but the sensor has no frame rate"),
                "set `fps`, or give the rate per frame (a plain number)",
            )),
        }
    }

    /// Returns the gain in DN/e- at `ppp` incident photons per pixel and output frame.
    ///
    /// # Errors
    /// [`Error::Sensor`] if the rule has no finite answer at this light.
    pub fn gain_at(&self, ppp: f64) -> Result<f64> {
        if self.response == Response::Binary {
            return Ok(1.0);
        }
        let full_scale = f64::from(self.max_count());
        let gain = match self.gain {
            Gain::Fixed(gain) => gain,
            Gain::Unit => 1.0,
            Gain::Quiver => 0.5 * full_scale / ppp,
            Gain::Fwc => full_scale / self.full_well.electrons(),
            Gain::Auto => {
                0.5 * full_scale / (self.quantum_efficiency * ppp + self.dark_per_frame()?)
            }
        };
        if gain.is_finite() && gain > 0.0 {
            return Ok(gain);
        }
        Err(self.fault(
            format!("the gain rule `{}` gives {gain} DN/e- at {ppp} photons per pixel", self.gain),
            "give the gain as a number, in DN per electron, or use `unit`",
        ))
    }

    /// Returns the gain in DN/e-, or `None` if it depends on the light.
    pub fn fixed_gain(&self) -> Option<f64> {
        match self.gain {
            Gain::Fixed(_) | Gain::Unit | Gain::Fwc => self.gain_at(1.0).ok(),
            Gain::Quiver | Gain::Auto => None,
        }
    }

    /// Returns the part of a pedestal of `offset` DN that is kept in counts, so that read noise below zero is
    /// not cut off; none where the gain follows the light.
    pub fn kept_pedestal(&self, offset: f64) -> f64 {
        let Some(gain) = self.fixed_gain().filter(|_| self.response == Response::Linear) else {
            return 0.0;
        };
        let noise = self.read_noise;
        let electrons = if noise > 0.0 { (KEPT_SIGMAS * noise).max(noise * noise) } else { 0.0 };
        (electrons * gain).ceil().min(offset.floor())
    }

    /// Returns the sensor of counts as they are read: of the pedestal, the part that is kept.
    #[must_use]
    pub fn as_read(mut self) -> Self {
        self.offset = self.kept_pedestal(self.offset);
        self
    }

    /// Estimates the incident photons per pixel and output frame linearly from counts: the sum of
    /// `frames` output frames of one pixel, dark counts subtracted, never negative. A saturated
    /// binary pixel is taken as one detection short of saturation (Ma et al. 2020, eq. 4).
    pub fn estimate_flux(&self, sum: f64, frames: u32, gain: f64, dark_per_frame: f64) -> f64 {
        self.estimate_signed_flux(sum, frames, gain, dark_per_frame).max(0.0)
    }

    /// Estimates as [`Self::estimate_flux`], negative where noise leaves less than the dark counts: means
    /// over pixels have no bias.
    pub fn estimate_signed_flux(
        &self,
        sum: f64,
        frames: u32,
        gain: f64,
        dark_per_frame: f64,
    ) -> f64 {
        let detections = match self.response {
            Response::Linear => {
                let counted = sum / (gain * f64::from(frames));
                match self.dead_time() {
                    0.0 => counted,
                    dead => echoes::detections_of_counted(counted, dead),
                }
            }
            Response::Binary => {
                let n = f64::from(self.frames_summed);
                let total = n * f64::from(frames);
                // Saturated: one short; a single binary frame has nothing shorter but a half.
                let ceiling = (total - 1.0).max(0.5);
                -n * (-sum.min(ceiling) / total).ln_1p()
            }
        };
        (detections - dark_per_frame) / self.quantum_efficiency
    }

    /// Checks every parameter against what a sensor can be.
    ///
    /// # Errors
    /// [`Error::Sensor`] for the first impossible value.
    pub fn validate(&self) -> Result<()> {
        let positive = 0.0..=f64::MAX;
        self.within("quantum_efficiency", self.quantum_efficiency, 0.0..=1.0)?;
        if self.quantum_efficiency == 0.0 {
            return Err(self.fault(
                "quantum_efficiency is 0".into(),
                "a sensor must see: use a value above 0",
            ));
        }
        self.within("dark", self.dark.value(), 0.0..=1e9)?;
        self.within("read_noise", self.read_noise, 0.0..=1e6)?;
        self.within("offset", self.offset, 0.0..=65_535.0)?;
        self.within("rolling_shutter", self.rolling_shutter, 0.0..=1.0)?;
        if let Some(threshold) = self.threshold {
            self.within("threshold", threshold, 0.0..=65_535.0)?;
            if self.response == Response::Linear {
                return Err(self.fault(
                    "a threshold on a linear sensor".into(),
                    "counting photons above a threshold makes binary frames: `response = \"binary\"`, `bits = 1`, `read_noise = 0`",
                ));
            }
        }
        if self.full_well.electrons().is_nan() || self.full_well.electrons() < 1.0 {
            return Err(self.fault(
                format!("full_well is {} e-", self.full_well.electrons()),
                "a well holds at least 1 electron; `full_well = \"unlimited\"` switches the limit off",
            ));
        }
        if let Gain::Fixed(gain) = self.gain {
            self.within("gain", gain, f64::MIN_POSITIVE..=1e6)?;
        }
        for (key, value) in [("fps", self.fps), ("pitch_um", self.pitch_um)] {
            if let Some(value) = value {
                self.within(key, value, positive.clone())?;
                if value == 0.0 {
                    return Err(self.fault(format!("{key} is 0"), "leave it out if it is unknown"));
                }
            }
        }
        self.validate_depth()?;
        self.defects.validate(self)?;
        if let Some(colour) = &self.colour {
            colour.validate(self)?;
        }
        self.dark_per_frame().map(drop)
    }

    fn validate_depth(&self) -> Result<()> {
        let (bits, summed) = (self.bits, self.frames_summed);
        match self.response {
            Response::Linear if !(1..=16).contains(&bits) => {
                Err(self.fault(format!("bits is {bits}"), "samples have 1 to 16 bits"))
            }
            Response::Linear if summed != 1 => Err(self.fault(
                format!("frames_summed is {summed} on a linear sensor"),
                "only binary frames are summed; raise `bits` or the light instead",
            )),
            Response::Binary if bits != 1 => Err(self.fault(
                format!("bits is {bits} on a binary sensor"),
                "a binary frame has 1 bit; more depth comes from `frames_summed` (7 for 3 bits)",
            )),
            Response::Binary if !(1..=65_535).contains(&summed) => {
                Err(self
                    .fault(format!("frames_summed is {summed}"), "sum 1 to 65535 binary frames"))
            }
            Response::Binary if self.read_noise != 0.0 => Err(self.fault(
                format!("read_noise is {} e- on a binary sensor", self.read_noise),
                "avalanches have no read noise: use 0, or `response = \"linear\"` with `bits = 1`",
            )),
            _ => Ok(()),
        }
    }

    pub(crate) fn within(
        &self,
        key: &str,
        value: f64,
        range: std::ops::RangeInclusive<f64>,
    ) -> Result<()> {
        if range.contains(&value) {
            return Ok(());
        }
        let (low, high) = (range.start(), range.end());
        let help = if *high >= f64::MAX {
            format!("`{key}` is a finite number of at least {low}")
        } else {
            format!("`{key}` lies between {low} and {high}")
        };
        Err(self.fault(format!("{key} is {value}"), &help))
    }

    pub(crate) fn fault(&self, what: String, help: &str) -> Error {
        Error::Sensor { what, place: format!("sensor `{}`", self.name), help: help.to_owned() }
    }
}
