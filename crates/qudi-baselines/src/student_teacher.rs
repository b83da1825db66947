//! A student and two teachers, after "Dynamic low-light imaging with quanta image sensors" (Chi et al., ECCV
//! 2020).
//!
//! The authors' program and sizes are not public. This is a network in their spirit: features, and a U-Net
//! that predicts a kernel for every pixel of every frame (Mildenhall et al., "Burst denoising with kernel
//! prediction networks", CVPR 2018). The student learns from noisy bursts of moving scenes, and resembles two
//! teachers: one of motion without noise, one of noise without motion.

mod method;

use crate::parts::renamed;
use burn::module::Module;
use burn::tensor::ops::PadMode;
use burn::tensor::{Device, Tensor};
use qudi_layers::resample::{avg_pool2, repeat};
use qudi_layers::{Bias, Conv2d};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Levels of the U-Net.
const LEVELS: usize = 4;

/// Layers of the extractor.
const LAYERS: usize = 4;

/// Frames have sides that are multiples of this.
pub const MULTIPLE: usize = 1 << (LEVELS - 1);

/// Initial weight of the filtered frames' own error, and its factor at every step.
const AUXILIARY_WEIGHT: f64 = 100.0;
const AUXILIARY_DECAY: f64 = 0.9998;

/// Steps until that weight is 0.03. Shorter trainings count faster, or it would rule them to the end.
pub const ANNEALING_STEPS: u64 = 40_000;

/// Weight of the distance from a teacher.
const TEACHER_WEIGHT: f32 = 0.1;

/// Sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Frames of a burst.
    pub frames: usize,
    /// Channels of features.
    pub features: usize,
    /// Side of the kernels, odd.
    pub kernel: usize,
}

/// Student or teacher.
#[derive(Module, Debug)]
pub struct KernelPrediction {
    extractor: Vec<Conv2d>,
    down: Vec<Double>,
    /// The coarsest first.
    up: Vec<Double>,
    kernels: Conv2d,
    /// Side of the kernels.
    kernel: usize,
    frames: usize,
}

/// Two convolutions.
#[derive(Module, Debug)]
struct Double {
    first: Conv2d,
    second: Conv2d,
}

/// Results of a network.
///
/// # Shapes
/// - image: `[bursts, 1, height, width]`
/// - frames: `[bursts, frames, height, width]`
/// - extracted: `[bursts, features, height, width]`
/// - bottom: `[bursts, 8 * features, height / 8, width / 8]`
#[derive(Clone, Debug)]
pub struct Restored {
    /// The mean of the filtered frames.
    pub image: Tensor<4>,
    /// The filtered frames.
    pub frames: Tensor<4>,
    /// Features that the student shares with its teachers.
    pub extracted: Tensor<4>,
    /// Features at the bottom of the U-Net, likewise.
    pub bottom: Tensor<4>,
}

impl KernelPrediction {
    /// Makes the network, all weights zero.
    pub fn zeros(sizes: Sizes, device: &Device) -> Self {
        let Sizes { frames, features, kernel } = sizes;
        let conv = |sizes| Conv2d::zeros(sizes, 3, Bias::Yes, device);
        let double = |from, to| Double { first: conv([from, to]), second: conv([to, to]) };
        let width = |level: usize| features << level;
        let down = |level: usize| double(width(level.saturating_sub(1)), width(level));
        let up = |level: usize| double(width(level) + width(level + 1), width(level));
        Self {
            extractor: (0..LAYERS)
                .map(|layer| conv([if layer == 0 { frames } else { features }, features]))
                .collect(),
            down: (0..LEVELS).map(down).collect(),
            up: (0..LEVELS - 1).rev().map(up).collect(),
            kernels: conv([features, frames * kernel * kernel]),
            kernel,
            frames,
        }
    }

    /// Returns the frames of a burst.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Returns the name of a parameter in files.
    pub fn file_name(name: &str) -> String {
        renamed(name, &[(".first.", ".0."), (".second.", ".2.")])
    }

    /// Restores the scene of a burst.
    ///
    /// # Shapes
    /// - burst: `[bursts, frames, height, width]`, sides multiples of 8
    pub fn forward(&self, burst: Tensor<4>) -> Restored {
        let extracted = self.extractor.iter().fold(burst.clone(), |x, layer| layer.relu(&[x]));
        let mut levels: Vec<Tensor<4>> = Vec::with_capacity(LEVELS);
        for level in &self.down {
            let x = match levels.last() {
                None => extracted.clone(),
                Some(finer) => avg_pool2(finer.clone()),
            };
            levels.push(level.forward(&[x]));
        }
        let bottom = levels.pop().expect("four levels");
        let mut x = bottom.clone();
        for level in &self.up {
            let skip = levels.pop().expect("as many levels up as down");
            x = level.forward(&[repeat(x), skip]);
        }
        let frames = filtered(burst, self.kernels.linear(&[x]), self.kernel);
        Restored { image: frames.clone().mean_dim(1), frames, extracted, bottom }
    }
}

impl Double {
    fn forward(&self, inputs: &[Tensor<4>]) -> Tensor<4> {
        self.second.relu(&[self.first.relu(inputs)])
    }
}

/// Filters every frame by kernels of its own, `[bursts, frames * side * side, height, width]`, zeros outside.
fn filtered(burst: Tensor<4>, kernels: Tensor<4>, side: usize) -> Tensor<4> {
    let [bursts, frames, height, width] = burst.dims();
    let kernels: Tensor<5> = kernels.reshape([bursts, frames, side * side, height, width]);
    let around = (side / 2, side / 2);
    let padded = burst.pad([(0, 0), (0, 0), around, around], PadMode::Constant(0.0));
    let tap = |tap: usize| {
        let weight = kernels.clone().narrow(2, tap, 1).reshape([bursts, frames, height, width]);
        weight * padded.clone().narrow(2, tap / side, height).narrow(3, tap % side, width)
    };
    (1..side * side).fold(tap(0), |sum, k| sum + tap(k))
}

/// Computes the terms of the reconstruction's loss at a step, from 0, `[1]` each: the mean squared error of
/// the image and, with a falling weight, of every filtered frame.
///
/// # Shapes
/// - truth: `[bursts, 1, height, width]`
pub fn reconstruction_losses(restored: &Restored, truth: &Tensor<4>, step: u64) -> [Tensor<1>; 2] {
    let error = |images: &Tensor<4>| (images.clone() - truth.clone()).powi_scalar(2).mean();
    let weight = AUXILIARY_WEIGHT * AUXILIARY_DECAY.powi(i32::try_from(step).unwrap_or(i32::MAX));
    [error(&restored.image), error(&restored.frames) * weight]
}

/// Computes the distance of the student's features from both teachers', `[1]`; the teachers learn nothing
/// from it.
pub fn matching_loss(student: &Restored, teachers: [&Restored; 2]) -> Tensor<1> {
    let distance =
        |a: &Tensor<4>, b: &Tensor<4>| (a.clone() - b.clone().detach()).powi_scalar(2).mean();
    let [motion, denoising] = teachers.map(|teacher| {
        distance(&student.extracted, &teacher.extracted)
            + distance(&student.bottom, &teacher.bottom)
    });
    (motion + denoising) * TEACHER_WEIGHT
}
