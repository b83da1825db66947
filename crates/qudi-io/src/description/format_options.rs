//! Options that apply to some formats only: a format refuses by name each option that it does not take.

use super::options::{PackAxis, ReadOptions};
use qudi_core::{Error, Result};

/// An option that only some formats take. Turning, cropping, summing and repairing apply to all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FormatOption {
    /// Order of the axes.
    Axes,
    /// The colour channel to read.
    Channel,
    /// The array in a file that holds several.
    Array,
    /// Which pixel of a packed byte comes first.
    BitOrder,
    /// The axis along which 8 pixels share a byte.
    PackAxis,
    /// Frame size.
    Size,
    /// Binary frames averaged into each value.
    Levels,
    /// Bytes before the first frame.
    Header,
    /// Bytes after the last frame.
    Trailer,
    /// Frames in each file of a folder.
    FramesPerFile,
    /// The pedestal of the values.
    Offset,
    /// Photon counting above a threshold.
    Threshold,
}

impl FormatOption {
    /// All options, in the order in which they are checked.
    pub const ALL: [Self; 12] = [
        Self::Axes,
        Self::Channel,
        Self::Array,
        Self::BitOrder,
        Self::PackAxis,
        Self::Size,
        Self::Levels,
        Self::Header,
        Self::Trailer,
        Self::FramesPerFile,
        Self::Offset,
        Self::Threshold,
    ];

    /// Returns the name of the option, as messages print it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Axes => "axes",
            Self::Channel => "channel",
            Self::Array => "array",
            Self::BitOrder => "bitorder",
            Self::PackAxis => "pack_axis",
            Self::Size => "size",
            Self::Levels => "levels",
            Self::Header => "header",
            Self::Trailer => "trailer",
            Self::FramesPerFile => "frames_per_file",
            Self::Offset => "offset",
            Self::Threshold => "threshold",
        }
    }

    /// Returns true if `options` give it.
    fn is_given(self, options: &ReadOptions) -> bool {
        match self {
            Self::Axes => options.axes.is_some(),
            Self::Channel => options.channel.is_some(),
            Self::Array => options.array.is_some(),
            Self::BitOrder => options.bit_order.is_some(),
            Self::PackAxis => options.pack_axis.is_some(),
            Self::Size => options.size.is_some(),
            Self::Levels => options.levels.is_some(),
            Self::Header => options.header.is_some(),
            Self::Trailer => options.trailer.is_some(),
            Self::FramesPerFile => options.frames_per_file.is_some(),
            Self::Offset => options.offset.is_some(),
            Self::Threshold => options.threshold.is_some(),
        }
    }
}

/// Refuses the first of `options` that is not in `taken`; `title` names the format in the message.
pub(crate) fn refuse_others(
    options: &ReadOptions,
    taken: &[FormatOption],
    title: &str,
) -> Result<()> {
    let other = FormatOption::ALL.into_iter().find(|o| o.is_given(options) && !taken.contains(o));
    let Some(other) = other else { return Ok(()) };
    let names: Vec<_> = taken.iter().map(|option| format!("`{}`", option.name())).collect();
    let help = if names.is_empty() {
        "leave it out, or name the right `format`".to_owned()
    } else {
        format!("leave it out, or name the right `format`; this one takes {}", names.join(", "))
    };
    Err(not_applicable(other, title, help))
}

/// Refuses options on packed bits for data that are not packed.
pub(crate) fn refuse_packing(options: &ReadOptions, title: &str) -> Result<()> {
    let packed = options.pack_axis.is_some_and(|axis| axis != PackAxis::None);
    let option = match (packed, options.bit_order) {
        (true, _) => FormatOption::PackAxis,
        (false, Some(_)) => FormatOption::BitOrder,
        (false, None) => return Ok(()),
    };
    let help = "only packed bits have an order: leave it out, or name the axis with `pack_axis`";
    Err(not_applicable(option, title, help.to_owned()))
}

fn not_applicable(option: FormatOption, title: &str, help: String) -> Error {
    let name = option.name();
    Error::request(format!("`{name}` does not apply to {title}"), name, help)
}
