//! Options for reading a capture, where its file does not say.

use qudi_core::Size;
use qudi_core::colour::FilterChoice;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::str::FromStr;

/// Options for reading a capture. Absent ones are read from the file or inferred.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReadOptions {
    /// Name of a format in [`FORMATS`](crate::codec::FORMATS).
    pub format: Option<String>,
    /// Order of the pixels in a packed byte.
    pub bit_order: Option<BitOrder>,
    /// Axis along which 8 pixels share a byte.
    pub pack_axis: Option<PackAxis>,
    /// Frame size, for files without a header and for packed rows whose width is no multiple of 8.
    pub size: Option<Size>,
    /// Orientation of the frames.
    pub orient: Option<Orientation>,
    /// Order of the axes, slowest first.
    pub axes: Option<Axes>,
    /// Colour channel to read, from 0; for a mosaic, the letter of its pattern.
    pub channel: Option<usize>,
    /// True to take the three planes of a colour capture for its colours, and to read the one of green where
    /// no channel is named.
    #[serde(skip)]
    pub full_colour: bool,
    /// Colour filter array in front of the pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cfa: Option<FilterChoice>,
    /// Name of the array, in a file that holds several.
    pub array: Option<String>,
    /// Binary frames averaged into a pixel value: `count = round(value * levels / full scale)`.
    pub levels: Option<u16>,
    /// Bits of a native count, where the file does not say.
    pub bits: Option<u8>,
    /// Pedestal in DN, subtracted from stored values; values below it count 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub offset: Option<f64>,
    /// Threshold in DN above the pedestal: values above it count 1, all others 0.
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
    /// Part of the turned frame to keep.
    pub crop: Option<Crop>,
    /// Native frames summed into one.
    pub sum: Option<u32>,
    /// Pixels to repair.
    pub mask: MaskChoice,
    /// Dark rates: a `.npy` or `.mat` map in counts per second, or a sensor file.
    pub dcr: Option<PathBuf>,
    /// True to drop an incomplete last frame instead of refusing the file.
    pub lenient: bool,
    /// Keep a part of the pedestal of a sensor with read noise, so that noise below zero is not cut off.
    #[serde(skip)]
    pub signed: bool,
}

/// Channel of green.
const GREEN: usize = 1;

impl ReadOptions {
    /// Returns the channel to read, out of `channels`: the one that is named, or green of three full planes.
    pub(crate) fn channel_of(&self, channels: usize) -> Option<usize> {
        self.channel.or(self.takes_colours(channels).then_some(GREEN))
    }

    /// Returns true if so many channels are taken for colours.
    pub(crate) fn takes_colours(&self, channels: usize) -> bool {
        self.full_colour && self.cfa.is_none() && channels == 3
    }

    /// Returns the options for reading a container. The channel of a mosaic is a plane of its pattern, not an
    /// axis of the array.
    pub(crate) fn of_container(&self, mosaic: bool) -> Self {
        let channel = self.channel.filter(|_| !mosaic);
        Self { channel, ..self.clone() }
    }
}

/// Order of the pixels in a packed byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BitOrder {
    /// The first pixel is the highest bit, as in `numpy.packbits`.
    Msb,
    /// The first pixel is the lowest bit.
    Lsb,
}

impl BitOrder {
    /// Returns the other order.
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

/// Orientation of stored frames.
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
    /// Returns the name of the orientation on the command line.
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
    /// Frames, rows, columns: the default.
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
    /// Returns the name of the order on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Thw => "thw",
            Self::Twh => "twh",
            Self::Hwt => "hwt",
            Self::Wht => "wht",
            Self::Htw => "htw",
            Self::Wth => "wth",
        }
    }

    /// Returns the position of the frame axis.
    pub(crate) fn frame_position(self) -> usize {
        match self {
            Self::Thw | Self::Twh => 0,
            Self::Htw | Self::Wth => 1,
            Self::Hwt | Self::Wht => 2,
        }
    }

    /// Returns the rows and columns of a frame of an array with extents `dims`, and the products of the
    /// extents before, at and after the frame axis.
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

    /// Returns true if columns are slower than rows.
    pub(crate) fn transposed(self) -> bool {
        matches!(self, Self::Twh | Self::Wht | Self::Wth)
    }

    /// Returns the same order, counted from the fastest axis.
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

/// The pixels that are repaired.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskChoice {
    /// Pixels that a sensor file or a dark map names; otherwise hot pixels found in the capture itself.
    #[default]
    Auto,
    /// No pixels.
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
