//! Sizes of the network.

use super::hourglass::CoarseEntry;
use crate::config::{Rule, SIZES, are_widths, check, is_default, never};
use qudi_core::{Result, Size};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Pixels of a side that become channels before the network and pixels again after it.
pub(super) const FOLD: usize = 2;

/// Planes of an image at half the resolution.
pub(super) const IMAGE: usize = FOLD * FOLD;

/// Levels of the pyramids: half, a quarter and an eighth of the resolution.
pub(super) const LEVELS: usize = 3;

/// Sizes of the network that encodes a window once (docs/network.md).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WindowConfig {
    /// Channels of the pre-denoiser and of the U-Net at half, a quarter and an eighth of the resolution;
    /// multiples of 32 are fastest.
    pub widths: [usize; 3],
    /// Channels of the flow's networks at the same resolutions.
    pub flow: [usize; 3],
    /// Channels of the recurrent states of the fusion.
    pub state: usize,
    /// Residual blocks of the recurrent cells.
    pub cell_blocks: usize,
    /// Whether the stacks of the coarser levels of pre-denoiser and U-Net begin without a ReLU. Behind one,
    /// all units can be off for every input, and these levels learn no more.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub linear_entries: bool,
}

impl WindowConfig {
    /// Returns how the stacks of the coarser levels begin.
    pub(super) fn coarse_entry(&self) -> CoarseEntry {
        if self.linear_entries { CoarseEntry::Linear } else { CoarseEntry::Rectified }
    }

    /// Returns the number that height and width of the frames are multiples of.
    pub fn multiple(&self) -> usize {
        FOLD << (LEVELS - 1)
    }

    /// Estimates the bytes that restoring a window of `frames` frames of `size` takes on the processor at
    /// most: activations of the finest level.
    pub fn memory(&self, size: Size, frames: usize) -> u64 {
        const COPIES: f64 = 4.0;
        let cells = (size.pixels() * frames) as f64 / (FOLD * FOLD) as f64;
        let widths = (2 * self.widths[0] + 3 * self.state) as f64;
        let others = 50.0 * (1 << 20) as f64 + 80.0 * (size.pixels() * frames) as f64;
        (4.0 * COPIES * widths * cells + others) as u64
    }

    /// Checks the sizes. They come from weight files, too: nothing may be allocated from them before this.
    ///
    /// # Errors
    /// [`Error::Request`](qudi_core::Error::Request) with the key that is wrong.
    pub fn checked(self) -> Result<Self> {
        let rules: [Rule<'_>; 4] = [
            ("widths", are_widths(&self.widths), SIZES),
            ("flow", are_widths(&self.flow), SIZES),
            ("state", are_widths(&[self.state]), SIZES),
            ("cell_blocks", self.cell_blocks <= 16, "must be at most 16"),
        ];
        check(&rules)?;
        Ok(self)
    }
}
