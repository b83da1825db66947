//! Descriptions of opened captures: what is known, and from where.

use super::options::{BitOrder, Orientation, PackAxis};
use qudi_core::colour::FilterChoice;
use qudi_core::sensor::Sensor;
use serde::Serialize;

/// Reason for a format that a record of ours next to the file names.
pub(crate) const RECORD: &str = "the record beside it";

/// Certainty of a recognised format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Certainty {
    /// It is possible, as other formats are.
    Possible,
    /// Name, size and content agree.
    Likely,
    /// The file says so itself, or the user did.
    Certain,
}

impl Certainty {
    /// Returns the certainty as a word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Possible => "possible",
            Self::Likely => "likely",
            Self::Certain => "certain",
        }
    }
}

/// An opened capture: its format, depth, packing, rate and sensor.
#[derive(Clone, Debug, Serialize)]
pub struct CaptureInfo {
    /// Name of the format.
    pub format: &'static str,
    /// Name of the format in words.
    pub title: &'static str,
    /// Certainty of the format.
    pub certainty: Certainty,
    /// Reasons for the format.
    #[serde(rename = "evidence")]
    pub reasons: Vec<String>,
    /// Largest possible count of a native frame, if the file says.
    pub max_count: Option<u16>,
    /// True if counts are sums of `max_count` binary frames (or single ones).
    pub binary: bool,
    /// Packing of the bits, if they are packed.
    pub packing: Option<Packing>,
    /// Native frames per second, if the file says.
    pub fps: Option<f64>,
    /// Orientation in which the camera's own software shows stored frames.
    pub vendor: Orientation,
    /// Orientation in use.
    pub orient: Orientation,
    /// Sensor, if a record next to the file names it.
    #[serde(skip)]
    pub sensor: Option<Sensor>,
    /// DN of every count that are pedestal: kept, so that noise below zero is not cut off.
    pub pedestal: f64,
    /// Gain of the sensor in DN/e-, if a record says.
    pub gain: Option<f64>,
    /// Incident photons per pixel and native frame, if a record says.
    pub ppp: Option<f64>,
    /// Image value that receives `ppp` photons, if a record says.
    pub mean_level: Option<f64>,
    /// Colour filter array, if the file, the user or the sensor names it.
    pub cfa: Option<FilterChoice>,
    /// True if the file holds red, green and blue at every pixel, and colours were asked for.
    pub full_colour: bool,
    /// Camera preset that this format belongs to.
    pub preset: Option<&'static str>,
    /// Frames before which numbers are missing, and how many frames that are.
    #[serde(skip)]
    pub gaps: Vec<(u64, u64)>,
    /// Notes for the user.
    #[serde(rename = "remarks")]
    pub notes: Vec<String>,
}

/// The order of eight pixels in a byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Packing {
    /// Axis along which pixels share a byte.
    pub axis: PackAxis,
    /// Order of the pixels in a byte.
    pub order: BitOrder,
}

impl CaptureInfo {
    /// Returns exposures per second, if the file says: of binary frames where counts are sums of them, which
    /// dark rates are told of.
    pub fn exposure_rate(&self) -> Option<f64> {
        let summed = self.max_count.filter(|_| self.binary).unwrap_or(1);
        self.fps.map(|fps| fps * f64::from(summed))
    }

    /// Returns true if a record next to the file describes it.
    pub fn is_recorded(&self) -> bool {
        self.reasons.iter().any(|reason| reason == RECORD)
    }

    /// Creates a description of a format by name; the format fills in the rest.
    pub(crate) fn new(format: &'static str, title: &'static str) -> Self {
        Self {
            format,
            title,
            certainty: Certainty::Certain,
            reasons: Vec::new(),
            max_count: None,
            binary: false,
            packing: None,
            fps: None,
            vendor: Orientation::Raw,
            orient: Orientation::Raw,
            sensor: None,
            pedestal: 0.0,
            gain: None,
            full_colour: false,
            ppp: None,
            mean_level: None,
            cfa: None,
            preset: None,
            gaps: Vec::new(),
            notes: Vec::new(),
        }
    }
}
