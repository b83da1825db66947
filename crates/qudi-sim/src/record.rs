//! The record beside every burst: what is needed to read it, and to make it again.

use crate::burst::BurstFormat;
use crate::error::{Result, SimError};
use crate::frame::Size;
use crate::light::Light;
use crate::sensor::Sensor;
use crate::simulate::Simulation;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Version of this layout.
pub const VERSION: u32 = 1;

/// Records are a few pages of JSON; anything much larger is something else.
const MAX_FILE: u64 = 1 << 24;

/// The record of a simulated burst, `NAME.npy.json`.
#[derive(Debug, Serialize, Deserialize)]
pub struct Record {
    /// Layout of this document.
    pub version: u32,
    /// Program that wrote it.
    pub program: String,
    /// How the burst lies on disk.
    pub burst: BurstLayout,
    /// The light that was found for the request.
    pub light: Light,
    /// Gain in DN/e-.
    pub gain: f64,
    /// Statistics of the clip: another value means that the input has changed.
    pub clip: ClipDigest,
    /// Everything asked for.
    pub simulation: Simulation,
}

/// How a burst lies on disk.
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
    /// Whether 8 pixels share a byte.
    pub bitpack: bool,
    /// The packed axis of `[frames][height][width]`.
    pub bitpack_dim: Option<u32>,
    /// `msb`: the first pixel is the highest bit.
    pub bitorder: Option<String>,
}

impl BurstLayout {
    /// The layout of a burst of `sensor`.
    pub fn new(format: BurstFormat, frames: u64, size: Size, sensor: &Sensor) -> Self {
        let packed = format == BurstFormat::NpyPacked;
        Self {
            format,
            frames,
            size,
            max_count: sensor.max_count(),
            bits: sensor.output_bits(),
            fps: sensor.fps.map(|fps| fps / f64::from(sensor.frames_summed)),
            bitpack: packed,
            bitpack_dim: packed.then_some(2),
            bitorder: packed.then(|| "msb".to_owned()),
        }
    }
}

/// Identifies the scene that was exposed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClipDigest {
    /// Mean image value.
    pub mean: f64,
    /// CRC-32 of all image values.
    pub crc32: u32,
}

impl Record {
    /// Reads a record.
    ///
    /// # Errors
    /// [`SimError`] if it cannot be read, is no record, or describes an impossible sensor.
    pub fn load(path: &Path) -> Result<Self> {
        let read = |e| SimError::io("read the record", path, e);
        let length = std::fs::metadata(path).map_err(read)?.len();
        if length > MAX_FILE {
            return Err(SimError::data(
                format!("a record of {length} bytes"),
                path,
                "name the .json beside a burst",
            ));
        }
        let bytes = std::fs::read(path).map_err(read)?;
        let record: Self = serde_json::from_slice(&bytes).map_err(|e| {
            SimError::data(
                format!("not the record of a burst: {e}"),
                path,
                "name the .json that `qudi simulate` wrote beside a burst",
            )
        })?;
        if record.version != VERSION {
            return Err(SimError::data(
                format!("a record of version {}, this program reads {VERSION}", record.version),
                path,
                "use the version of qudi that wrote it",
            ));
        }
        record.simulation.sensor.validate()?;
        Ok(record)
    }
}
