//! All frames of a window aligned with each of them, before anybody decides which to trust. A robust merge
//! decides by a formula; a network that sees them all can learn to.

use crate::denoise::stabilized::{image, units};
use crate::denoise::vst::VarianceStabilizer;
use crate::merge::merged_frame::MergedFrame;
use crate::motion::constant_velocity::ConstantVelocity;
use crate::motion::hypotheses::select_on_estimates;
use crate::motion::per_pixel_selection::per_pixel_selection;
use crate::motion::reference_frames::ReferenceFrames;
use crate::patch::{PatchMotion, SIDE, padded};
use crate::prepared_burst::{PreparedBurst, nearest};
use crate::reference::{ReferenceEstimate, WIENER_C};
use crate::temporal_filter::temporal_filter;
use qudi_core::restorer::Acquisition;
use qudi_core::{Frame, Size};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Variance of the errors of the reference estimate, in units of the counts' variance, about.
const REFERENCE_ERROR: f32 = 0.1;

/// Least variance of a count: what certainly counts nothing, or full scale, still differs from it by
/// something.
const LEAST_VARIANCE: f64 = 1e-4;

/// A window aligned on its reference estimate.
#[derive(Debug)]
pub struct AlignedBurst<'a> {
    burst: PreparedBurst,
    velocity: Option<ConstantVelocity>,
    vst: VarianceStabilizer,
    acquisition: &'a Acquisition,
    /// Dark detections of an ordinary pixel.
    ordinary_dark: f64,
    /// The reference estimate, in image units.
    frames: Vec<Frame>,
    /// The reference estimate, in mean counts.
    references: ReferenceFrames,
    /// The motion of the patches of each frame to all frames, found when first asked for.
    motions: Vec<OnceLock<FrameMotion>>,
}

/// The motion of the patches of a frame to all frames.
#[derive(Clone, Debug)]
struct FrameMotion {
    /// Along the most likely hypotheses.
    selected: PatchMotion,
    /// As matched frame by frame.
    matched: PatchMotion,
}

/// The alignments of each neighbour with a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alignments {
    /// The selected motion of its patches.
    Selected,
    /// The selected motion, and the motion as matched frame by frame: freer, and fitting the noise of what it
    /// was matched on.
    WithMatched,
    /// Both, and pixel by pixel whichever of the motions around fits best: freer still.
    WithPerPixel,
}

impl Alignments {
    /// How often each neighbour is aligned.
    pub fn count(self) -> usize {
        match self {
            Self::Selected => 1,
            Self::WithMatched => 2,
            Self::WithPerPixel => 3,
        }
    }
}

/// What is known of a frame from all frames of its window. A standardized count is the count less what the
/// reference estimate expects of the frame, in units of the sigma of its noise.
#[derive(Clone, Debug)]
pub struct AlignedFrame {
    /// The reference estimate, in image units.
    pub reference: Frame,
    /// The merged frame: unbiased and still noisy, in image units.
    pub merged: Frame,
    /// Sigma of the merged frame's noise at each pixel, in image units.
    pub noise_sigma: Frame,
    /// Standardized counts of the frame itself, then of its aligned neighbours, nearest first, for each of
    /// the [`Alignments`]. Zero past the ends of the window and of the image.
    pub counts: Vec<Frame>,
    /// What the reference estimate expects of the aligned neighbours, standardized likewise.
    pub expected: Vec<Frame>,
}

impl<'a> AlignedBurst<'a> {
    /// Aligns the window of a reference estimate.
    pub fn new(reference: ReferenceEstimate, acquisition: &'a Acquisition) -> Self {
        let ReferenceEstimate { frames, mean_counts, burst, velocity, vst, ordinary_dark } =
            reference;
        let references = ReferenceFrames::new(&burst, mean_counts, REFERENCE_ERROR);
        let motions = frames.iter().map(|_| OnceLock::new()).collect();
        Self { burst, velocity, vst, acquisition, ordinary_dark, frames, references, motions }
    }

    /// Aligns the window again, on better frames in image units.
    #[must_use]
    pub fn realign(self, frames: Vec<Frame>) -> Self {
        let units = units(self.acquisition);
        let size = self.burst.padded_size();
        let mean_counts = frames.iter().map(|frame| {
            let mean = |(i, &image): (usize, &f32)| {
                let detections =
                    f64::from(image) / units + self.acquisition.dark_of(i, self.ordinary_dark);
                self.burst.moments.at(detections).0 as f32
            };
            let means: Vec<f32> = frame.data.par_iter().enumerate().map(mean).collect();
            padded(&means, frame.size, size)
        });
        let references = ReferenceFrames::new(&self.burst, mean_counts.collect(), REFERENCE_ERROR);
        let motions = frames.iter().map(|_| OnceLock::new()).collect();
        Self { frames, references, motions, ..self }
    }

    /// The size of the frames.
    pub fn size(&self) -> Size {
        self.burst.size
    }

    /// The number of frames in the window.
    pub fn frame_count(&self) -> usize {
        self.frames.len()
    }

    /// Aligns the nearest `neighbours` frames with frame `reference`, and merges all frames of the window.
    pub fn frame(
        &self,
        reference: usize,
        neighbours: usize,
        alignments: Alignments,
    ) -> AlignedFrame {
        let Self { burst, vst, references, .. } = self;
        let motion = self.motion(reference);
        let merged = MergedFrame::on_reference_frames(
            burst,
            references,
            reference,
            &motion.selected,
            WIENER_C,
        );
        let noise = burst.blended(|i| [[merged.patch_noise[i]; SIDE]; SIDE]);
        let stabilized = vst.stabilized(&merged.counts);
        let here = burst.cropped(&references.frames[reference]);
        let sigmas: Vec<f32> = here.data.par_iter().map(|&mean| self.count_sigma(mean)).collect();
        let standardized = |frame: Frame| {
            let values = frame.data.iter().zip(&here.data).zip(&sigmas);
            let values = values.map(|((value, here), sigma)| (value - here) / sigma);
            Frame { size: here.size, data: values.collect() }
        };
        let mut counts = vec![standardized(burst.cropped(&burst.frames[reference]))];
        let mut expected = Vec::new();
        let nearest = nearest(burst.frames.len(), reference, neighbours + 1);
        for alignment in 0..alignments.count() {
            let aligned = |&k: &usize| match alignment {
                0 => self.warped(reference, k, &motion.selected),
                1 => self.warped(reference, k, &motion.matched),
                _ => {
                    let motions = [&motion.selected, &motion.matched];
                    per_pixel_selection(burst, references, reference, k, motions)
                }
            };
            let aligned: Vec<_> =
                nearest[1..].par_iter().map(|k| aligned(k).map(standardized)).collect();
            for [count, estimate] in aligned {
                counts.push(count);
                expected.push(estimate);
            }
            let end = (alignment + 1) * neighbours;
            counts.resize(1 + end, Frame::filled(here.size, 0.0));
            expected.resize(end, Frame::filled(here.size, 0.0));
        }
        AlignedFrame {
            reference: self.frames[reference].clone(),
            noise_sigma: self.noise_sigma(&here, &noise),
            merged: image(&stabilized, vst, self.acquisition, self.ordinary_dark),
            counts,
            expected,
        }
    }

    /// Merges restored frames of this window, in image units, each with its neighbours along their motion.
    /// Each was denoised on its own and errs in its own way. `error_variances` are those of the errors that
    /// the frames do not share, about.
    pub fn temporal_filter(&self, frames: &[Frame], error_variances: &[Frame]) -> Vec<Frame> {
        let motions: Vec<&PatchMotion> =
            (0..frames.len()).map(|frame| &self.motion(frame).selected).collect();
        temporal_filter(frames, error_variances, &motions)
    }

    fn motion(&self, reference: usize) -> &FrameMotion {
        self.motions[reference].get_or_init(|| {
            let Self { burst, references, .. } = self;
            let matched = references.align(burst, reference);
            let velocity = self.velocity.as_ref();
            let selected =
                select_on_estimates(burst, velocity, references, reference, matched.clone());
            FrameMotion { selected, matched }
        })
    }

    /// Warps the counts of frame `k`, and its estimate, onto the reference along the motion of every patch.
    fn warped(&self, reference: usize, k: usize, motion: &PatchMotion) -> [Frame; 2] {
        let Self { burst, references, .. } = self;
        [&burst.frames[k], &references.frames[k]].map(|image| {
            burst.blended(|i| references.sample(burst, image, i, motion[k][i], reference))
        })
    }

    /// Sigma of a count of the given mean.
    fn count_sigma(&self, mean: f32) -> f32 {
        let variance = self.burst.moments.variance_at_mean(f64::from(mean));
        variance.max(LEAST_VARIANCE).sqrt() as f32
    }

    /// Sigma in image units of merged counts whose mean is `means`: half of what separates the images one
    /// sigma above and below, through the inverse of the transform; black is no bound.
    fn noise_sigma(&self, means: &Frame, noise: &Frame) -> Frame {
        let n = self.burst.frames.len() as f64;
        let units = units(self.acquisition);
        let sigma = |(&mean, &noise): (&f32, &f32)| {
            let z = self.vst.transform(n * f64::from(mean));
            let z = self.vst.possible(z);
            let one = self.vst.sigma(z) * (n * f64::from(noise)).sqrt();
            let span = self.vst.invert(z + one) - self.vst.invert(z - one);
            (0.5 * span * units) as f32
        };
        let pairs = means.data.par_iter().zip(&noise.data);
        Frame { size: means.size, data: pairs.map(sigma).collect() }
    }
}
