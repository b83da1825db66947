//! What weights were trained on, and by which program.

use serde::{Deserialize, Serialize};

/// What a file of weights says about their training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// The version of the program that wrote it.
    pub program: String,
    /// The sensors of the training data.
    pub sensors: Vec<String>,
    /// The least and most photons per pixel and frame of the training data.
    pub ppp: [f64; 2],
    /// The names of the training data.
    pub data: Vec<String>,
    /// Optimization steps.
    pub steps: u64,
    /// The commit of the program that trained it.
    pub commit: Option<String>,
    /// The licence of the weights.
    pub licence: String,
}
