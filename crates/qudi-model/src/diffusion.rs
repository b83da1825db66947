//! The diffusion: the paper's system, which samples clean frames from photons alone.
//!
//! [`Conditioning`] holds the inputs of the network [`Diffusion`], which predicts clean frames from them and
//! from a noisy image. Around it are the noise schedule, the sampler and the sensor's [`forward_model`]. The
//! [`DiffusionRestorer`] restores whole windows, tile by tile.

mod ablation;
mod conditioning;
mod config;
mod denoiser;
pub mod forward_model;
pub(crate) mod network;
pub mod noise;
pub(crate) mod precondition;
mod restorer;
pub mod sampler;
pub mod schedule;
pub mod state;
pub mod timesteps;

pub use ablation::{Ablation, Part};
pub use conditioning::Conditioning;
pub use config::{
    DiffusionConfig, FeaturesConfig, FlowConfig, FlowInputs, FusionConfig, NoisyFeatures,
    PreConfig, UNetConfig, UNetPrediction,
};
pub use denoiser::Denoiser;
pub use network::{
    Diffusion, Encoded, EncodedMeasurement, Flows, Fused, FusedGradient, Predenoised, Prediction,
    Simulated,
};
pub use qudi_burst::BurstMotion;
pub use restorer::{DiffusionRestorer, FlowSource, SampleOptions};
