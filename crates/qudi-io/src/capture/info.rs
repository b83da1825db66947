//! What is known about a capture, and how it is known.

use super::mosaic::Mosaic;
use super::options::{BitOrder, Orientation, PackAxis, ReadOptions};
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Result};
use serde::Serialize;

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
        self.reasons.iter().any(|reason| reason == crate::codec::RECORD)
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

/// What the user says of the depth, unless the file knows better.
pub(super) fn state_depth(info: &mut CaptureInfo, bits: u8) -> Result<()> {
    if !(1..=16).contains(&bits) {
        return Err(Error::request(format!("{bits} bits"), "bits", "counts have 1 to 16 bits"));
    }
    let max = ((1u32 << bits) - 1) as u16;
    match info.max_count {
        Some(known) if known != max => Err(Error::request(
            format!("{bits} bits, where the file has counts up to {known}"),
            "bits",
            "leave it out: the file knows its depth",
        )),
        _ => {
            info.max_count = Some(max);
            Ok(())
        }
    }
}

/// Who says how deep the counts of a capture are.
pub(super) fn depth_source(options: &ReadOptions, info: &CaptureInfo) -> &'static str {
    if options.levels.is_some() {
        "`levels`"
    } else if info.is_recorded() {
        "the record beside it"
    } else if options.bits.is_some() {
        "`bits`"
    } else {
        "the file itself"
    }
}

/// Refuses sums of no frames, of more than there are, and those that 16 bits do not hold.
pub(super) fn check_sum(sum: u32, frames: u64, info: &CaptureInfo) -> Result<()> {
    if sum == 0 || u64::from(sum) > frames {
        return Err(Error::request(
            format!("{sum} frames summed into one, of {frames}"),
            "sum",
            "sum between 1 and all frames",
        ));
    }
    if info.max_count.is_some_and(|max| u64::from(max) * u64::from(sum) > u64::from(u16::MAX)) {
        return Err(Error::request(
            format!("sums of {sum} frames do not fit into 16 bits"),
            "sum",
            "counts go up to 65535: sum fewer frames",
        ));
    }
    Ok(())
}
