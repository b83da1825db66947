//! Provenance of weights: their training data and program.

use serde::{Deserialize, Serialize};

/// Provenance of a file of weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Version of the program that wrote the file.
    pub program: String,
    /// Sensors of the training data.
    pub sensors: Vec<String>,
    /// Minimum and maximum light of the training data, in photons per pixel and frame (PPP).
    pub ppp: [f64; 2],
    /// Names of the training data sets.
    pub data: Vec<String>,
    /// Number of optimization steps.
    pub steps: u64,
    /// Commit of the program that trained the weights.
    pub commit: Option<String>,
    /// Licence of the weights.
    pub licence: String,
    /// Recipes of all stages in their order, as TOML; none in files from before they were kept.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub recipes: Vec<String>,
}
