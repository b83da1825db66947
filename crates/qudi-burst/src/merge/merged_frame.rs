//! A frame merged with its neighbours, blended from merged patches.

use super::blocks::Blocks;
use super::cubic::noise_factor as cubic_noise;
use super::wiener::{AlignedPatch, merge, merge_by_reference};
use crate::motion::reference_frames::ReferenceFrames;
use crate::patch::{Patch, PatchMotion, SIDE, bilinear};
use crate::prepared_burst::PreparedBurst;
use qudi_core::Frame;
use rayon::prelude::*;
use std::ops::Range;

/// A frame merged with its neighbours. Noise variances are in units of the variance of one frame's counts.
#[derive(Debug)]
pub(crate) struct MergedFrame {
    /// Mean counts.
    pub(crate) counts: Frame,
    /// Noise variance of the counts, averaged over all patches.
    pub(crate) noise: f64,
    /// Noise variance of each patch.
    pub(crate) patch_noise: Vec<f32>,
}

impl MergedFrame {
    /// Merges blocks of frames along the motion of the reference's patches, with bilinear sampling (Ma et al.
    /// 2020, section 5.2).
    pub(crate) fn from_blocks(
        burst: &PreparedBurst,
        blocks: &Blocks,
        motion: &PatchMotion,
        wiener_c: f32,
    ) -> Self {
        Self::from_patches(burst, |i| {
            let aligned = |range: &Range<usize>| {
                let share = 1.0 / range.len() as f32;
                let mut mean = [[0.0; SIDE]; SIDE];
                let mut noise = 0.0;
                for frame in range.clone() {
                    let d = motion[frame][i];
                    let corner = burst.grid.corner(i);
                    let at = [corner[0] as f32 + d[0], corner[1] as f32 + d[1]];
                    let warped = bilinear(&burst.frames[frame], at);
                    for (mean, value) in mean.iter_mut().flatten().zip(warped.iter().flatten()) {
                        *mean += share * value;
                    }
                    let [x, y] = left_of_noise(d, bilinear_noise);
                    noise += share * share * x * y;
                }
                AlignedPatch { patch: mean, frames: range.len() as f32, noise }
            };
            let patches: Vec<AlignedPatch> = blocks.reference_first().map(aligned).collect();
            let variance = burst.variance_of(&patches[0].patch);
            merge(&patches, variance, wiener_c)
        })
    }

    /// Merges frame `reference` with all others along the motion of its patches. Weights are decided on the
    /// reference frames, and patches are sampled with cubic convolution.
    pub(crate) fn on_reference_frames(
        burst: &PreparedBurst,
        references: &ReferenceFrames,
        reference: usize,
        motion: &PatchMotion,
        wiener_c: f32,
    ) -> Self {
        let others = (0..burst.frames.len()).filter(|&k| k != reference);
        let order: Vec<usize> = std::iter::once(reference).chain(others).collect();
        Self::from_patches(burst, |i| {
            let sample = |image: &Frame, k: usize| {
                references.sample(burst, image, i, motion[k][i], reference)
            };
            let aligned = |&k: &usize| {
                let [x, y] = left_of_noise(motion[k][i], cubic_noise);
                AlignedPatch { patch: sample(&burst.frames[k], k), frames: 1.0, noise: x * y }
            };
            let patches: Vec<AlignedPatch> = order.iter().map(aligned).collect();
            let shown: Vec<Patch> =
                order.iter().map(|&k| sample(&references.frames[k], k)).collect();
            let variance = burst.variance_of(&patches[0].patch);
            merge_by_reference(&patches, &shown, variance, wiener_c)
        })
    }

    /// Blends merged patches, given with their noise variances.
    fn from_patches(
        burst: &PreparedBurst,
        patch: impl Fn(usize) -> (Patch, f32) + Send + Sync,
    ) -> Self {
        let patches: Vec<_> = (0..burst.grid.len()).into_par_iter().map(patch).collect();
        let mut counts = burst.blended(|i| &patches[i].0);
        counts.data.iter_mut().for_each(|count| *count = count.max(0.0));
        let patch_noise: Vec<f32> = patches.into_iter().map(|(_, noise)| noise).collect();
        let sum = patch_noise.iter().map(|&noise| f64::from(noise)).sum::<f64>();
        Self { counts, noise: sum / patch_noise.len() as f64, patch_noise }
    }
}

/// Returns the factors by which sampling at displacement `d` reduces the variance of white noise along each
/// axis; `along` computes the factor of one axis.
fn left_of_noise(d: [f32; 2], along: impl Fn(f32) -> f32) -> [f32; 2] {
    d.map(|d| along(d - d.floor()))
}

/// Returns the factor by which bilinear sampling, `part` of a pixel away, reduces the variance of white
/// noise.
fn bilinear_noise(part: f32) -> f32 {
    part * part + (1.0 - part) * (1.0 - part)
}
