//! Sizes of the diffusion.

use crate::config::{Rule, SIZES, are_widths, check, is_default, never};
use qudi_core::{Result, Size};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sizes of the whole network (docs/network.md).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DiffusionConfig {
    /// Pixels of a side that become channels before the network and pixels again after it.
    pub fold: usize,
    /// Pre-denoiser.
    pub pre: PreConfig,
    /// Spatio-temporal features.
    pub features: FeaturesConfig,
    /// Optical flow.
    pub flow: FlowConfig,
    /// Temporal fusion.
    pub fusion: FusionConfig,
    /// U-Net.
    pub unet: UNetConfig,
}

/// What the features of the noisy image see.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum NoisyFeatures {
    /// The noisy image itself, as in the paper.
    Image,
    /// Its difference from the pre-denoised image, in sigmas.
    #[default]
    Residual,
}

/// What the networks of the flow see of a frame and of its neighbour, warped along the flow so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FlowInputs {
    /// Both images, as in the paper.
    #[default]
    Images,
    /// The frame's detail and the difference of both images, in units of the contrast around.
    Contrast,
}

/// The output of the U-Net.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum UNetPrediction {
    /// The clean image itself, as in the paper.
    X0,
    /// A correction of the pre-denoised image, in sigmas of its errors, from inputs of unit variance (Karras
    /// et al. 2022). The noise reaches the prediction through the network alone.
    Correction,
}

/// Sizes of the pre-denoiser.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PreConfig {
    /// Channels.
    pub width: usize,
    /// Residual dense blocks.
    pub blocks: usize,
    /// Channels that each layer of a block adds.
    pub growth: usize,
}

/// Channels of the spatio-temporal features on three levels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FeaturesConfig {
    /// Channels of the measurements' features.
    pub low: [usize; 3],
    /// Channels of the noisy image's features.
    pub high: [usize; 3],
    /// What the noisy image's features see.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub noisy: NoisyFeatures,
}

/// Sizes of the flow network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FlowConfig {
    /// Pixels of a side of one cell of the finest flow.
    pub scale: usize,
    /// Levels of the pyramid.
    pub levels: usize,
    /// How many of them, from the coarsest, have a network.
    pub networks: usize,
    /// Channels of the layers of a level's network but the last.
    pub widths: [usize; 4],
    /// Reverse steps, from 1, that estimate the flow again; others keep the last one.
    pub steps: Vec<usize>,
    /// What the networks see of a frame and its neighbour.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub inputs: FlowInputs,
}

/// Sizes of the fusion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FusionConfig {
    /// Level of the recurrent state.
    pub level: usize,
    /// Channels of the fused features on three levels.
    pub widths: [usize; 3],
    /// Channels that each layer of the recurrent cell adds.
    pub growth: usize,
}

/// Sizes of the U-Net.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct UNetConfig {
    /// Channels of the first level.
    pub width: usize,
    /// Channels of every level in terms of `width`.
    pub multipliers: Vec<usize>,
    /// Residual blocks of a level, in the encoder and in the decoder.
    pub blocks: usize,
    /// Levels with attention besides the middle.
    pub attention: Vec<usize>,
    /// Size of the embedding of timestep and sensor.
    pub embedding: usize,
    /// Its output.
    pub predicts: UNetPrediction,
}

impl DiffusionConfig {
    /// Returns the number that height and width of the frames are multiples of.
    pub fn multiple(&self) -> usize {
        let network = self.fold << (self.unet.multipliers.len().max(3) - 1);
        network.max(self.flow.scale << (self.flow.levels - 1))
    }

    /// Estimates the bytes that restoring a window of `frames` frames of `size` takes on the processor at
    /// most: activations of the finest level, `PLANES` times its widths at once.
    pub fn memory(&self, size: Size, frames: usize) -> u64 {
        const PLANES: f64 = 6.5;
        let widths = self.unet.width + self.fusion.widths[0] + self.pre.width;
        let cells = (size.pixels() * frames) as f64 / (self.fold * self.fold) as f64;
        // What the program holds besides, planes of the whole window among it.
        let others = 50.0 * (1 << 20) as f64 + 80.0 * (size.pixels() * frames) as f64;
        (4.0 * PLANES * widths as f64 * cells + others) as u64
    }

    /// Checks the sizes. They come from weight files, too: nothing may be allocated from them before this.
    ///
    /// # Errors
    /// [`Error::Request`](qudi_core::Error::Request) with the key that is wrong.
    pub fn checked(self) -> Result<Self> {
        let levels = self.unet.multipliers.len();
        let channels: Vec<usize> =
            self.unet.multipliers.iter().map(|m| m.saturating_mul(self.unet.width)).collect();
        let features = [self.features.low, self.features.high].concat();
        let attention = self.unet.attention.iter().all(|&level| level < levels);
        let embedding = self.unet.embedding;
        let rules: [Rule<'_>; 17] = [
            ("fold", matches!(self.fold, 1 | 2 | 4), "must be 1, 2 or 4"),
            ("pre", are_widths(&[self.pre.width, self.pre.growth]), SIZES),
            ("pre.blocks", (1..=64).contains(&self.pre.blocks), "must be from 1 to 64"),
            ("features", are_widths(&features), SIZES),
            ("flow.scale", matches!(self.flow.scale, 1 | 2 | 4 | 8), "must be 1, 2, 4 or 8"),
            ("flow.levels", (1..=6).contains(&self.flow.levels), "must be from 1 to 6"),
            (
                "flow.networks",
                (1..=self.flow.levels).contains(&self.flow.networks),
                "must be from 1 to flow.levels",
            ),
            ("flow.widths", are_widths(&self.flow.widths), SIZES),
            ("flow.steps", self.flow.steps.contains(&1), "must contain the first step, 1"),
            ("fusion.level", self.fusion.level < 3, "must be 0, 1 or 2"),
            ("fusion.widths", are_widths(&self.fusion.widths), SIZES),
            ("fusion.growth", are_widths(&[self.fusion.growth]), SIZES),
            ("unet.multipliers", (1..=6).contains(&levels), "must be one to six numbers"),
            ("unet.width", are_widths(&channels), SIZES),
            ("unet.blocks", (1..=16).contains(&self.unet.blocks), "must be from 1 to 16"),
            ("unet.attention", attention, "must name levels of the network, from 0"),
            (
                "unet.embedding",
                (4..=4096).contains(&embedding) && embedding.is_multiple_of(2),
                "must be an even number from 4 to 4096",
            ),
        ];
        check(&rules)?;
        Ok(self)
    }
}

#[cfg(test)]
mod tests {
    use crate::config::NetworkConfig;

    #[test]
    fn rejects_invalid_sizes_by_key() {
        let NetworkConfig::Diffusion(mut config) = NetworkConfig::preset("paper-mini").unwrap()
        else {
            panic!("paper-mini is a diffusion");
        };
        config.unet.embedding = 7;
        let error = config.checked().unwrap_err();
        assert!(error.to_string().contains("unet.embedding"), "{error}");
    }
}
