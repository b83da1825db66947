//! The terms of losses; each network adds up its own, in `learner/`. docs/network.md has the
//! formulas.

mod gaussian_nll;
mod log_mean_square;
pub mod lpips;
mod reconstruction;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use gaussian_nll::gaussian_nll;
pub(crate) use log_mean_square::log_mean_square;
pub use reconstruction::reconstruction;
pub(crate) use reconstruction::{relative_reconstruction, root_mean_square};

/// How the errors of images count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LossForm {
    /// Squared error and total variation of the error, in [0, 1], as in the paper.
    L2Tv,
    /// Squared errors in units of the remaining error of every pixel (Karras et al. 2022, table 1, "EDM":
    /// their weight `1 / c_out^2`), and of pre-denoised frames in units of their usual error.
    #[default]
    Edm,
}
