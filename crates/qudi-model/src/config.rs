//! Sizes of the network, read from TOML; the presets.

use crate::conditioning::AlignedNeighbours;
use qudi_burst::Alignments;
use qudi_core::{Error, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sizes of the whole network (docs/network.md).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Pixels of a side that become channels before the network and pixels again after it.
    pub fold: usize,
    /// What the network starts from.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub reference: ReferenceKind,
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
    /// Parts of the method that are left out, to measure what they are worth.
    #[serde(default, alias = "without", skip_serializing_if = "Vec::is_empty")]
    #[schemars(skip_serializing_if = "never")]
    pub ablate: Vec<Part>,
}

/// What the network starts from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ReferenceKind {
    /// Counts alone, as in the paper: the pre-denoiser sees one frame.
    None,
    /// The reference estimate of the whole burst, and neighbours aligned on it.
    #[default]
    QbpRefined,
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

/// What the output of the U-Net is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum UNetPrediction {
    /// The clean image itself, as in the paper.
    X0,
    /// A correction of the pre-denoised image with inputs and output of unit variance (Karras et al. 2022).
    #[default]
    Edm,
    /// A correction of the pre-denoised image, in sigmas of its errors. Inputs are those of `Edm`; of the noise
    /// nothing reaches the prediction but through the network.
    Correction,
}

/// A part of the method that can be left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// The forward model: the measurement of every estimate by the sensor model.
    #[serde(alias = "physics")]
    ForwardModel,
    /// Optical flow: neighbours are taken as they are.
    Flow,
    /// Temporal fusion: every frame is restored from itself alone.
    Fusion,
    /// The previous estimate as an input.
    SelfConditioning,
    /// The mean level of the image as an input.
    #[serde(alias = "exposure")]
    MeanLevel,
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
    /// Neighbours that are aligned with each frame, the nearest ones; none without a reference estimate.
    #[serde(default)]
    pub neighbours: usize,
    /// Alignments of each neighbour: by the selected motion; with 2 also as matched frame by frame; with 3
    /// also pixel by pixel, but only on frames that a refinement stage has restored.
    #[serde(default = "one", alias = "motions", skip_serializing_if = "is_one")]
    #[schemars(skip_serializing_if = "never")]
    pub alignments: usize,
    /// Channels of the layers that weight neighbours pixel by pixel; 0 for no such layers.
    #[serde(default, alias = "trust", skip_serializing_if = "is_zero")]
    #[schemars(skip_serializing_if = "never")]
    pub weight_channels: usize,
    /// Pre-denoisers, one after the other. All but the last are refinement stages: the window is aligned
    /// again on what each of them restores.
    #[serde(default = "one", alias = "rounds", skip_serializing_if = "is_one")]
    #[schemars(skip_serializing_if = "never")]
    pub stages: usize,
    /// Whether the last of them predicts the uncertainty of its frames.
    #[serde(default, alias = "error", skip_serializing_if = "is_false")]
    #[schemars(skip_serializing_if = "never")]
    pub uncertainty: bool,
}

impl PreConfig {
    /// The sizes of the pre-denoiser of a refinement stage, which sees what the only one of a network would
    /// see.
    #[must_use]
    pub fn stage(&self) -> Self {
        Self { stages: 1, ..self.clone() }
    }

    /// The neighbours that are aligned with each frame.
    pub fn aligned_neighbours(&self) -> AlignedNeighbours {
        let alignments = match self.alignments {
            1 => Alignments::Selected,
            // The reference estimate shows too little of single pixels to follow them.
            3 if self.stages > 1 => Alignments::WithPerPixel,
            _ => Alignments::WithMatched,
        };
        AlignedNeighbours { neighbours: self.neighbours, alignments }
    }
}

fn one() -> usize {
    1
}

fn yes() -> bool {
    true
}

#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_true(switch: &bool) -> bool {
    *switch
}

/// Schemas state all defaults, those too that are not written into files.
fn never<T>(_: &T) -> bool {
    false
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_one(number: &usize) -> bool {
    *number == 1
}

#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_zero(number: &usize) -> bool {
    *number == 0
}

#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_false(switch: &bool) -> bool {
    !switch
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
    /// Whether steps of Lucas and Kanade register the reference estimate on every level before the network
    /// corrects the flow; without, SPyNet alone estimates it.
    #[serde(default = "yes", skip_serializing_if = "is_true")]
    #[schemars(skip_serializing_if = "never")]
    pub registration: bool,
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
    /// Whether the middle also attends over the frames of every cell.
    pub temporal: bool,
    /// Size of the embedding of timestep and sensor.
    pub embedding: usize,
    /// What its output is.
    #[serde(default, skip_serializing_if = "is_default")]
    #[schemars(skip_serializing_if = "never")]
    pub predicts: UNetPrediction,
}

/// The file of a preset.
#[derive(Deserialize)]
struct Document {
    network: NetworkConfig,
}

/// Names and texts of the presets, smallest first.
pub const PRESETS: &[(&str, &str)] = &[
    ("tiny", include_str!("../../../configs/tiny.toml")),
    ("small", include_str!("../../../configs/small.toml")),
    ("paper-mini", include_str!("../../../configs/paper-mini.toml")),
    ("paper", include_str!("../../../configs/paper.toml")),
];

impl NetworkConfig {
    /// A preset by name.
    ///
    /// # Errors
    /// [`Error::Request`] if there is none of that name.
    pub fn preset(name: &str) -> Result<Self> {
        let Some((_, text)) = PRESETS.iter().find(|preset| preset.0 == name) else {
            let names: Vec<_> = PRESETS.iter().map(|preset| preset.0).collect();
            let help = format!("there are {}", names.join(", "));
            return Err(Error::request(format!("no preset named `{name}`"), "preset", help));
        };
        Self::parse(text, name)
    }

    /// The `[network]` table of a TOML document; `place` names it in errors.
    ///
    /// # Errors
    /// [`Error::Request`] if there is none, or a key of it is wrong.
    pub fn parse(text: &str, place: &str) -> Result<Self> {
        let document: Document = toml::from_str(text)
            .map_err(|e| Error::request(e.message(), place, "correct the [network] table"))?;
        document.network.checked()
    }

    /// Whether a part is left out.
    pub fn ablates(&self, part: Part) -> bool {
        self.ablate.contains(&part)
    }

    /// Height and width of the frames are multiples of this.
    pub fn multiple(&self) -> usize {
        let network = self.fold << (self.unet.multipliers.len().max(3) - 1);
        network.max(self.flow.scale << (self.flow.levels - 1))
    }

    /// The sizes, if a network can be built from them.
    ///
    /// # Errors
    /// [`Error::Request`] with the key that is wrong. Sizes come from weight files, too: nothing may be
    /// allocated from them before this.
    pub fn checked(self) -> Result<Self> {
        let levels = self.unet.multipliers.len();
        let widths = |widths: &[usize]| widths.iter().all(|&width| (1..=4096).contains(&width));
        let channels = self.unet.multipliers.iter().map(|m| m.saturating_mul(self.unet.width));
        let has_reference = self.reference != ReferenceKind::None;
        let pre = &self.pre;
        let rules = [
            (
                "pre.neighbours",
                has_reference || pre.neighbours == 0,
                "must be 0 where network.reference is \"none\": nothing aligns neighbours",
            ),
            (
                "pre",
                has_reference
                    || (pre.alignments == 1 && pre.weight_channels == 0 && pre.stages == 1),
                "can have no alignments, weight_channels or stages where network.reference is \"none\"",
            ),
            (
                "flow.registration",
                has_reference || !self.flow.registration,
                "must be false where network.reference is \"none\": it registers the reference estimate",
            ),
            ("fold", matches!(self.fold, 1 | 2 | 4), "must be 1, 2 or 4"),
            ("pre", widths(&[self.pre.width, self.pre.growth]), SIZES),
            ("pre.neighbours", self.pre.neighbours <= 64, "must be at most 64"),
            ("pre.alignments", (1..=3).contains(&self.pre.alignments), "must be 1, 2 or 3"),
            ("pre.weight_channels", self.pre.weight_channels <= 4096, "must be at most 4096"),
            ("pre.stages", (1..=4).contains(&self.pre.stages), "must be from 1 to 4"),
            ("pre.blocks", (1..=64).contains(&self.pre.blocks), "must be from 1 to 64"),
            ("features", widths(&[self.features.low, self.features.high].concat()), SIZES),
            ("flow.scale", matches!(self.flow.scale, 1 | 2 | 4 | 8), "must be 1, 2, 4 or 8"),
            ("flow.levels", (1..=6).contains(&self.flow.levels), "must be from 1 to 6"),
            (
                "flow.networks",
                (1..=self.flow.levels).contains(&self.flow.networks),
                "must be from 1 to flow.levels",
            ),
            ("flow.widths", widths(&self.flow.widths), SIZES),
            ("flow.steps", self.flow.steps.contains(&1), "must contain the first step, 1"),
            ("fusion.level", self.fusion.level < 3, "must be 0, 1 or 2"),
            ("fusion.widths", widths(&self.fusion.widths), SIZES),
            ("fusion.growth", widths(&[self.fusion.growth]), SIZES),
            ("unet.multipliers", (1..=6).contains(&levels), "must be one to six numbers"),
            ("unet.width", channels.into_iter().all(|width| widths(&[width])), SIZES),
            ("unet.blocks", (1..=16).contains(&self.unet.blocks), "must be from 1 to 16"),
            (
                "unet.attention",
                self.unet.attention.iter().all(|&level| level < levels),
                "must name levels of the network, from 0",
            ),
            (
                "unet.embedding",
                (4..=4096).contains(&self.unet.embedding) && self.unet.embedding.is_multiple_of(2),
                "must be an even number from 4 to 4096",
            ),
        ];
        for (key, good, problem) in rules {
            if !good {
                let key = format!("network.{key}");
                return Err(Error::request(
                    format!("{key} {problem}"),
                    &key,
                    "see docs/network.md",
                ));
            }
        }
        Ok(self)
    }
}

const SIZES: &str = "must be from 1 to 4096";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_valid() {
        let multiples: Vec<usize> = PRESETS
            .iter()
            .map(|(name, _)| NetworkConfig::preset(name).unwrap().multiple())
            .collect();
        assert_eq!(multiples, [8, 32, 16, 32, 16]);
    }

    /// Without a reference estimate there is nothing to align neighbours on, or to register.
    #[test]
    fn rejects_switches_that_contradict_each_other() {
        let paper = NetworkConfig::preset("paper").unwrap();
        assert_eq!(paper.reference, ReferenceKind::None);
        assert_eq!(paper.features.noisy, NoisyFeatures::Image);
        assert_eq!(paper.unet.predicts, UNetPrediction::X0);
        let mut wrong = [paper.clone(), paper.clone(), paper];
        wrong[0].pre.neighbours = 4;
        wrong[1].flow.registration = true;
        wrong[2].pre.stages = 2;
        for (config, key) in wrong.into_iter().zip(["pre.neighbours", "flow.registration", "pre"]) {
            let error = config.checked().unwrap_err().to_string();
            assert!(error.contains(key) && error.contains("network.reference"), "{error}");
        }
    }

    #[test]
    fn rejects_invalid_sizes_by_key() {
        let mut config = NetworkConfig::preset("tiny").unwrap();
        config.unet.embedding = 7;
        let error = config.checked().unwrap_err();
        assert!(error.to_string().contains("unet.embedding"), "{error}");
        assert!(NetworkConfig::preset("huge").unwrap_err().to_string().contains("huge"));
    }
}
