//! Quanta burst photography (Ma, Gupta, Ulku, Bruschini, Charbon and Gupta, ACM TOG 39(4), 2020):
//! frames are summed into blocks, the blocks aligned patch by patch with one reference, the motion
//! interpolated between them, the frames warped and merged robustly, and the response inverted.
//!
//! Every frame of the window is the reference once. Binary and few-bit counts are treated alike.

use crate::denoise::bm3d::Profile;
use crate::denoise::stabilizer::{Transform, VarianceStabilizer};
use crate::merge::blocks::Blocks;
use crate::merge::cubic::{cubic_within, squares};
use crate::merge::dft::SIDE;
use crate::merge::wiener::{Member, merge};
use crate::methods::transform_denoise::{denoise, image};
use crate::motion::align::{align, finest_grid, sample};
use crate::motion::camera::Camera;
use crate::motion::grid::Grid;
use crate::motion::paths::Even;
use crate::motion::pyramid::Pyramid;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::sensor::{CountLaw, CountMoments};
use qudi_core::windows::LONGEST_HALF;
use qudi_core::{Frame, Result, Size};
use rayon::prelude::*;

/// What follows the merge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PostFilter {
    /// Nothing follows.
    None,
    /// The variance is stabilised and BM3D removes the noise that is left.
    Bm3d,
}

/// Numbers that training clips decide.
#[derive(Clone, Copy, Debug)]
pub struct QbpSettings {
    /// Blocks hold as many frames as it takes for this many detections per pixel, at most 5.
    pub detections_per_block: f64,
    /// The constant of the Wiener filter: the squared difference, in units of that which noise makes, at which a
    /// block gets half its weight.
    pub wiener_c: f32,
    /// The noise sigma that BM3D assumes, in units of the merge's own.
    pub bm3d_sigma_factor: f64,
}

impl QbpSettings {
    /// Those of docs/results.md, chosen on training clips. Where BM3D follows it pays to merge less:
    /// noise can still be removed, ghosts cannot.
    pub fn new(post_filter: PostFilter) -> Self {
        let wiener_c = match post_filter {
            PostFilter::None => 64.0,
            PostFilter::Bm3d => 16.0,
        };
        Self { detections_per_block: 4.0, wiener_c, bm3d_sigma_factor: 1.3 }
    }
}

/// Align and merge.
#[derive(Clone, Copy, Debug)]
pub struct Qbp {
    pub(crate) post_filter: PostFilter,
    pub(crate) settings: QbpSettings,
}

impl Qbp {
    /// With the settings of docs/results.md.
    pub fn new(post_filter: PostFilter) -> Self {
        Self::with_settings(post_filter, QbpSettings::new(post_filter))
    }

    /// With others.
    pub fn with_settings(post_filter: PostFilter, settings: QbpSettings) -> Self {
        Self { post_filter, settings }
    }

    /// Frames in a block.
    pub(crate) fn block(self, acquisition: &Acquisition) -> Result<usize> {
        let sensor = &acquisition.sensor;
        let detections = sensor.quantum_efficiency * acquisition.ppp + sensor.dark_per_frame()?;
        let frames =
            (self.settings.detections_per_block / detections).ceil().clamp(1.0, 5.0) as usize;
        // Odd, so that a block has a middle.
        Ok(frames | 1)
    }
}

impl Restorer for Qbp {
    fn name(&self) -> &'static str {
        match self.post_filter {
            PostFilter::None => "qbp",
            PostFilter::Bm3d => "qbp-bm3d",
        }
    }

    fn window(&self) -> usize {
        2 * LONGEST_HALF + 1
    }

    fn restore(&mut self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Restored> {
        let ordinary = acquisition.sensor.dark_per_frame()?;
        let transform = match self.post_filter {
            PostFilter::None => Transform::Identity,
            PostFilter::Bm3d => Transform::Integral,
        };
        let n = burst.frames.len() as f64;
        let stabilizer = VarianceStabilizer::new(
            transform,
            &acquisition.sensor,
            acquisition.gain,
            burst.frames.len() as u32,
        );
        let merger =
            Merger::new(burst, acquisition, self.block(acquisition)?, self.settings.wiener_c);
        let finish = |frame: usize| {
            let Merged { counts, noise, .. } = merger.merge(frame);
            let mut z = stabilizer.stabilized(&counts);
            if self.post_filter == PostFilter::Bm3d {
                let scale = self.settings.bm3d_sigma_factor * (n * noise).sqrt();
                z = denoise(Profile::NORMAL, z, &stabilizer, scale);
            }
            image(&z, &stabilizer, acquisition, ordinary)
        };
        Ok(Restored { frames: (0..burst.frames.len()).map(finish).collect(), std: None })
    }
}

/// Displacements or velocities of patches, `[frame][patch]`, right and down in pixels.
pub(crate) type Patchwise = Vec<Vec<[f32; 2]>>;

/// The motion of every patch of one frame to every frame of its window.
#[derive(Clone, Debug)]
pub struct PatchFlow {
    /// Corners of the patches of 16 x 16 pixels, `(x, y)`.
    pub corners: Vec<[usize; 2]>,
    /// `[frame][patch]`, right and down in pixels.
    pub flow: Patchwise,
}

impl PatchFlow {
    /// What [`Qbp`] finds for frame `reference`, for measuring it.
    ///
    /// # Errors
    /// [`SimError`](qudi_core::SimError) if the sensor's dark rate is unknown.
    pub fn find(burst: BurstView<'_>, acquisition: &Acquisition, reference: usize) -> Result<Self> {
        let qbp = Qbp::new(PostFilter::None);
        let merger =
            Merger::new(burst, acquisition, qbp.block(acquisition)?, qbp.settings.wiener_c);
        let (_, flow) = merger.flow(reference);
        let corners = (0..merger.grid.len()).map(|i| merger.grid.corner(i)).collect();
        Ok(Self { corners, flow })
    }
}

/// A merged frame.
pub(crate) struct Merged {
    /// Mean counts.
    pub(crate) counts: Frame,
    /// Variance of their noise, in that of one frame.
    pub(crate) noise: f64,
    /// The same of every patch.
    pub(crate) noises: Vec<f32>,
}

/// Merges the frames of one window.
#[derive(Debug)]
pub(crate) struct Merger {
    /// Size of the window's frames; `frames` may be larger.
    pub(crate) size: Size,
    /// Counts, hot pixels repaired, at least as large as a patch.
    pub(crate) frames: Vec<Frame>,
    pub(crate) block: usize,
    pub(crate) trust: f32,
    pub(crate) moments: CountMoments,
    pub(crate) grid: Grid,
    /// Pyramids of single frames, of which blocks of one frame need no others.
    pub(crate) pyramids: Vec<Pyramid>,
    /// Estimates of the frames' mean counts, if there are any.
    pub(crate) pilots: Option<Pilots>,
    /// Even motion, which patches may follow.
    pub(crate) even: Option<Even>,
    /// The camera's, which they may follow, too.
    pub(crate) camera: Option<Camera>,
}

/// What an earlier round made of the frames: motion is found in it, and what does not fit.
#[derive(Debug)]
pub(crate) struct Pilots {
    /// Mean counts, as large as the frames.
    pub(crate) frames: Vec<Frame>,
    /// Variance of their errors, in that of the counts' noise.
    pub(crate) error: f32,
}

impl Merger {
    pub(crate) fn new(
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        block: usize,
        trust: f32,
    ) -> Self {
        let moments = CountMoments::new(&CountLaw::new(&acquisition.sensor, acquisition.gain));
        let size = Size { height: burst.size.height.max(SIDE), width: burst.size.width.max(SIDE) };
        let hot = crate::merge::hot::HotPixels::find(burst, acquisition.sensor.max_count());
        let repaired = |counts: &Vec<u16>| at_least(&hot.repaired(counts), burst.size, size);
        let frames: Vec<Frame> = burst.frames.par_iter().map(repaired).collect();
        let pyramids =
            if block == 1 { frames.par_iter().map(Pyramid::new).collect() } else { Vec::new() };
        let grid = finest_grid(size);
        let size = burst.size;
        Self {
            size,
            frames,
            block,
            trust,
            moments,
            grid,
            pyramids,
            pilots: None,
            even: None,
            camera: None,
        }
    }

    /// The blocks around `reference`, and the motion of every patch to every frame.
    pub(crate) fn flow(&self, reference: usize) -> (Blocks, Patchwise) {
        let (blocks, matched) = self.matched(reference);
        let flow = self.likeliest(reference, &matched).unwrap_or(matched);
        (blocks, flow)
    }

    /// The same as matched frame by frame, whatever other paths are likelier.
    pub(crate) fn matched(&self, reference: usize) -> (Blocks, Patchwise) {
        let blocks = Blocks::around(reference, self.frames.len(), self.block);
        let own = self.pyramid(&blocks, blocks.reference);
        let variance = self.matching_variance(reference);
        let flows: Patchwise = (0..blocks.ranges.len())
            .into_par_iter()
            .map(|k| {
                if k == blocks.reference {
                    return vec![[0.0; 2]; self.grid.len()];
                }
                let there = self.pyramid(&blocks, k);
                align(&own, &there, (variance / blocks.ranges[k].len() as f32).max(1e-6))
            })
            .collect();
        let flow = blocks.interpolate(&flows, reference);
        (blocks, flow)
    }

    /// Variance of the noise of two matched pixels' difference; above zero also for images without noise.
    pub(crate) fn matching_variance(&self, reference: usize) -> f32 {
        let error = self.pilots.as_ref().map_or(1.0, |pilots| pilots.error);
        let single = self.moments.variance_at_mean(self.frames[reference].mean()) as f32;
        (2.0 * (error * single)).max(1e-6)
    }

    pub(crate) fn pyramid(&self, blocks: &Blocks, k: usize) -> std::borrow::Cow<'_, Pyramid> {
        let range = blocks.ranges[k].clone();
        if let ([pyramid], 1) = (self.pyramids.get(range.clone()).unwrap_or_default(), self.block) {
            return std::borrow::Cow::Borrowed(pyramid);
        }
        let mut mean = Frame::filled(self.frames[0].size, 0.0);
        let share = 1.0 / range.len() as f32;
        for frame in &self.frames[range] {
            for (sum, count) in mean.data.iter_mut().zip(&frame.data) {
                *sum += share * count;
            }
        }
        std::borrow::Cow::Owned(Pyramid::new(&mean))
    }

    pub(crate) fn merge(&self, reference: usize) -> Merged {
        let (blocks, flow) = self.flow(reference);
        self.merge_along(&blocks, &flow)
    }

    pub(crate) fn merge_along(&self, blocks: &Blocks, flow: &[Vec<[f32; 2]>]) -> Merged {
        let patches: Vec<_> =
            (0..self.grid.len()).into_par_iter().map(|i| self.patch(i, blocks, flow)).collect();
        let mut counts = self.blended(|i| patches[i].0);
        counts.data.iter_mut().for_each(|count| *count = count.max(0.0));
        let noises: Vec<f32> = patches.into_iter().map(|(_, noise)| noise).collect();
        let noise = noises.iter().map(|&noise| f64::from(noise)).sum::<f64>() / noises.len() as f64;
        Merged { counts, noise, noises }
    }

    /// The frame that overlapping patches make.
    pub(crate) fn blended(&self, patch: impl Fn(usize) -> crate::merge::dft::Patch) -> Frame {
        self.grid.blended(self.frames[0].size, self.size, patch)
    }

    /// Patch `i` displaced by `d`, between pixels. Bilinear as in the paper; what pilots have aligned deserves better, and
    /// where it has left the image is what the pilot has of frame `own`.
    pub(crate) fn sample(
        &self,
        image: &Frame,
        i: usize,
        d: [f32; 2],
        own: usize,
    ) -> crate::merge::dft::Patch {
        let corner = self.grid.corner(i);
        let at = [corner[0] as f32 + d[0], corner[1] as f32 + d[1]];
        let Some(pilots) = &self.pilots else { return sample(image, at) };
        cubic_within(image, at, &pilots.frames[own], corner)
    }

    /// What such a patch, `part` of a pixel along a side, keeps of the noise's variance along that side.
    pub(crate) fn squares(&self, part: f32) -> f32 {
        if self.pilots.is_some() {
            squares(part)
        } else {
            part * part + (1.0 - part) * (1.0 - part)
        }
    }

    /// Patch `i` of the reference, merged, and its noise.
    pub(crate) fn patch(
        &self,
        i: usize,
        blocks: &Blocks,
        flow: &[Vec<[f32; 2]>],
    ) -> (crate::merge::dft::Patch, f32) {
        let own = blocks.ranges[blocks.reference].start;
        let member = |range: &std::ops::Range<usize>| {
            let share = 1.0 / range.len() as f32;
            let mut mean = [[0.0; SIDE]; SIDE];
            let mut noise = 0.0;
            for frame in range.clone() {
                let d = flow[frame][i];
                let warped = self.sample(&self.frames[frame], i, d, own);
                for (mean, value) in mean.iter_mut().flatten().zip(warped.iter().flatten()) {
                    *mean += share * value;
                }
                // Between pixels the sample is a mean of some of them.
                let left = d.map(|d| self.squares(d - d.floor()));
                noise += share * share * left[0] * left[1];
            }
            // Blocks have one frame where there are pilots.
            let pilot = self.pilots.as_ref().map(|pilots| {
                self.sample(&pilots.frames[range.start], i, flow[range.start][i], own)
            });
            Member { patch: mean, frames: range.len() as f32, noise, pilot }
        };
        let others =
            (0..blocks.ranges.len()).filter(|&k| k != blocks.reference).map(|k| &blocks.ranges[k]);
        let members: Vec<Member> =
            std::iter::once(&blocks.ranges[blocks.reference]).chain(others).map(member).collect();
        let mean = members[0].patch.iter().flatten().sum::<f32>() / (SIDE * SIDE) as f32;
        let variance = self.moments.variance_at_mean(f64::from(mean)) as f32;
        merge(&members, variance, self.trust)
    }
}

/// Up to `count` of so many frames, the nearest to `reference` first: itself, and of two as near the later one.
pub(crate) fn nearest(frames: usize, reference: usize, count: usize) -> Vec<usize> {
    let mut list: Vec<usize> = (0..frames).collect();
    list.sort_by_key(|&frame| (frame.abs_diff(reference), frame < reference));
    list.truncate(count);
    list
}

/// Values of size `from` with the border repeated up to `size`.
pub(crate) fn at_least(values: &[f32], from: Size, size: Size) -> Frame {
    Frame::from_fn(size, |x, y| values[y.min(from.height - 1) * from.width + x.min(from.width - 1)])
}
