//! What a weight file says about itself, in the metadata of the SafeTensors file.

use super::ModelKind;
use crate::config::NetworkConfig;
use crate::diffusion::timesteps::TimestepSpacing;
use qudi_layers::Provenance;
use serde::{Deserialize, Serialize};

/// The description of a weight file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// The name of the preset, if the sizes are those of one.
    pub preset: Option<String>,
    /// The sizes of the network.
    pub network: NetworkConfig,
    /// The number of frames of a window in training.
    pub window: usize,
    /// What it was trained on.
    #[serde(flatten)]
    pub provenance: Provenance,
    /// Reverse diffusion steps unless the user says otherwise; 0 for regression. Older files do not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub default_steps: Option<usize>,
    /// Spacing of their timesteps unless the user says otherwise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spacing: Option<TimestepSpacing>,
    /// Which parts of the network have learnt. Writing sets it from the weights; reading an older file, which
    /// does not say, too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<ModelKind>,
}

impl Description {
    /// Reverse diffusion steps unless the user says otherwise.
    ///
    /// Older files do not say. Among them, weights that predict their uncertainty were made for regression.
    pub fn reverse_steps(&self) -> usize {
        self.default_steps.unwrap_or(usize::from(!self.network.pre.uncertainty))
    }
}
