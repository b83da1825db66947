//! The U-Net of a reverse step: fused features, the noisy image and the estimate so far in, the clean image
//! out.

use super::config::{FOLD, IMAGE, WindowConfig};
use super::encoding::EncodedWindow;
use super::hourglass::{Hourglass, ImageHead};
use super::merging::MERGED;
use crate::diffusion::state::per_image;
use crate::sensor::SENSOR_NUMBERS;
use burn::module::Module;
use burn::tensor::activation::silu;
use burn::tensor::{Device, Tensor};
use qudi_layers::Linear;
use qudi_layers::resample::pixel_unshuffle;

/// Numbers that describe the noise of a step.
const STEP_NUMBERS: usize = 6;

/// Channels of the embedding between its layers, and of its result.
const EMBEDDING: [usize; 2] = [64, 16];

/// The U-Net.
#[derive(Module, Debug)]
pub(super) struct UNet {
    enter: Linear,
    leave: Linear,
    hourglass: Hourglass,
    head: ImageHead,
}

/// The images that a step sees, `[images, 1, H, W]`, in units of usual errors.
#[derive(Clone, Debug)]
pub(super) struct StepImages {
    /// The noisy image's difference from the base.
    pub(super) noisy: Tensor<4>,
    /// The previous estimate's difference from the pre-denoised frames.
    pub(super) previous: Tensor<4>,
}

impl WindowConfig {
    pub(super) fn init_unet(&self, device: &Device) -> UNet {
        let [between, planes] = EMBEDDING;
        let inputs = self.widths[0] + 2 * self.state + 3 * IMAGE + planes + MERGED;
        UNet {
            enter: Linear::zeros([SENSOR_NUMBERS + STEP_NUMBERS, between], device),
            leave: Linear::zeros([between, planes], device),
            hourglass: Hourglass::zeros(inputs, planes, self.widths, device),
            head: ImageHead::zeros(self.widths[0], device),
        }
    }
}

impl UNet {
    /// Computes a correction of unit size, `[images, 1, H, W]`, and the features that it comes from.
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
        has_previous: &[bool],
    ) -> (Tensor<4>, Tensor<4>) {
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
                plane(&|k| f32::from(u8::from(has_previous[k]))),
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
        inputs.push(encoded.merged_planes.clone());
        let [features, ..] = self.hourglass.forward(&inputs, Some(&embedding));
        (self.head.forward(features.clone()), features)
    }
}
