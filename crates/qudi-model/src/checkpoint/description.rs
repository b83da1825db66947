//! The description in the metadata of a weight file.

use crate::config::NetworkConfig;
use crate::diffusion::timesteps::TimestepSpacing;
use qudi_layers::Provenance;
use serde::{Deserialize, Serialize};

/// The description of a weight file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// Name of the preset that has these sizes, if any.
    pub preset: Option<String>,
    /// Kind and sizes of the network.
    pub network: NetworkConfig,
    /// Number of frames of a window in training.
    pub window: usize,
    /// Passes of encoding that the network has learnt; those that encode once have learnt one.
    #[serde(default = "one_pass")]
    pub passes: usize,
    /// Training data and program.
    #[serde(flatten)]
    pub provenance: Provenance,
    /// Default of sampling; none for a regression.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampling: Option<Sampling>,
}

fn one_pass() -> usize {
    1
}

/// The default of sampling.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sampling {
    /// Reverse steps.
    pub steps: usize,
    /// Spacing of their timesteps.
    pub spacing: TimestepSpacing,
}

impl Default for Sampling {
    fn default() -> Self {
        Self { steps: 1, spacing: TimestepSpacing::default() }
    }
}
