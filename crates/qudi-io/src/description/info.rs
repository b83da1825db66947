//! What is known about a capture, and how it is known.

use super::mosaic::Mosaic;
use super::options::{BitOrder, Orientation, PackAxis};
use qudi_core::sensor::Sensor;
use serde::Serialize;

/// Why a format is sure where a record of ours lies beside the file.
pub(crate) const RECORD: &str = "the record beside it";

/// How sure a format is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Certainty {
    /// It could be; so could others.
    Possible,
    /// Name, size and content agree.
    Likely,
    /// The file says so itself, or the user did.
    Certain,
}

impl Certainty {
    /// As a word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Possible => "possible",
            Self::Likely => "likely",
            Self::Certain => "certain",
        }
    }
}

/// Describes an opened capture: its format, depth, packing, rate and sensor.
#[derive(Clone, Debug, Serialize)]
pub struct CaptureInfo {
    /// Name of the format.
    pub format: &'static str,
    /// The format in words.
    pub title: &'static str,
    /// How sure that is.
    pub certainty: Certainty,
    /// Why the format was chosen.
    #[serde(rename = "evidence")]
    pub reasons: Vec<String>,
    /// Largest possible count of a native frame, if the file says.
    pub max_count: Option<u16>,
    /// Whether counts are sums of `max_count` binary frames (or one of them).
    pub binary: bool,
    /// How bits are packed, if they are.
    pub packing: Option<Packing>,
    /// Native frames per second, if the file says.
    pub fps: Option<f64>,
    /// The orientation that stored frames need to be seen as the camera's own software shows them.
    pub vendor: Orientation,
    /// The orientation in use.
    pub orient: Orientation,
    /// The sensor, if a record beside the file names it.
    #[serde(skip)]
    pub sensor: Option<Sensor>,
    /// Its gain in DN/e-, if a record says.
    pub gain: Option<f64>,
    /// Incident photons per pixel and native frame, if a record says.
    pub ppp: Option<f64>,
    /// Image value that receives `ppp` photons, if a record says.
    pub mean_level: Option<f64>,
    /// The colour filter array, if the file or the user says.
    pub cfa: Option<Mosaic>,
    /// The camera preset that this format belongs to.
    pub preset: Option<&'static str>,
    /// What the user should know.
    #[serde(rename = "remarks")]
    pub notes: Vec<String>,
}

/// Eight pixels to the byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Packing {
    /// Along which axis.
    pub axis: PackAxis,
    /// Which pixel comes first.
    pub order: BitOrder,
}

impl CaptureInfo {
    /// Whether a record beside the file describes it.
    pub fn is_recorded(&self) -> bool {
        self.reasons.iter().any(|reason| reason == RECORD)
    }

    /// A description with nothing but names; the rest is filled in by the format.
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
            gain: None,
            ppp: None,
            mean_level: None,
            cfa: None,
            preset: None,
            notes: Vec::new(),
        }
    }
}
