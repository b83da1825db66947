//! What every frame of a window has to say of one of them: the frames laid upon it, before anybody decides which to
//! trust. A robust merge decides by a formula; a network that sees them all can learn to.

use super::steady::steadied;
use crate::denoise::stabilizer::VarianceStabilizer;
use crate::guide::ReferenceEstimate;
use crate::merge::blocks::Blocks;
use crate::merge::dft::SIDE;
use crate::methods::qbp::{Merged, Merger, Patchwise, Pilots, at_least, nearest};
use crate::methods::transform_denoise::{image, units};
use qudi_core::restorer::Acquisition;
use qudi_core::{Frame, Size};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Variance of the guide's errors, in that of one frame's noise, about.
const ERROR: f32 = 0.1;

/// Least variance of a count: what certainly counts nothing, or full scale, still differs from it by something.
const LEAST_VARIANCE: f64 = 1e-4;

/// A third round of alignment, on the guide.
#[derive(Debug)]
pub struct AlignedBurst<'a> {
    merger: Merger,
    stabilizer: VarianceStabilizer,
    acquisition: &'a Acquisition,
    /// Dark detections of an ordinary pixel.
    ordinary: f64,
    clean: Vec<Frame>,
    /// The motion of the patches of each frame to all frames, found when first asked for.
    flows: Vec<OnceLock<Motion>>,
}

/// The motion of the patches of a frame to all frames.
#[derive(Clone, Debug)]
struct Motion {
    likeliest: Patchwise,
    /// Frame by frame, whatever other paths are likelier.
    matched: Patchwise,
}

/// Alignments what neighbours are laid upon a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alignments {
    /// The likeliest paths of their patches.
    Selected,
    /// These, and once more the paths as matched frame by frame: freer, and fitting the noise of what they were matched on.
    WithMatched,
    /// Both, and pixel by pixel along whichever of the motions around fits best: freer still.
    WithPerPixel,
}

impl Alignments {
    /// How often each neighbour is laid upon the frame.
    pub fn count(self) -> usize {
        match self {
            Self::Selected => 1,
            Self::WithMatched => 2,
            Self::WithPerPixel => 3,
        }
    }
}

/// What is known of a frame. Deviations are those of the noise of one frame's counts where the guide is right.
#[derive(Clone, Debug)]
pub struct AlignedFrame {
    /// The guide's restored frame, in image units.
    pub reference: Frame,
    /// AlignedFrame and merged: unbiased and still noisy, in image units.
    pub merged: Frame,
    /// Deviation of the merged frame's noise at each pixel, in image units.
    pub noise_sigma: Frame,
    /// Counts of the frame itself, then of its neighbours, nearest first, laid upon it, for each way of [`Alignments`]: less what
    /// the guide expects of the frame, in deviations. Zero past the ends of the window and of the image.
    pub counts: Vec<Frame>,
    /// What the guide expects of the neighbours, laid upon the frame likewise: less what it expects of the frame, in deviations.
    pub expected: Vec<Frame>,
}

impl<'a> AlignedBurst<'a> {
    /// Of the window that `guide` was found for.
    pub fn new(guide: ReferenceEstimate, acquisition: &'a Acquisition) -> Self {
        let ReferenceEstimate { clean, means, merger, stabilizer, ordinary } = guide;
        let (none, flows) = (Vec::new(), Vec::new());
        Self { merger, stabilizer, acquisition, ordinary, clean: none, flows }.led_by(clean, means)
    }

    /// Goes by restored frames, in image units and in mean counts.
    fn led_by(mut self, clean: Vec<Frame>, means: Vec<Frame>) -> Self {
        self.merger.follow(Pilots { frames: means, error: ERROR });
        let flows = clean.iter().map(|_| OnceLock::new()).collect();
        Self { clean, flows, ..self }
    }

    /// Once more, on better frames of the window in image units.
    #[must_use]
    pub fn realign(self, clean: Vec<Frame>) -> Self {
        let units = units(self.acquisition);
        let size = self.merger.frames[0].size;
        let means = clean.iter().map(|frame| {
            let mean = |(i, &image): (usize, &f32)| {
                let detections =
                    f64::from(image) / units + self.acquisition.dark_of(i, self.ordinary);
                self.merger.moments.at(detections).0 as f32
            };
            let means: Vec<f32> = frame.data.iter().enumerate().map(mean).collect();
            at_least(&means, frame.size, size)
        });
        let means = means.collect();
        self.led_by(clean, means)
    }

    /// Size of the frames.
    pub fn size(&self) -> Size {
        self.merger.size
    }

    /// Frames of the window.
    pub fn frame_count(&self) -> usize {
        self.clean.len()
    }

    /// What is known of frame `reference`, with so many neighbours laid upon it.
    pub fn frame(&self, reference: usize, neighbours: usize, along: Alignments) -> AlignedFrame {
        let Self { merger, stabilizer, acquisition, ordinary, clean, .. } = self;
        let motion = self.motion(reference);
        let flow = &motion.likeliest;
        let blocks = Blocks::around(reference, merger.frames.len(), merger.block);
        let Merged { counts, noises, .. } = merger.merge_along(&blocks, flow);
        let noises = merger.blended(|i| [[noises[i]; SIDE]; SIDE]);
        let merged = image(&stabilizer.stabilized(&counts), stabilizer, acquisition, *ordinary);

        let nearest = nearest(merger.frames.len(), reference, neighbours + 1);
        let guide = &merger.pilots.as_ref().expect("set at first").frames;
        let here = merger.cropped(&guide[reference]);
        let deviations = here.data.iter().map(|&mean| {
            let variance = merger.moments.variance_at_mean(f64::from(mean));
            variance.max(LEAST_VARIANCE).sqrt() as f32
        });
        let deviations: Vec<f32> = deviations.collect();
        let less = |frame: Frame| {
            let values = frame.data.iter().zip(&here.data).zip(&deviations);
            let values = values.map(|((value, here), deviation)| (value - here) / deviation);
            Frame { size: here.size, data: values.collect() }
        };
        let mut seen = vec![less(merger.cropped(&merger.frames[reference]))];
        let mut expected = Vec::new();
        for way in 0..along.count() {
            let along = |flow: &Patchwise, k: usize| {
                [&merger.frames, guide].map(|list| merger.laid(&list[k], &flow[k], reference))
            };
            let laid = |&k: &usize| match way {
                0 => along(flow, k),
                1 => along(&motion.matched, k),
                _ => merger.closest(reference, k, [flow, &motion.matched]),
            };
            let laid: Vec<_> = nearest[1..].par_iter().map(|k| laid(k).map(less)).collect();
            for [counts, pilot] in laid {
                seen.push(counts);
                expected.push(pilot);
            }
            let end = (way + 1) * neighbours;
            seen.resize(1 + end, Frame::filled(here.size, 0.0));
            expected.resize(end, Frame::filled(here.size, 0.0));
        }
        AlignedFrame {
            reference: clean[reference].clone(),
            noise_sigma: self.noise(&here, &noises),
            counts: seen,
            expected,
            merged,
        }
    }

    /// `frames`, restored ones of this window in image units, each merged with its neighbours along their motion: each was
    /// denoised for itself and errs in its own way. `errors` are the variances of the errors that they do not share, pixel by
    /// pixel, about. One of each for every frame.
    pub fn temporal_filter(&self, frames: &[Frame], errors: &[Frame]) -> Vec<Frame> {
        let flows: Vec<&Patchwise> =
            (0..frames.len()).map(|frame| &self.motion(frame).likeliest).collect();
        steadied(frames, errors, &flows)
    }

    fn motion(&self, reference: usize) -> &Motion {
        self.flows[reference].get_or_init(|| {
            let (_, matched) = self.merger.matched(reference);
            let likeliest = self.merger.likeliest(reference, &matched);
            Motion { likeliest: likeliest.unwrap_or_else(|| matched.clone()), matched }
        })
    }

    /// Deviations in image units of merged counts whose mean is `means`: half of what separates the images one deviation
    /// above and below, through the inverse of the transform; black is no bound.
    fn noise(&self, means: &Frame, noises: &Frame) -> Frame {
        let n = self.merger.frames.len() as f64;
        let units = units(self.acquisition);
        let deviation = |(&mean, &noise): (&f32, &f32)| {
            let z = self.stabilizer.transform(n * f64::from(mean));
            let z = self.stabilizer.possible(z);
            let one = self.stabilizer.sigma(z) * (n * f64::from(noise)).sqrt();
            let span = self.stabilizer.invert(z + one) - self.stabilizer.invert(z - one);
            (0.5 * span * units) as f32
        };
        let pairs = means.data.iter().zip(&noises.data);
        Frame { size: means.size, data: pairs.map(deviation).collect() }
    }
}

impl Merger {
    /// `frame` laid upon the reference along the motion of every patch; the guide's where it does not reach.
    fn laid(&self, frame: &Frame, flow: &[[f32; 2]], reference: usize) -> Frame {
        self.blended(|i| self.sample(frame, i, flow[i], reference))
    }

    /// The part of `frame` within the window's size.
    fn cropped(&self, frame: &Frame) -> Frame {
        Frame::from_fn(self.size, |x, y| frame.row(y)[x])
    }
}
