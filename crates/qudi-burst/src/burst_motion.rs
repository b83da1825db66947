//! Motion between the frames of a burst, patch by patch: first from its counts, then on better frames.

use crate::denoise::stabilized::units;
use crate::merge::blocks::Blocks;
use crate::methods::{PostFilter, Qbp};
use crate::motion::block_alignment::BlockAligner;
use crate::motion::cells::Cells;
use crate::motion::constant_velocity::ConstantVelocity;
use crate::motion::global_motion::GlobalMotion;
use crate::motion::hypotheses::{select_on_counts, select_on_estimates};
use crate::motion::reference_frames::ReferenceFrames;
use crate::patch::{PatchMotion, padded};
use crate::prepared_burst::PreparedBurst;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::{Frame, Size};
use rayon::prelude::*;
use std::ops::Range;

/// Approximate variance of the errors of better frames, in units of the counts' variance.
pub(crate) const FRAME_ERROR: f32 = 0.1;

/// Penalty of motion that is matched in counts, in units of their noise's variance: it repeats the noise of
/// the counts that judge it.
const MATCHED_PENALTY: f32 = 100.0;

/// Finds the motion between the frames of a burst. Every patch of 16 x 16 pixels moves as it matches best,
/// with constant velocity, with most of the image, or not at all, whichever the counts of all frames make
/// most likely.
#[derive(Debug)]
pub struct BurstMotion {
    pub(crate) burst: PreparedBurst,
    pub(crate) velocity: Option<ConstantVelocity>,
    pub(crate) acquisition: Acquisition,
    /// Dark detections of an ordinary pixel.
    pub(crate) ordinary_dark: f64,
}

/// The search for motion in the counts alone.
#[derive(Debug)]
pub(crate) struct CountsMotion<'a> {
    of: &'a BurstMotion,
    aligner: BlockAligner,
    global: Option<GlobalMotion>,
}

/// Motion of the patches of one frame to all frames.
#[derive(Clone, Debug)]
pub(crate) struct FrameMotion {
    /// Motion along the most likely hypothesis of each patch.
    pub(crate) selected: PatchMotion,
    /// Motion matched frame by frame.
    pub(crate) matched: PatchMotion,
}

/// Motion of the patches of every frame to every frame.
#[derive(Debug)]
pub struct FoundMotion<'a> {
    burst: &'a PreparedBurst,
    /// By reference frame.
    patches: Vec<PatchMotion>,
}

/// Motion of the cells of every frame to every frame.
#[derive(Debug)]
pub struct CellMotion<'a> {
    cells: Cells,
    /// By reference frame.
    patches: &'a [PatchMotion],
}

impl BurstMotion {
    /// Prepares a burst. A dark rate that is unknown counts as none; a map of dark rates must be as large as
    /// the frames.
    pub fn new(view: BurstView<'_>, acquisition: &Acquisition) -> Self {
        let burst = PreparedBurst::new(view, acquisition);
        let velocity = ConstantVelocity::find(&burst, 0.0);
        let ordinary_dark = acquisition.sensor.dark_per_frame().unwrap_or(0.0);
        Self { burst, velocity, acquisition: acquisition.clone(), ordinary_dark }
    }

    /// Returns the size of the frames.
    pub fn size(&self) -> Size {
        self.burst.size
    }

    /// Finds the motion to the frames up to `reach` frames away from the counts of these frames.
    pub fn on_counts(&self, reach: usize) -> FoundMotion<'_> {
        let qbp = Qbp::new(PostFilter::None);
        let counts = self.counts(qbp.block_length(&self.acquisition).unwrap_or(1));
        let frames = self.burst.frames.len();
        self.found(|reference| {
            let near = reference.saturating_sub(reach)..(reference + reach + 1).min(frames);
            counts.motion(reference, &near, MATCHED_PENALTY).1
        })
    }

    /// Finds the motion on better frames of the same burst, in image units.
    ///
    /// # Panics
    /// If there are not as many frames, of the same size.
    pub fn on_frames(&self, frames: &[Frame]) -> FoundMotion<'_> {
        assert_eq!(frames.len(), self.burst.frames.len(), "a better frame for every frame");
        let references = self.references(frames);
        self.found(|reference| self.on_references(&references, reference).selected)
    }

    /// Prepares the search in counts, whose frames are averaged in blocks of `block_length`.
    pub(crate) fn counts(&self, block_length: usize) -> CountsMotion<'_> {
        CountsMotion {
            of: self,
            aligner: BlockAligner::new(&self.burst, block_length),
            global: GlobalMotion::find(&self.burst.frames, &self.burst.moments, 1.0),
        }
    }

    /// Prepares the search on better frames, in image units.
    pub(crate) fn references(&self, frames: &[Frame]) -> ReferenceFrames {
        let Self { burst, acquisition, ordinary_dark, .. } = self;
        let units = units(acquisition);
        let means = frames.iter().map(|frame| {
            assert_eq!(frame.size, burst.size, "the size of the burst");
            let mean = |(i, &image): (usize, &f32)| {
                let detections = f64::from(image) / units + acquisition.dark_of(i, *ordinary_dark);
                burst.moments.at(detections).0 as f32
            };
            let means: Vec<f32> = frame.data.par_iter().enumerate().map(mean).collect();
            padded(&means, frame.size, burst.padded_size())
        });
        ReferenceFrames::new(burst, means.collect(), FRAME_ERROR)
    }

    /// Finds the motion of frame `reference` on better frames.
    pub(crate) fn on_references(
        &self,
        references: &ReferenceFrames,
        reference: usize,
    ) -> FrameMotion {
        let (burst, velocity) = (&self.burst, self.velocity.as_ref());
        let matched = references.align(burst, reference);
        let selected = select_on_estimates(burst, velocity, references, reference, matched.clone());
        FrameMotion { selected, matched }
    }

    fn found(&self, of: impl Fn(usize) -> PatchMotion + Sync + Send) -> FoundMotion<'_> {
        let references = 0..self.burst.frames.len();
        FoundMotion { burst: &self.burst, patches: references.into_par_iter().map(of).collect() }
    }
}

impl CountsMotion<'_> {
    /// Divides the burst into blocks around frame `reference`, and finds its motion to `frames`. Matched
    /// motion has a penalty, in units of the noise's variance.
    pub(crate) fn motion(
        &self,
        reference: usize,
        frames: &Range<usize>,
        penalty: f32,
    ) -> (Blocks, PatchMotion) {
        let BurstMotion { burst, velocity, .. } = self.of;
        let (velocity, global) = (velocity.as_ref(), self.global.as_ref());
        let (blocks, matched) = self.aligner.align(burst, reference, frames);
        let matched = (penalty, matched);
        (blocks, select_on_counts(burst, velocity, global, reference, frames, matched))
    }
}

impl FoundMotion<'_> {
    /// Prepares the flow of cells of `side` x `side` pixels. Overlapping patches are blended.
    pub fn on_cells(&self, side: usize) -> CellMotion<'_> {
        let PreparedBurst { grid, size, .. } = self.burst;
        CellMotion { cells: Cells::new(grid, *size, side), patches: &self.patches }
    }
}

impl CellMotion<'_> {
    /// Returns the displacement from every cell of frame `from` to where frame `to` shows the same, right and
    /// down in pixels.
    pub fn flow(&self, from: usize, to: usize) -> [Frame; 2] {
        self.cells.blended(&self.patches[from][to])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::sensor::Sensor;
    use qudi_core::{Camera, Light};

    const FRAMES: usize = 7;

    /// Returns frames of a texture that moves by `speed` pixels a frame, their photons, and their light.
    fn moving(size: Size, speed: [f32; 2]) -> (Vec<Frame>, Vec<Vec<u16>>, Acquisition) {
        let truth: Vec<Frame> = (0..FRAMES)
            .map(|t| {
                Frame::from_fn(size, |x, y| {
                    let [x, y] = [x as f32 - speed[0] * t as f32, y as f32 - speed[1] * t as f32];
                    // Waves in all directions, of lengths of 7 to 60 pixels.
                    let wave = |k: usize| {
                        let (angle, length) = (2.4 * k as f32, 7.0 * 1.36f32.powi(k as i32));
                        let along = x * angle.cos() + y * angle.sin();
                        (std::f32::consts::TAU * along / length + angle).sin()
                    };
                    (0.45 + 0.1 * (0..8).map(wave).sum::<f32>()).clamp(0.02, 1.0)
                })
            })
            .collect();
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        let light = Light { ppp: 3.25, mean_level: 0.45 };
        let mut camera = Camera::new(&sensor, size, light, 1).unwrap_or_else(|e| panic!("{e}"));
        let expose = |(t, frame): (usize, &Frame)| camera.expose(t as u64, &[frame]);
        let counts: qudi_core::Result<_> = truth.iter().enumerate().map(expose).collect();
        let acquisition = Acquisition::new(sensor, light.ppp, light.mean_level);
        let acquisition = acquisition.unwrap_or_else(|e| panic!("{e}"));
        (truth, counts.unwrap_or_else(|e| panic!("{e}")), acquisition)
    }

    /// Returns the mean distance of the flow from `expected`, in pixels, far from the borders.
    fn error(flow: &[Frame; 2], expected: [f32; 2]) -> f32 {
        let Size { height, width } = flow[0].size;
        let inner = (16..height - 16).flat_map(|y| (16..width - 16).map(move |x| y * width + x));
        let distances: Vec<f32> = inner
            .map(|i| (flow[0].data[i] - expected[0]).hypot(flow[1].data[i] - expected[1]))
            .collect();
        distances.iter().sum::<f32>() / distances.len() as f32
    }

    /// Counts show the motion to within a fraction of a pixel a frame, true frames much better.
    #[test]
    fn motion_is_found_and_better_frames_show_it_better() {
        let size = Size { height: 64, width: 80 };
        for speed in [[0.0, 0.0], [1.3, -0.6], [-2.5, 1.0]] {
            let (truth, counts, acquisition) = moving(size, speed);
            let motion = BurstMotion::new(BurstView { size, frames: &counts }, &acquisition);
            for (from, to) in [(3, 4), (3, 2), (1, 4), (6, 3)] {
                let time = to as f32 - from as f32;
                let expected = speed.map(|v| v * time);
                let on_counts =
                    error(&motion.on_counts(FRAMES).on_cells(1).flow(from, to), expected);
                let on_frames =
                    error(&motion.on_frames(&truth).on_cells(1).flow(from, to), expected);
                assert!(
                    on_counts < 0.2 + 0.2 * time.abs(),
                    "{speed:?}, {from} to {to}: {on_counts}"
                );
                assert!(on_frames < 0.05, "{speed:?}, {from} to {to}: {on_frames}");
            }
        }
    }

    /// Motion that is matched in counts repeats their noise: with its penalty, a static scene moves less.
    #[test]
    fn penalty_of_matched_motion_lets_a_static_scene_rest() {
        let size = Size { height: 64, width: 80 };
        let (_, counts, acquisition) = moving(size, [0.0; 2]);
        let motion = BurstMotion::new(BurstView { size, frames: &counts }, &acquisition);
        let searched = motion.counts(1);
        let [without, with] = [0.0, MATCHED_PENALTY].map(|penalty| {
            let found =
                motion.found(|reference| searched.motion(reference, &(0..FRAMES), penalty).1);
            error(&found.on_cells(1).flow(3, 2), [0.0; 2])
        });
        assert!(with < 0.6 * without, "{without} px without, {with} px with the penalty");
    }

    #[test]
    fn frames_smaller_than_a_patch_have_a_flow() {
        let size = Size { height: 5, width: 9 };
        let (truth, counts, acquisition) = moving(size, [0.0; 2]);
        let motion = BurstMotion::new(BurstView { size, frames: &counts }, &acquisition);
        for found in [motion.on_counts(2), motion.on_frames(&truth)] {
            let flow = found.on_cells(1).flow(0, 2);
            assert!(flow.iter().all(|axis| axis.size == size));
            assert!(flow.iter().flat_map(|axis| &axis.data).all(|value| value.is_finite()));
        }
    }
}
