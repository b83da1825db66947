//! Alignment of all frames of a window with each frame, before any frame is weighted. A robust merge weights
//! the aligned frames with a formula; a network that receives all of them can learn the weights.

use crate::burst_motion::{BurstMotion, FRAME_ERROR, FrameMotion};
use crate::denoise::stabilized::{image, units};
use crate::denoise::vst::{Transform, VarianceStabilizer};
use crate::merge::merged_frame::MergedFrame;
use crate::motion::per_pixel_selection::per_pixel_selection;
use crate::motion::reference_frames::ReferenceFrames;
use crate::patch::{PatchMotion, SIDE};
use crate::prepared_burst::nearest;
use crate::reference::{ReferenceEstimate, WIENER_C};
use crate::temporal_filter::temporal_filter;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::{Frame, Result, Size};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Lower bound of a count's variance. It keeps the standardization finite where the expected count is 0 or
/// full scale.
const MIN_VARIANCE: f64 = 1e-4;

/// A window aligned on its reference estimate.
#[derive(Debug)]
pub struct AlignedBurst {
    motion: BurstMotion,
    vst: VarianceStabilizer,
    /// The reference estimate, in image units.
    frames: Vec<Frame>,
    /// The reference estimate, in mean counts.
    references: ReferenceFrames,
    /// The motion of the patches of each frame to all frames, computed on first use.
    motions: Vec<OnceLock<FrameMotion>>,
}

/// Set of alignments computed for each neighbour of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alignments {
    /// The selected motion of each patch.
    Selected,
    /// The selected motion and the motion matched frame by frame. The matched motion is less constrained, and
    /// fits the noise of the frames that it was matched on.
    WithMatched,
    /// Both motions, and per pixel the best-fitting motion of the surrounding patches (the least
    /// constrained).
    WithPerPixel,
}

impl Alignments {
    /// Returns the number of alignments per neighbour.
    pub fn count(self) -> usize {
        match self {
            Self::Selected => 1,
            Self::WithMatched => 2,
            Self::WithPerPixel => 3,
        }
    }
}

/// A frame with the evidence that all frames of its window hold about it. A standardized count is the count
/// minus the count that the reference estimate predicts, in units of its noise sigma.
#[derive(Clone, Debug)]
pub struct AlignedFrame {
    /// The reference estimate, in image units.
    pub reference: Frame,
    /// The merged frame: unbiased and still noisy, in image units.
    pub merged: Frame,
    /// Noise sigma of the merged frame at each pixel, in image units.
    pub noise_sigma: Frame,
    /// Standardized counts of the frame itself, then of its aligned neighbours, nearest first, for each of
    /// the [`Alignments`]. Pixels outside the window or the image are zero.
    pub counts: Vec<Frame>,
    /// Counts that the reference estimate predicts for the aligned neighbours, standardized in the same way.
    pub expected: Vec<Frame>,
}

impl AlignedBurst {
    /// Aligns the window of a reference estimate.
    pub fn new(reference: ReferenceEstimate) -> Self {
        let ReferenceEstimate { frames, mean_counts, motion, vst } = reference;
        let references = ReferenceFrames::new(&motion.burst, mean_counts, FRAME_ERROR);
        let motions = frames.iter().map(|_| OnceLock::new()).collect();
        Self { motion, vst, frames, references, motions }
    }

    /// Aligns a window on frames that were restored in another way, given in image units. No reference
    /// estimate is computed.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the sensor's dark rate is unknown.
    ///
    /// # Panics
    /// If there is not one restored frame for every frame of the window, of the same size.
    pub fn on_frames(
        view: BurstView<'_>,
        acquisition: &Acquisition,
        frames: Vec<Frame>,
    ) -> Result<Self> {
        assert_eq!(frames.len(), view.frames.len(), "a restored frame for every frame");
        let Acquisition { sensor, gain, .. } = acquisition;
        sensor.dark_per_frame()?;
        let count = view.frames.len() as u32;
        let vst = VarianceStabilizer::new(Transform::Integral, sensor, *gain, count);
        Ok(Self::with_frames(BurstMotion::new(view, acquisition), vst, frames))
    }

    /// Aligns the window again on better frames, given in image units.
    #[must_use]
    pub fn realign(self, frames: Vec<Frame>) -> Self {
        Self::with_frames(self.motion, self.vst, frames)
    }

    fn with_frames(motion: BurstMotion, vst: VarianceStabilizer, frames: Vec<Frame>) -> Self {
        let references = motion.references(&frames);
        let motions = frames.iter().map(|_| OnceLock::new()).collect();
        Self { motion, vst, frames, references, motions }
    }

    /// Returns the size of the frames.
    pub fn size(&self) -> Size {
        self.motion.burst.size
    }

    /// Returns the number of frames in the window.
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
        let Self { motion: BurstMotion { burst, acquisition, ordinary_dark, .. }, vst, .. } = self;
        let references = &self.references;
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
            merged: image(&stabilized, vst, acquisition, *ordinary_dark),
            counts,
            expected,
        }
    }

    /// Merges restored frames of this window, in image units, with their neighbours along the selected
    /// motion. It reduces the errors that neighbouring frames do not share. `error_variances` holds the
    /// approximate variance of these independent errors at each pixel.
    pub fn temporal_filter(&self, frames: &[Frame], error_variances: &[Frame]) -> Vec<Frame> {
        let motions: Vec<&PatchMotion> =
            (0..frames.len()).map(|frame| &self.motion(frame).selected).collect();
        temporal_filter(frames, error_variances, &motions)
    }

    fn motion(&self, reference: usize) -> &FrameMotion {
        let find = || self.motion.on_references(&self.references, reference);
        self.motions[reference].get_or_init(find)
    }

    /// Warps the counts of frame `k` and its reference estimate onto frame `reference`, along the motion of
    /// each patch.
    fn warped(&self, reference: usize, k: usize, motion: &PatchMotion) -> [Frame; 2] {
        let (burst, references) = (&self.motion.burst, &self.references);
        [&burst.frames[k], &references.frames[k]].map(|image| {
            burst.blended(|i| references.sample(burst, image, i, motion[k][i], reference))
        })
    }

    /// Returns the sigma of a count with the given mean.
    fn count_sigma(&self, mean: f32) -> f32 {
        let variance = self.motion.burst.moments.variance_at_mean(f64::from(mean));
        variance.max(MIN_VARIANCE).sqrt() as f32
    }

    /// Returns the noise sigma of merged counts with mean `means`, in image units. It is half the distance
    /// between the inverse transforms one sigma above and one sigma below the mean. Values below black are
    /// not cut.
    fn noise_sigma(&self, means: &Frame, noise: &Frame) -> Frame {
        let n = self.motion.burst.frames.len() as f64;
        let units = units(&self.motion.acquisition);
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
