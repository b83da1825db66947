//! The network in the sampler.

use super::noise::move_noise;
use super::{EncodedWindow, Window, WindowConfig};
use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::DiffusionState;
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use crate::diffusion::{Conditioning, Denoiser, Part, Simulated};
use burn::tensor::Tensor;
use qudi_core::{Result, Size};

impl Denoiser for Window {
    type Config = WindowConfig;
    type Encoded = EncodedWindow;
    type Flows = ();

    const MOVES_NOISE: bool = true;

    fn multiple(config: &WindowConfig) -> usize {
        config.multiple()
    }

    fn renews_flows(_: &WindowConfig, _: usize) -> bool {
        false
    }

    fn follows_counts(&self) -> bool {
        true
    }

    fn uses(&self, part: Part) -> bool {
        part != Part::ForwardModel
    }

    fn encode(&self, conditioning: &Conditioning, passes: usize) -> Result<EncodedWindow> {
        Self::encode(self, conditioning, passes)
    }

    fn encoded_bytes(encoded: &EncodedWindow) -> usize {
        encoded.bytes()
    }

    fn move_noise(encoded: &EncodedWindow, noise: &mut [f32]) -> Result<()> {
        let [_, _, height, width] = encoded.restored.dims();
        move_noise(&encoded.paths, Size { height, width }, noise)
    }

    fn denoise(
        &self,
        encoded: &EncodedWindow,
        _: Option<&Simulated>,
        state: &DiffusionState,
        _: &mut Option<()>,
    ) -> Tensor<4> {
        self.predict(encoded, state, &NoiseSchedule::cosine(NUM_TIMESTEPS)).x0
    }
}
