//! The network: photon counts and the noisy image in, the clean image out (docs/network.md).

mod attention;
mod embedding;
mod error;
mod evidence;
mod features;
mod flow;
mod fusion;
#[cfg(test)]
mod golden_tests;
mod layers;
mod lucas_kanade;
mod pre;
mod qudi;
mod resample;
mod trust;
mod unet;
mod variance;
mod weights;

pub use embedding::SENSOR_NUMBERS;

pub use features::{HighFeatures, LowFeatures, Pyramid};
pub use flow::{Flow, Flows};
pub use fusion::Fusion;
pub use pre::PreDenoiser;
pub use qudi::{Measured, Prediction, Prepared, Qudi, Simulated, State};
pub use resample::{fold, halve};
pub use unet::UNet;
pub use weights::{fill, parameters};
