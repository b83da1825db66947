//! The guide in numbers that mean the same in any light: deviations of the merged frame's noise.

use super::resample::mean_around;
use crate::measurement::IMAGES;
use burn::tensor::Tensor;

/// Least deviation, in image units: what is known better needs no correction.
const LEAST: f32 = 1e-3;

/// Differences of more deviations than this are no noise.
const FARTHEST: f32 = 5.0;

/// Counts are no farther than this from what is expected but by rare events.
const RAREST: f32 = 8.0;

/// Radius of the means that contrast is measured from; they are taken twice.
const AROUND: usize = 4;

/// What the classical guide says of a frame, for a network to correct. All `[images, 1, H, W]` but the last.
#[derive(Clone, Debug)]
pub(super) struct Evidence {
    /// The restored image, in image units.
    pub(super) clean: Tensor<4>,
    /// Deviation of the merged image's noise, in image units: errors of the restored image are some tenths of it.
    pub(super) deviation: Tensor<4>,
    /// How far the merged image is from the restored one.
    pub(super) difference: Tensor<4>,
    /// The restored image's contrast to its surroundings, compressed.
    pub(super) contrast: Tensor<4>,
    /// Logarithm of the deviation.
    pub(super) level: Tensor<4>,
    /// The frame's counts and those of its neighbours, then what is expected of the neighbours: `[images, 2 K + 1, H, W]`.
    pub(super) aligned: Tensor<4>,
}

impl Evidence {
    /// Of a guide, `[images, 3 + 2 K + 1, H, W]`, as [`GuidePlanes`](crate::measurement::GuidePlanes) has it, with `K`
    /// neighbours.
    pub(super) fn new(guide: &Tensor<4>) -> Self {
        let [clean, merged, noise] = [0, 1, 2].map(|place| guide.clone().narrow(1, place, 1));
        let deviation = noise.clamp_min(LEAST);
        let difference = (merged - clean.clone()) / deviation.clone();
        let neighbours = guide.dims()[1].saturating_sub(IMAGES + 1) / 2;
        let seen = guide.clone().narrow(1, IMAGES, neighbours + 1);
        let mut aligned = vec![seen.clamp(-RAREST, RAREST) * 0.5];
        if neighbours > 0 {
            let expected = guide.clone().narrow(1, IMAGES + neighbours + 1, neighbours);
            aligned.push(asinh(expected * 2.0));
        }
        let around = mean_around(mean_around(clean.clone(), AROUND), AROUND);
        let contrast = (clean.clone() - around) / deviation.clone();
        Self {
            difference: difference.clamp(-FARTHEST, FARTHEST) * 0.5,
            contrast: asinh(contrast),
            level: deviation.clone().log() + 3.0,
            aligned: Tensor::cat(aligned, 1),
            clean,
            deviation,
        }
    }

    /// The restored image in [-1, 1].
    pub(super) fn signed(&self) -> Tensor<4> {
        self.clean.clone() * 2.0 - 1.0
    }
}

/// Inverse hyperbolic sine. Of the size alone, for of large negative numbers it would be the logarithm of a difference.
fn asinh(x: Tensor<4>) -> Tensor<4> {
    let size = x.clone().abs();
    let root = (size.clone() * size.clone() + 1.0).sqrt();
    (size + root).log() * x.sign()
}
