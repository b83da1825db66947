//! The U-Net of a reverse step: fused features, the noisy image and the estimate so far in, the clean image
//! out.

use super::config::{FOLD, IMAGE, WindowConfig};
use super::encoding::EncodedWindow;
use super::hourglass::{Hourglass, ImageHead};
use super::merging::MERGED;
use crate::diffusion::state::per_image;
use crate::sensor::SENSOR_NUMBERS;
use burn::module::Module;
use burn::tensor::activation::{sigmoid, silu};
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle};
use qudi_layers::{Bias, Conv2d, Linear};

/// Numbers that describe the noise of a step.
const STEP_NUMBERS: usize = 5;

/// Channels of the embedding between its layers, and of its result.
const EMBEDDING: [usize; 2] = [64, 16];

/// The U-Net.
#[derive(Module, Debug)]
pub(super) struct UNet {
    enter: Linear,
    leave: Linear,
    hourglass: Hourglass,
    head: ImageHead,
    gate: Conv2d,
}

/// What the U-Net computes.
#[derive(Clone, Debug)]
pub(super) struct Outputs {
    /// Correction of unit size, `[images, 1, H, W]`.
    pub(super) correction: Tensor<4>,
    /// How much of the merged frames the correction starts from, in [0, 1]: `[images, 1, H, W]`.
    pub(super) gate: Tensor<4>,
    /// What both come from, `[images, features, H / 2, W / 2]`.
    pub(super) features: Tensor<4>,
}

/// The images that a step sees, `[images, 1, H, W]`, in units of usual errors.
#[derive(Clone, Debug)]
pub(super) struct StepImages {
    /// The noisy image's difference from the base.
    pub(super) noisy: Tensor<4>,
    /// The previous estimate's difference from the pre-denoised frames.
    pub(super) previous: Tensor<4>,
    /// The merged frames' difference from the base.
    pub(super) merged: Tensor<4>,
    /// Logarithm of the usual squared error of the base over the merged frames'.
    pub(super) noise: Tensor<4>,
}

impl WindowConfig {
    pub(super) fn init_unet(&self, device: &Device) -> UNet {
        let [between, planes] = EMBEDDING;
        let inputs = self.widths[0] + 2 * self.state + 3 * IMAGE + planes + MERGED;
        UNet {
            enter: Linear::zeros([SENSOR_NUMBERS + STEP_NUMBERS, between], device),
            leave: Linear::zeros([between, planes], device),
            hourglass: Hourglass::zeros(inputs, planes, self.widths, self.coarse_entry(), device),
            head: ImageHead::zeros(self.widths[0], device),
            gate: Conv2d::zeros([self.widths[0], IMAGE], 3, Bias::Yes, device),
        }
    }
}

impl UNet {
    /// Computes the correction of a step.
    ///
    /// # Shapes
    /// - sensor: `[images, 11, 1, 1]`
    /// - log_snr: the logarithm of signal over noise of every burst
    pub(super) fn forward(
        &self,
        encoded: &EncodedWindow,
        images: StepImages,
        sensor: Tensor<4>,
        log_snr: &[f32],
    ) -> Outputs {
        let [count, numbers, ..] = sensor.dims();
        let device = sensor.device();
        let plane = |f: &dyn Fn(usize) -> f32| {
            per_image((0..log_snr.len()).map(f).collect(), count, &device)
        };
        let step = Tensor::cat(
            vec![
                plane(&|k| log_snr[k] * 0.25),
                plane(&|k| (log_snr[k] * 0.5).sin()),
                plane(&|k| (log_snr[k] * 0.5).cos()),
                plane(&|k| log_snr[k].sin()),
                plane(&|k| log_snr[k].cos()),
            ],
            1,
        );
        let described = Tensor::cat(
            vec![sensor.reshape([count, numbers]), step.reshape([count, STEP_NUMBERS])],
            1,
        );
        let embedding = self.leave.forward(silu(self.enter.forward(described)));
        let [_, planes] = EMBEDDING;
        let embedding = embedding.reshape([count, planes, 1, 1]);
        let mut inputs = encoded.features.clone();
        let [_, _, h, w] = inputs[0].dims();
        inputs.push(Tensor::cat(
            vec![
                pixel_unshuffle(images.noisy, FOLD),
                pixel_unshuffle(images.previous, FOLD),
                embedding.clone().expand([count, planes, h, w]),
            ],
            1,
        ));
        let merged = pixel_unshuffle(images.merged, FOLD);
        inputs.push(Tensor::cat(vec![merged, encoded.merged.planes_of_frames()], 1));
        let [features, ..] = self.hourglass.forward(&inputs, Some(&embedding));
        let gate = pixel_shuffle(self.gate.linear(std::slice::from_ref(&features)), FOLD);
        Outputs {
            correction: self.head.forward(features.clone()),
            gate: sigmoid(gate + images.noise),
            features,
        }
    }
}
