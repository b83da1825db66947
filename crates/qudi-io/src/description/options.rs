//! What the user may say about a capture that its file does not.

use super::mosaic::Mosaic;
use qudi_core::Size;
use qudi_core::sensor::Sensor;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::str::FromStr;

/// Overrides for reading a capture. What is left out is read from the file or inferred.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReadOptions {
    /// Name of a format in [`FORMATS`](crate::codec::FORMATS).
    pub format: Option<String>,
    /// Which pixel of a packed byte comes first.
    pub bit_order: Option<BitOrder>,
    /// The axis along which 8 pixels share a byte.
    pub pack_axis: Option<PackAxis>,
    /// Frame size: for files without a header, and for packed rows whose width is no multiple of 8.
    pub size: Option<Size>,
    /// How frames are turned.
    pub orient: Option<Orientation>,
    /// Order of the axes, slowest first.
    pub axes: Option<Axes>,
    /// The colour channel to read, from 0; of a mosaic, the letter of its pattern.
    pub channel: Option<usize>,
    /// The colour filter array in front of the pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cfa: Option<Mosaic>,
    /// The array in a file that holds several.
    pub array: Option<String>,
    /// Pixel values are means of so many binary frames: `count = round(value * levels / full scale)`.
    pub levels: Option<u16>,
    /// Bits of a native count, where the file does not say.
    pub bits: Option<u8>,
    /// Pedestal in DN, subtracted from stored values; what lies below counts 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub offset: Option<f64>,
    /// Photon counting: a value more than this many DN above the pedestal counts 1, any other 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threshold: Option<f64>,
    /// Bytes before the first frame of every raw file.
    pub header: Option<u64>,
    /// Bytes after the last frame of every raw file.
    pub trailer: Option<u64>,
    /// Frames in each raw file but the last.
    pub frames_per_file: Option<u64>,
    /// First native frame.
    pub start: Option<u64>,
    /// One past the last native frame.
    pub end: Option<u64>,
    /// The part of the turned frame to keep.
    pub crop: Option<Crop>,
    /// Native frames summed into one.
    pub sum: Option<u32>,
    /// Pixels to repair.
    pub mask: MaskChoice,
    /// Dark rates: a `.npy` or `.mat` map in counts per second, or a sensor file.
    pub dcr: Option<PathBuf>,
    /// Drop an incomplete last frame instead of refusing the file.
    pub lenient: bool,
}

impl ReadOptions {
    /// The options of a container: behind a mosaic, the channel is one of its planes and none of an array's
    /// axes.
    pub(crate) fn of_container(&self, mosaic: bool) -> Self {
        let channel = self.channel.filter(|_| !mosaic);
        Self { channel, ..self.clone() }
    }
}

/// Which pixel of a packed byte comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BitOrder {
    /// The first pixel is the highest bit, as in `numpy.packbits`.
    Msb,
    /// The first pixel is the lowest bit.
    Lsb,
}

impl BitOrder {
    /// The other one.
    #[must_use]
    pub fn reversed(self) -> Self {
        match self {
            Self::Msb => Self::Lsb,
            Self::Lsb => Self::Msb,
        }
    }
}

impl std::fmt::Display for BitOrder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Msb => "MSB first",
            Self::Lsb => "LSB first",
        })
    }
}

/// The axis along which 8 pixels share a byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PackAxis {
    /// 8 columns, as photoncube and visionsim do by default.
    Width,
    /// 8 rows.
    Height,
    /// One sample per pixel: not packed.
    None,
}

/// How stored frames are turned to be upright.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Orientation {
    /// As stored.
    #[default]
    Raw,
    /// As the camera's own software shows it; formats know how.
    Vendor,
    /// A quarter turn to the left (`numpy.rot90`).
    Rot90,
    /// Half a turn.
    Rot180,
    /// A quarter turn to the right.
    Rot270,
    /// Left and right swapped.
    FlipH,
    /// Top and bottom swapped.
    FlipV,
    /// Rows and columns swapped.
    Transpose,
}

impl Orientation {
    /// Name as on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Raw => "raw",
            Self::Vendor => "vendor",
            Self::Rot90 => "rot90",
            Self::Rot180 => "rot180",
            Self::Rot270 => "rot270",
            Self::FlipH => "flip-h",
            Self::FlipV => "flip-v",
            Self::Transpose => "transpose",
        }
    }
}

/// Order of the axes of an array, slowest first, as in `thw`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axes {
    /// Frames, rows, columns: the usual one.
    #[default]
    Thw,
    /// Frames, columns, rows.
    Twh,
    /// Rows, columns, frames.
    Hwt,
    /// Columns, rows, frames.
    Wht,
    /// Rows, frames, columns.
    Htw,
    /// Columns, frames, rows.
    Wth,
}

impl Axes {
    /// Position of the frame axis.
    pub(crate) fn frame_position(self) -> usize {
        match self {
            Self::Thw | Self::Twh => 0,
            Self::Htw | Self::Wth => 1,
            Self::Hwt | Self::Wht => 2,
        }
    }

    /// Rows and columns of a frame of an array with these extents, and the product of the extents before the
    /// frame axis, of that axis, and after it.
    pub(crate) fn split(self, dims: [usize; 3]) -> ([usize; 2], [usize; 3]) {
        let at = self.frame_position();
        let product = |part: &[usize]| part.iter().fold(1, |n: usize, &d| n.saturating_mul(d));
        let layout = [product(&dims[..at]), dims[at], product(&dims[at + 1..])];
        let [slow, fast] = match at {
            0 => [dims[1], dims[2]],
            1 => [dims[0], dims[2]],
            _ => [dims[0], dims[1]],
        };
        (if self.transposed() { [fast, slow] } else { [slow, fast] }, layout)
    }

    /// Whether columns are slower than rows.
    pub(crate) fn transposed(self) -> bool {
        matches!(self, Self::Twh | Self::Wht | Self::Wth)
    }

    /// The same array with its axes named from the fastest.
    pub(crate) fn reversed(self) -> Self {
        match self {
            Self::Thw => Self::Wht,
            Self::Twh => Self::Hwt,
            Self::Hwt => Self::Twh,
            Self::Wht => Self::Thw,
            Self::Htw => Self::Wth,
            Self::Wth => Self::Htw,
        }
    }
}

/// Rows `top..bottom` and columns `left..right`, as in `2:256,0:496`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Crop {
    /// First row.
    pub top: usize,
    /// One past the last row.
    pub bottom: usize,
    /// First column.
    pub left: usize,
    /// One past the last column.
    pub right: usize,
}

impl FromStr for Crop {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let range = |part: &str| -> Option<(usize, usize)> {
            let (low, high) = part.split_once(':')?;
            let (low, high) = (low.trim().parse().ok()?, high.trim().parse().ok()?);
            (low < high).then_some((low, high))
        };
        let parts = text.split_once(',').and_then(|(y, x)| Some((range(y)?, range(x)?)));
        let ((top, bottom), (left, right)) = parts
            .ok_or("expected rows and columns as FIRST:END,FIRST:END, for example 2:256,0:496")?;
        Ok(Self { top, bottom, left, right })
    }
}

impl std::fmt::Display for Crop {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{},{}:{}", self.top, self.bottom, self.left, self.right)
    }
}

/// Which pixels are repaired.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskChoice {
    /// Those that a sensor file or a dark map names; else hot pixels found in the capture itself.
    #[default]
    Auto,
    /// None.
    None,
    /// A `.npy` or image of the frame's size, nonzero at bad pixels.
    File(PathBuf),
}

impl FromStr for MaskChoice {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text {
            "auto" => Self::Auto,
            "none" => Self::None,
            file => Self::File(file.into()),
        })
    }
}

/// The options, with the pedestal and the threshold of the sensor where they say nothing of either.
pub(crate) fn with_pedestal(options: &ReadOptions, sensor: Option<&Sensor>) -> ReadOptions {
    let mut options = options.clone();
    if options.offset.is_none()
        && options.threshold.is_none()
        && let Some(sensor) = sensor
    {
        options.offset = (sensor.offset > 0.0).then_some(sensor.offset);
        options.threshold = sensor.threshold;
    }
    options
}
