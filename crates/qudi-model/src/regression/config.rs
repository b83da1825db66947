//! Sizes of the regression.

use crate::aligned::AlignedNeighbours;
use crate::config::{Rule, SIZES, are_widths, check, is_default, never};
use qudi_burst::Alignments;
use qudi_core::{Result, Size};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Height and width of padded frames are multiples of this. Another value would change pixels at the right
/// and lower border.
const MULTIPLE: usize = 32;

/// The frames that the second pre-denoiser corrects, and that its inputs are aligned on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FirstFrames {
    /// Frames of the classical reference estimate, corrected by the first pre-denoiser.
    #[default]
    Refinement,
    /// Means that the network `window` predicts in one step; there is no first pre-denoiser.
    Diffusion,
}

/// Sizes of the regression. Both pre-denoisers have the same, but for the alignments of their neighbours.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegressionConfig {
    /// Pixels of a side that become channels before the network and pixels again after it.
    pub fold: usize,
    /// Channels.
    pub width: usize,
    /// Residual dense blocks.
    pub blocks: usize,
    /// Channels that each layer of a block adds.
    pub growth: usize,
    /// Neighbours that are aligned with each frame, the nearest ones.
    pub neighbours: usize,
    /// Channels of the layers that weight neighbours pixel by pixel.
    pub weight_channels: usize,
    /// Frames that the second pre-denoiser corrects: `refinement` or `diffusion`.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub first: FirstFrames,
}

impl RegressionConfig {
    /// Returns the neighbours that the first pre-denoiser sees. The reference estimate shows too little of
    /// single pixels to follow them.
    pub fn first_neighbours(&self) -> AlignedNeighbours {
        let alignments = Alignments::WithMatched;
        AlignedNeighbours { neighbours: self.neighbours, alignments }
    }

    /// Returns the neighbours that the second pre-denoiser sees.
    pub fn second_neighbours(&self) -> AlignedNeighbours {
        let alignments = Alignments::WithPerPixel;
        AlignedNeighbours { neighbours: self.neighbours, alignments }
    }

    /// Returns the number that height and width of padded frames are multiples of.
    #[allow(clippy::unused_self)] // as of the other network
    pub fn multiple(&self) -> usize {
        MULTIPLE
    }

    /// Estimates the bytes that restoring a window of `frames` frames takes on the processor at most, if the
    /// network sees tiles of `size`: inputs and activations of one frame, and planes of the whole window.
    pub fn memory(&self, size: Size, frames: usize) -> u64 {
        const PLANES: usize = 4;
        const WIDTHS: usize = 14;
        let planes = 4 + self.second_neighbours().standardized_planes();
        let cells = (size.pixels() / (self.fold * self.fold)) as f64;
        let inputs = (PLANES * planes * size.pixels()) as f64;
        let activations = ((self.blocks + WIDTHS) * self.width) as f64 * cells;
        let window = 50.0 * (1 << 20) as f64 + 80.0 * (size.pixels() * frames) as f64;
        (4.0 * (inputs + activations) + window) as u64
    }

    /// Checks the sizes. They come from weight files, too: nothing may be allocated from them before this.
    ///
    /// # Errors
    /// [`Error::Request`](qudi_core::Error::Request) with the key that is wrong.
    pub fn checked(self) -> Result<Self> {
        let rules: [Rule<'_>; 5] = [
            ("fold", matches!(self.fold, 1 | 2 | 4), "must be 1, 2 or 4"),
            ("width", are_widths(&[self.width, self.growth, self.weight_channels]), SIZES),
            ("width", self.width >= 2, "must be at least 2"),
            ("neighbours", (1..=64).contains(&self.neighbours), "must be from 1 to 64"),
            ("blocks", (1..=64).contains(&self.blocks), "must be from 1 to 64"),
        ];
        check(&rules)?;
        Ok(self)
    }
}
