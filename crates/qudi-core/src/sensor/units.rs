//! Sensor values that carry a unit or a rule: dark rate, full well, gain.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use std::fmt;

/// A number or a word, as both appear in TOML and on the command line.
#[derive(Deserialize, JsonSchema)]
#[serde(untagged)]
enum NumberOrText {
    Number(f64),
    Text(String),
}

/// Dark electrons per pixel: `1.6` is per native frame, `"7.5/s"` per second.
#[derive(Clone, Copy, Debug, PartialEq, JsonSchema)]
#[schemars(with = "NumberOrText")]
pub enum DarkRate {
    /// e- per pixel and native frame.
    PerFrame(f64),
    /// e- per pixel and second.
    PerSecond(f64),
}

impl DarkRate {
    /// Multiplies the rate by a factor.
    #[must_use]
    pub fn times(self, factor: f64) -> Self {
        match self {
            Self::PerFrame(v) => Self::PerFrame(v * factor),
            Self::PerSecond(v) => Self::PerSecond(v * factor),
        }
    }

    /// Returns the number without its unit.
    pub fn value(self) -> f64 {
        let (Self::PerFrame(v) | Self::PerSecond(v)) = self;
        v
    }
}

impl Default for DarkRate {
    fn default() -> Self {
        Self::PerFrame(0.0)
    }
}

impl fmt::Display for DarkRate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::PerFrame(v) => write!(f, "{v}"),
            Self::PerSecond(v) => write!(f, "{v}/s"),
        }
    }
}

impl std::str::FromStr for DarkRate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (number, per_second) = match text.strip_suffix("/s") {
            Some(number) => (number, true),
            None => (text, false),
        };
        let value: f64 = number
            .trim()
            .parse()
            .map_err(|_| format!("`{text}` is no dark rate: 1.6 is per frame, 7.5/s per second"))?;
        Ok(if per_second { Self::PerSecond(value) } else { Self::PerFrame(value) })
    }
}

/// Full-well capacity in electrons; `"unlimited"` for none.
#[derive(Clone, Copy, Debug, PartialEq, JsonSchema)]
#[schemars(with = "NumberOrText")]
pub struct FullWell(f64);

impl FullWell {
    /// Creates a capacity in e-; infinity for none.
    pub fn new(electrons: f64) -> Self {
        Self(electrons)
    }

    /// Returns the capacity in e-.
    pub fn electrons(self) -> f64 {
        self.0
    }
}

impl Default for FullWell {
    fn default() -> Self {
        Self(f64::INFINITY)
    }
}

impl fmt::Display for FullWell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_infinite() { f.write_str("unlimited") } else { write!(f, "{}", self.0) }
    }
}

impl std::str::FromStr for FullWell {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "unlimited" {
            return Ok(Self::default());
        }
        text.parse()
            .map(Self)
            .map_err(|_| format!("`{text}` is no full well: give electrons, or `unlimited`"))
    }
}

/// Gain in DN per e-, or the rule that sets it from the light.
#[derive(Clone, Copy, Debug, Default, PartialEq, JsonSchema)]
#[schemars(with = "NumberOrText")]
pub enum Gain {
    /// `0.5 * (2^bits - 1) / PPP`, as in the QUIVER simulator.
    Quiver,
    /// 1 DN per electron.
    #[default]
    Unit,
    /// Full scale at full well.
    Fwc,
    /// Half scale at the mean signal, dark counts included.
    Auto,
    /// A number of DN per e-.
    Fixed(f64),
}

impl fmt::Display for Gain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Quiver => f.write_str("quiver"),
            Self::Unit => f.write_str("unit"),
            Self::Fwc => f.write_str("fwc"),
            Self::Auto => f.write_str("auto"),
            Self::Fixed(gain) => write!(f, "{gain}"),
        }
    }
}

impl std::str::FromStr for Gain {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Ok(match text {
            "quiver" => Self::Quiver,
            "unit" => Self::Unit,
            "fwc" => Self::Fwc,
            "auto" => Self::Auto,
            number => Self::Fixed(number.parse().map_err(|_| {
                format!("`{text}` is no gain: give DN per electron, or quiver, unit, fwc, auto")
            })?),
        })
    }
}

macro_rules! number_or_text {
    ($type:ident, $from_number:expr, $as_number:expr) => {
        impl<'de> Deserialize<'de> for $type {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                match NumberOrText::deserialize(deserializer)? {
                    NumberOrText::Number(number) => Ok($from_number(number)),
                    NumberOrText::Text(text) => text.parse().map_err(de::Error::custom),
                }
            }
        }

        impl Serialize for $type {
            fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                match $as_number(*self) {
                    Some(number) => serializer.serialize_f64(number),
                    None => serializer.collect_str(self),
                }
            }
        }
    };
}

number_or_text!(DarkRate, DarkRate::PerFrame, |rate| match rate {
    DarkRate::PerFrame(v) => Some(v),
    DarkRate::PerSecond(_) => None,
});
number_or_text!(FullWell, FullWell, |well: FullWell| well.0.is_finite().then_some(well.0));
number_or_text!(Gain, Gain::Fixed, |gain| match gain {
    Gain::Fixed(v) => Some(v),
    _ => None,
});
