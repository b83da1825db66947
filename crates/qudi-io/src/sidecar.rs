//! Records of bursts: how to read a burst, and how to make it again.

use crate::description::ReadOptions;
use crate::writer::BurstFormat;
use qudi_core::Light;
use qudi_core::Size;
use qudi_core::colour::FilterChoice;
use qudi_core::limits::RECORD_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Result};
use qudi_sim::Simulation;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

pub use crate::writer::beside;

/// Version of this layout.
pub const VERSION: u32 = 1;

/// The record of a simulated burst, `NAME.npy.json`.
#[derive(Debug, Serialize, Deserialize)]
pub struct Record {
    /// Layout of this document.
    pub version: u32,
    /// Program that wrote it.
    pub program: String,
    /// Layout of the burst on disk.
    pub burst: BurstLayout,
    /// Light that was resolved for the request.
    pub light: Light,
    /// Gain in DN/e-.
    pub gain: f64,
    /// Statistics of the clip: another value shows that the input has changed.
    pub clip: ClipDigest,
    /// The request.
    pub simulation: Simulation,
}

/// The layout of a burst on disk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BurstLayout {
    /// File format.
    pub format: BurstFormat,
    /// Output frames.
    pub frames: u64,
    /// Frame size.
    #[serde(flatten)]
    pub size: Size,
    /// Largest possible count.
    pub max_count: u16,
    /// Bits that a count needs.
    pub bits: u8,
    /// Output frames per second, if the sensor's rate is known.
    pub fps: Option<f64>,
    /// True if 8 pixels share a byte.
    pub bitpack: bool,
    /// Packed axis of `[frames][height][width]`.
    pub bitpack_dim: Option<u32>,
    /// Bit order; `msb` if the first pixel is the highest bit.
    pub bitorder: Option<String>,
}

impl BurstLayout {
    /// Returns the layout of a burst of `sensor`.
    pub fn new(format: BurstFormat, frames: u64, size: Size, sensor: &Sensor) -> Self {
        let fps = sensor.fps.map(|fps| fps / f64::from(sensor.frames_summed));
        Self::of_counts(format, frames, size, sensor.max_count(), fps)
    }

    /// Returns the layout of a burst of counts up to `max_count`.
    pub fn of_counts(
        format: BurstFormat,
        frames: u64,
        size: Size,
        max_count: u16,
        fps: Option<f64>,
    ) -> Self {
        let packed = format == BurstFormat::NpyPacked;
        Self {
            format,
            frames,
            size,
            max_count,
            bits: (16 - max_count.leading_zeros()) as u8,
            fps,
            bitpack: packed,
            bitpack_dim: packed.then_some(2),
            bitorder: packed.then(|| "msb".to_owned()),
        }
    }
}

/// A digest of the scene that was exposed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClipDigest {
    /// Mean image value.
    pub mean: f64,
    /// CRC-32 of all image values.
    pub crc32: u32,
}

/// The record of a converted capture.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Conversion {
    /// Layout of this document.
    pub version: u32,
    /// Program that wrote it.
    pub program: String,
    /// Layout of the burst on disk.
    pub burst: BurstLayout,
    /// True if counts are sums of `max_count` binary frames.
    pub binary: bool,
    /// Camera preset of the capture's format.
    pub preset: Option<String>,
    /// Path of the capture.
    pub capture: PathBuf,
    /// Format of the capture.
    pub format: String,
    /// Options with which it was read.
    pub read: ReadOptions,
    /// Colour filter of the converted frames.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cfa: Option<FilterChoice>,
    /// Sensor of the converted frames, if the capture's record names it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<Sensor>,
    /// Gain in DN/e-, if the capture's record knows it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
    /// Light of the converted frames, if the capture's record knows it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub light: Option<Light>,
}

/// A record of either kind.
#[derive(Debug)]
pub enum Sidecar {
    /// Written by `qudi simulate`.
    Simulated(Box<Record>),
    /// Written by `qudi convert`.
    Converted(Box<Conversion>),
}

impl Sidecar {
    /// Reads a record of either kind.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read or is no record.
    pub fn load(path: &Path) -> Result<Self> {
        let document: serde_json::Value = parse(&read_file(path)?, path)?;
        if document.get("capture").is_none() {
            return Ok(Self::Simulated(Box::new(Record::load(path)?)));
        }
        let conversion: Conversion = serde_json::from_value(document).map_err(|e| {
            Error::data(
                format!("not the record of a converted capture: {e}"),
                path,
                "convert the capture again",
            )
        })?;
        check_version(conversion.version, path)?;
        if let Some(sensor) = &conversion.sensor {
            sensor.validate()?;
        }
        Ok(Self::Converted(Box::new(conversion)))
    }
}

impl Record {
    /// Reads a record.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read, is no record, or describes an impossible sensor.
    pub fn load(path: &Path) -> Result<Self> {
        let record: Self = parse(&read_file(path)?, path)?;
        check_version(record.version, path)?;
        record.simulation.sensor.validate()?;
        Ok(record)
    }
}

/// Returns the error of a record that contradicts the file at `path`.
pub(crate) fn contradiction(recorded: &str, found: &str, path: &Path) -> Error {
    Error::data(
        format!("the record beside it describes {recorded}, and {found}"),
        path,
        format!("remove {} if it belongs to another burst", beside(path).display()),
    )
}

fn read_file(path: &Path) -> Result<Vec<u8>> {
    read_limited(path, RECORD_BYTES, "read the record")
}

fn parse<T: serde::de::DeserializeOwned>(bytes: &[u8], path: &Path) -> Result<T> {
    // Editors may begin a file with a byte order mark.
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    serde_json::from_slice(bytes).map_err(|e| {
        Error::data(
            format!("not the record of a burst: {e}"),
            path,
            "name the .json that `qudi simulate` wrote beside a burst",
        )
    })
}

fn check_version(version: u32, path: &Path) -> Result<()> {
    if version == VERSION {
        return Ok(());
    }
    Err(Error::data(
        format!("a record of version {version}, this program reads {VERSION}"),
        path,
        "use the version of qudi that wrote it",
    ))
}
