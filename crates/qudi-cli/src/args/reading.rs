//! How captures are read: the same options for every command that reads one.

use super::{Sum, number};
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args as ClapArgs, ValueHint};
use qudi_core::Size;
use qudi_core::colour::FilterChoice;
use qudi_io::description::{Axes, BitOrder, Crop, MaskChoice, Orientation, PackAxis, ReadOptions};
use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};

/// Properties of a capture that its file may not tell.
#[derive(Clone, Debug, ClapArgs)]
#[group(skip)]
#[command(next_help_heading = "Reading captures")]
pub(crate) struct Reading {
    /// Format by name (`qudi info --formats`) [default: recognised]
    #[arg(long, value_name = "NAME")]
    format: Option<String>,
    /// Which bit of a byte is the first pixel
    #[arg(long, value_name = "ORDER", value_parser = words::<BitOrder>(&["msb", "lsb"]))]
    bitorder: Option<BitOrder>,
    /// Axis along which 8 pixels share a byte
    #[arg(long, value_name = "AXIS", value_parser = words::<PackAxis>(&["width", "height", "none"]))]
    pack_axis: Option<PackAxis>,
    /// Frame size, height first: for raw files, and packed rows whose width is no multiple of 8
    #[arg(long, value_name = "HxW")]
    size: Option<Size>,
    /// Turn frames; vendor: as the camera's own software shows them
    #[arg(long, value_name = "TURN", value_parser = words::<Orientation>(&["raw", "vendor", "rot90", "rot180", "rot270", "flip-h", "flip-v", "transpose"]))]
    orient: Option<Orientation>,
    /// Order of an array's axes (time, height, width), slowest first
    #[arg(long, value_name = "AXES", value_parser = words::<Axes>(&["thw", "twh", "hwt", "wht", "htw", "wth"]))]
    axes: Option<Axes>,
    /// Colour channel to read as gray, from 0; of a mosaic (--cfa), the pixels of a letter of its pattern
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<usize>(0..=4095))]
    channel: Option<usize>,
    /// Colour filter array: the colours of a tile row by row, and where the first tile begins, as in rggb@0,0
    /// or quad-rggb; or a picture of it in pure red, green, blue and white (.png)
    #[arg(long, value_name = "PATTERN[@Y,X]|FILE")]
    cfa: Option<FilterChoice>,
    /// Array (variable, data set) in a file that holds several
    #[arg(long, value_name = "NAME")]
    array: Option<String>,
    /// Values are means of N binary frames, full scale for all ones
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u16>(1..=65535))]
    levels: Option<u16>,
    /// Bits of a count, where the file does not say
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u8>(1..=16))]
    bits: Option<u8>,
    /// Pedestal of sCMOS, qCMOS and EMCCD counts in DN: subtracted; what lies below counts 0
    #[arg(long, value_name = "DN", allow_negative_numbers = true, value_parser = number::real(number::DN))]
    offset: Option<f64>,
    /// Count photons: a value more than this many DN above the pedestal is one detection
    #[arg(long, value_name = "DN", allow_negative_numbers = true, value_parser = number::real(number::DN))]
    threshold: Option<f64>,
    /// Bytes before the first frame of each raw file
    #[arg(long, value_name = "BYTES", allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=1 << 40))]
    header: Option<u64>,
    /// Bytes after the last frame of each raw file
    #[arg(long, value_name = "BYTES", allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=1 << 40))]
    trailer: Option<u64>,
    /// Frames in each raw file but the last
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u64>(number::COUNT))]
    frames_per_file: Option<u64>,
    /// First frame, from 0
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=1 << 40))]
    start: Option<u64>,
    /// One past the last frame
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u64>(number::COUNT))]
    end: Option<u64>,
    /// Rows and columns to keep after turning, as in 2:256,0:496
    #[arg(long, value_name = "Y0:Y1,X0:X1")]
    crop: Option<Crop>,
    /// Sum N frames into one (7 binary frames make 3 bits); auto: as many as light and motion want [default:
    /// auto for binary captures without a record, where frames are restored or described; else 1]
    #[arg(long, value_name = "N|auto", allow_negative_numbers = true)]
    sum: Option<Sum>,
    /// Pixels to repair: a .npy or image nonzero at bad ones, auto (found in the capture), or none
    #[arg(long, value_name = "FILE|auto|none")]
    mask: Option<MaskChoice>,
    /// Dark rates: a .npy or .mat map in counts per second, or a calibrated sensor file
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    dcr: Option<PathBuf>,
    /// Drop an incomplete last frame instead of refusing the file
    #[arg(long)]
    lenient: bool,
}

impl Reading {
    /// Returns the number of frames that are summed, if it is given.
    pub(crate) fn sum(&self) -> Option<Sum> {
        self.sum
    }

    /// Returns the files that are read in addition to the capture.
    pub(crate) fn files(&self) -> Vec<&Path> {
        let mask = match &self.mask {
            Some(MaskChoice::File(path)) => Some(path),
            _ => None,
        };
        let filter = match &self.cfa {
            Some(FilterChoice::Picture(path)) => Some(path),
            _ => None,
        };
        mask.into_iter().chain(&self.dcr).chain(filter).map(PathBuf::as_path).collect()
    }

    /// Returns the options; without --mask, pixels are treated as `mask` says.
    pub(crate) fn options(&self, mask: MaskChoice) -> ReadOptions {
        let given = self.clone();
        // A dark map names its hot pixels; asking for it asks for their repair.
        let mask = if given.dcr.is_some() { MaskChoice::Auto } else { mask };
        ReadOptions {
            format: given.format,
            bit_order: given.bitorder,
            pack_axis: given.pack_axis,
            size: given.size,
            orient: given.orient,
            axes: given.axes,
            channel: given.channel,
            array: given.array,
            levels: given.levels,
            bits: given.bits,
            cfa: given.cfa,
            offset: given.offset,
            threshold: given.threshold,
            header: given.header,
            trailer: given.trailer,
            frames_per_file: given.frames_per_file,
            start: given.start,
            end: given.end,
            crop: given.crop,
            sum: match given.sum {
                Some(Sum::Frames(frames)) => Some(frames),
                Some(Sum::Auto) | None => None,
            },
            mask: given.mask.unwrap_or(mask),
            dcr: given.dcr,
            lenient: given.lenient,
            signed: false,
            full_colour: false,
        }
    }
}

/// Returns a parser for one of some words, read as the type that serde names so.
pub(crate) fn words<T: DeserializeOwned + Clone + Send + Sync + 'static>(
    all: &'static [&'static str],
) -> impl TypedValueParser<Value = T> {
    PossibleValuesParser::new(all)
        .try_map(|word| serde_json::from_value::<T>(serde_json::Value::String(word)))
}
