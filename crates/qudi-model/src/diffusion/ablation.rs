//! Parts of the method that are left out in training, to measure what they are worth.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A part of the method that can be left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// Forward model: the measurement of every estimate by the sensor model.
    ForwardModel,
    /// Optical flow: neighbours are taken as they are.
    Flow,
    /// Temporal fusion: every frame is restored from itself alone.
    Fusion,
    /// The previous estimate as an input.
    SelfConditioning,
    /// The mean level of the image as an input.
    MeanLevel,
}

/// The parts that are left out. Parts that are left out still have weights.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Ablation(Vec<Part>);

impl Ablation {
    /// Returns true if a part is left out.
    pub fn removes(&self, part: Part) -> bool {
        self.0.contains(&part)
    }

    /// Returns true if nothing is left out.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl FromIterator<Part> for Ablation {
    fn from_iter<I: IntoIterator<Item = Part>>(parts: I) -> Self {
        Self(parts.into_iter().collect())
    }
}
