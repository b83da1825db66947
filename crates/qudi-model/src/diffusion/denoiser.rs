//! The interface between the sampler and its networks.

use super::conditioning::Conditioning;
use super::network::{Diffusion, Encoded, Flows, Simulated};
use super::state::DiffusionState;
use super::{DiffusionConfig, Part};
use burn::tensor::Tensor;
use qudi_core::Result;
use std::fmt::Debug;

/// A network that predicts clean frames in every reverse step.
pub trait Denoiser: Debug {
    /// Sizes of the network.
    type Config: Debug;
    /// Everything that does not depend on the step.
    type Encoded: Clone + Debug;
    /// Flows that a step leaves to the next one.
    type Flows: Clone + Debug;

    /// True for networks that merge what they predict for several frames: noise of several samples moves with
    /// the scene.
    const MOVES_NOISE: bool = false;

    /// Returns the number that height and width of the frames are multiples of.
    fn multiple(config: &Self::Config) -> usize;

    /// Returns true if step `number`, from 1, estimates the flows again.
    fn renews_flows(config: &Self::Config, number: usize) -> bool;

    /// Returns true if the network uses this part of the method.
    fn uses(&self, part: Part) -> bool;

    /// Returns true if the network can follow the motion that is found in the counts.
    fn follows_counts(&self) -> bool {
        false
    }

    /// Encodes everything that does not depend on the step, in so many passes.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the device fails.
    fn encode(&self, conditioning: &Conditioning, passes: usize) -> Result<Self::Encoded>;

    /// Returns the memory of the encoding, in bytes.
    fn encoded_bytes(encoded: &Self::Encoded) -> usize;

    /// Makes the noise of every burst move with its scene, where [`MOVES_NOISE`](Self::MOVES_NOISE).
    ///
    /// # Shapes
    /// - noise: `[bursts * frames, height, width]`
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the device fails.
    fn move_noise(_: &Self::Encoded, _noise: &mut [f32]) -> Result<()> {
        Ok(())
    }

    /// Predicts the clean frames, about in [-1, 1]: `[bursts * frames, 1, height, width]`.
    fn denoise(
        &self,
        encoded: &Self::Encoded,
        simulated: Option<&Simulated>,
        state: &DiffusionState,
        flows: &mut Option<Self::Flows>,
    ) -> Tensor<4>;
}

impl Denoiser for Diffusion {
    type Config = DiffusionConfig;
    type Encoded = Encoded;
    type Flows = Flows;

    fn multiple(config: &DiffusionConfig) -> usize {
        config.multiple()
    }

    fn renews_flows(config: &DiffusionConfig, number: usize) -> bool {
        config.flow.steps.contains(&number)
    }

    fn uses(&self, part: Part) -> bool {
        !self.ablation().removes(part)
    }

    fn encode(&self, conditioning: &Conditioning, _: usize) -> Result<Encoded> {
        Ok(Self::encode(self, conditioning))
    }

    fn encoded_bytes(encoded: &Encoded) -> usize {
        encoded.bytes()
    }

    fn denoise(
        &self,
        encoded: &Encoded,
        simulated: Option<&Simulated>,
        state: &DiffusionState,
        flows: &mut Option<Flows>,
    ) -> Tensor<4> {
        let prediction = self.forward(encoded, simulated, state, flows.take());
        *flows = Some(prediction.flows);
        prediction.x0
    }
}
