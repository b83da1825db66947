//! The regression, the default method: a window is aligned on a reference estimate, its frames are corrected,
//! the window is aligned again on what came out, and corrected once more, with a predicted uncertainty.
//!
//! In the order of the data: the first pre-denoiser, in [`Refinement`], restores all frames. The
//! [`BurstAligner`] aligns the window on them. [`Regression`] holds both pre-denoisers and the uncertainty
//! head. The [`RegressionRestorer`] restores whole windows, tile by tile, and filters them over time.

mod config;
pub(crate) mod input;
mod neighbour_weighting;
mod network;
mod predenoiser;
mod refinement;
mod restorer;
pub(crate) mod uncertainty;

pub use config::{FirstFrames, RegressionConfig};
pub use network::Regression;
pub use predenoiser::PreDenoiser;
pub use refinement::{AlignmentFrames, BurstAligner, Refinement};
pub use restorer::RegressionRestorer;

/// Scale of a last layer's output that corrects an image, in sigmas of the merged frame's noise. Adam moves
/// all weights by the same amount, and the sum of a whole layer's would jump.
const CORRECTION: f32 = 0.3;
