//! The network: photon counts and the noisy image in, the clean image out (docs/network.md).

mod features;
mod flow;
mod fused;
mod fusion;
#[cfg(test)]
mod golden_tests;
mod layers;
mod lucas_kanade;
mod neighbour_weighting;
mod normalized_input;
mod parameters;
mod predenoiser;
mod qudi;
mod uncertainty;
mod unet;

pub use features::{HighFeatures, LowFeatures, Pyramid};
pub use flow::{Flow, Flows};
pub use fused::{Fused, FusedGradient};
pub use fusion::Fusion;
pub use parameters::former_name;
pub use predenoiser::PreDenoiser;
pub use qudi::{Encoded, Prediction, Qudi, Simulated};
pub use qudi_layers::resample::{avg_pool2, pixel_unshuffle};
pub use qudi_layers::{init_parameters, parameter_shapes};
pub use unet::UNet;
