//! The pre-denoiser: a residual dense network (Zhang et al. 2018), frame by frame.

use super::evidence::Evidence;
use super::layers::{Bias, CORRECTION, Conv2d};
use super::resample::{fold, unfold};
use super::trust::Trust;
use crate::config::PreConfig;
use crate::measurement::{GuidePlanes, IMAGES};
use crate::tensor::read;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;

/// Planes that the guide's images become.
const PLANES: usize = 4;

/// Dense layers of a block.
const LAYERS: usize = 3;

/// Layers that each see all layers before, and a residual.
#[derive(Module, Debug)]
pub(super) struct DenseBlock {
    layers: Vec<Conv2d>,
    fuse: Conv2d,
}

impl DenseBlock {
    pub(super) fn zeros(width: usize, growth: usize, device: &Device) -> Self {
        let layer = |l| Conv2d::zeros([width + l * growth, growth], 3, Bias::Yes, device);
        let all = width + LAYERS * growth;
        Self {
            layers: (0..LAYERS).map(layer).collect(),
            fuse: Conv2d::zeros([all, width], 1, Bias::Yes, device),
        }
    }

    /// `x` and result: `[images, width, h, w]`.
    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let mut parts = vec![x.clone()];
        for layer in &self.layers {
            parts.push(layer.relu(&parts));
        }
        self.fuse.add(&parts, x)
    }
}

/// See the module.
#[derive(Module, Debug)]
pub struct PreDenoiser {
    static_in: Conv2d,
    trust: Option<Trust>,
    trusted_in: Option<Conv2d>,
    simulated_in: Conv2d,
    blocks: Vec<DenseBlock>,
    gather: Conv2d,
    spread: Conv2d,
    out: Conv2d,
    fold: usize,
}

impl PreConfig {
    /// The pre-denoiser on folded planes, weights zero.
    pub fn init(&self, fold: usize, device: &Device) -> PreDenoiser {
        let (width, planes) = (self.width, fold * fold);
        let inputs = PLANES + GuidePlanes::count(self.laid()) - IMAGES;
        let conv = |sizes, kernel, bias| Conv2d::zeros(sizes, kernel, bias, device);
        let block = |_| DenseBlock::zeros(width, self.growth, device);
        PreDenoiser {
            static_in: conv([inputs * planes, width], 3, Bias::Yes),
            trust: self.init_trust(fold, device),
            trusted_in: (self.trust > 0).then(|| conv([self.trusted(fold), width], 3, Bias::No)),
            simulated_in: conv([2 * planes + 1, width], 3, Bias::No),
            blocks: (0..self.blocks).map(block).collect(),
            gather: conv([self.blocks * width, width], 1, Bias::Yes),
            spread: conv([width, width], 3, Bias::Yes),
            out: conv([width, planes], 3, Bias::Yes),
            fold,
        }
    }
}

impl PreDenoiser {
    /// Seeing so many more frames laid upon each, after those that it sees: silent in the first layer, but weighed like the others.
    pub(super) fn seeing_more(self, frames: usize) -> Self {
        let planes = self.fold * self.fold;
        let inputs = self.static_in.weights().dims()[1];
        let laid = (inputs / planes - PLANES - 1) / 2;
        let more = frames * planes;
        // Expectations come last.
        let static_in = self.static_in.with_silent(inputs, more);
        Self { static_in: static_in.with_silent(inputs - laid * planes, more), ..self }
    }

    /// Whether simulated measurements have any weight.
    pub(super) fn sees_simulated(&self) -> Result<bool> {
        Ok(read(self.simulated_in.weights())?.iter().any(|&weight| weight != 0.0))
    }

    /// What does not depend on the step: `[images, width, h, w]`.
    pub(super) fn prepare(&self, evidence: &Evidence) -> Tensor<4> {
        let Evidence { difference, contrast, level, aligned, .. } = evidence.clone();
        let planes = Tensor::cat(vec![difference, contrast, evidence.signed(), level, aligned], 1);
        let planes = fold(planes, self.fold);
        let seen = self.static_in.linear(std::slice::from_ref(&planes));
        let (Some(trust), Some(trusted_in)) = (&self.trust, &self.trusted_in) else { return seen };
        trusted_in.add(&[trust.forward(&planes)], seen)
    }

    /// The pre-denoised frames alone, in image units, before any simulated measurement, from their guide.
    pub fn denoise(&self, guide: &Tensor<4>) -> Tensor<4> {
        self.denoise_seen(&Evidence::new(guide)).0
    }

    /// [`Self::denoise`] of what a guide says, and features.
    pub(super) fn denoise_seen(&self, evidence: &Evidence) -> (Tensor<4>, Tensor<4>) {
        let nothing = evidence.clean.zeros_like().repeat_dim(1, 2);
        let flag = nothing.clone().narrow(1, 0, 1).narrow(2, 0, 1).narrow(3, 0, 1);
        self.forward(self.prepare(evidence), evidence, nothing, flag)
    }

    /// The pre-denoised frames in image units, `[images, 1, H, W]`, and features `[images, width, h, w]`.
    /// `prepared` as from [`Self::prepare`] of the same `evidence`, whose restored image is corrected; `simulated` are
    /// `y_sim` and `u_sim`, `flag` says of every image whether they exist, `[images, 1, 1, 1]`.
    pub(super) fn forward(
        &self,
        prepared: Tensor<4>,
        evidence: &Evidence,
        simulated: Tensor<4>,
        flag: Tensor<4>,
    ) -> (Tensor<4>, Tensor<4>) {
        let [images, _, h, w] = prepared.dims();
        let inputs = [fold(simulated, self.fold), flag.expand([images, 1, h, w])];
        let shallow = self.simulated_in.add(&inputs, prepared);
        let mut x = shallow.clone();
        let mut outputs = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            x = block.forward(x);
            outputs.push(x.clone());
        }
        let features = self.spread.add(&[self.gather.linear(&outputs)], shallow);
        let correction = unfold(self.out.linear(std::slice::from_ref(&features)), self.fold);
        let correction = correction * evidence.deviation.clone() * CORRECTION;
        (evidence.clean.clone() + correction, features)
    }
}
