//! How many frames are summed: a number, or as the capture shows.

use super::number;
use std::str::FromStr;

/// Frames summed into one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sum {
    /// As many as light and motion want.
    Auto,
    /// So many.
    Frames(u32),
}

impl FromStr for Sum {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "auto" {
            return Ok(Self::Auto);
        }
        let frames = text.parse().ok().filter(|frames| number::SUM.contains(&u64::from(*frames)));
        let (least, most) = (number::SUM.start(), number::SUM.end());
        let frames: u32 = frames.ok_or(format!("give a number from {least} to {most}, or auto"))?;
        Ok(Self::Frames(frames))
    }
}
