//! Quanta burst photography (Ma, Gupta, Ulku, Bruschini, Charbon and Gupta, ACM TOG 39(4), 2020). Frames are
//! summed into blocks, and the blocks are aligned patch by patch with one reference. Their motion is
//! interpolated to single frames, the frames are warped and merged robustly, and the response is inverted.
//!
//! Every frame of the window serves as the reference once. Binary and few-bit counts are treated alike.

use crate::denoise::bm3d::SearchSettings;
use crate::denoise::stabilized::{denoise, image};
use crate::denoise::vst::{Transform, VarianceStabilizer};
use crate::merge::merged_frame::MergedFrame;
use crate::motion::block_alignment::BlockAligner;
use crate::patch::PatchMotion;
use crate::prepared_burst::PreparedBurst;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::windows::LONGEST_HALF;
use qudi_core::{Frame, Result};

/// Filter applied after the merge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PostFilter {
    /// No filter.
    None,
    /// BM3D on the merged frame, with stabilized variance.
    Bm3d,
}

/// Settings of QBP, chosen on training clips.
#[derive(Clone, Copy, Debug)]
pub struct QbpSettings {
    /// Number of detections per pixel in a block, which sets its length of at most 5 frames.
    pub detections_per_block: f64,
    /// Constant of the Wiener filter: the squared difference at which a coefficient gets half its weight, in
    /// units of the expected squared difference of noise.
    pub wiener_c: f32,
    /// Noise sigma assumed by BM3D, in units of the merge's own.
    pub bm3d_sigma_factor: f64,
}

impl QbpSettings {
    /// Creates the default settings for a given `post_filter`. With BM3D the merge is more selective: the
    /// remaining noise can be removed later, but ghosts cannot.
    pub fn new(post_filter: PostFilter) -> Self {
        let wiener_c = match post_filter {
            PostFilter::None => 64.0,
            PostFilter::Bm3d => 16.0,
        };
        Self { detections_per_block: 4.0, wiener_c, bm3d_sigma_factor: 1.3 }
    }
}

/// Quanta burst photography: align and merge.
#[derive(Clone, Copy, Debug)]
pub struct Qbp {
    pub(crate) post_filter: PostFilter,
    pub(crate) settings: QbpSettings,
}

impl Qbp {
    /// Creates the method with the default settings.
    pub fn new(post_filter: PostFilter) -> Self {
        Self::with_settings(post_filter, QbpSettings::new(post_filter))
    }

    /// Creates the method with other settings.
    pub fn with_settings(post_filter: PostFilter, settings: QbpSettings) -> Self {
        Self { post_filter, settings }
    }

    /// Restores the frames `references`, each from the whole window.
    fn merge_frames(
        &self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        references: &[usize],
    ) -> Result<Vec<Frame>> {
        let sensor = &acquisition.sensor;
        let ordinary_dark = sensor.dark_per_frame()?;
        let transform = match self.post_filter {
            PostFilter::None => Transform::Identity,
            PostFilter::Bm3d => Transform::Integral,
        };
        let frame_count = burst.frames.len();
        let vst = VarianceStabilizer::new(transform, sensor, acquisition.gain, frame_count as u32);
        let counts = PreparedBurst::new(burst, acquisition);
        let aligner = BlockAligner::new(&counts, self.block_length(acquisition)?);
        let restore = |reference: usize| {
            let (blocks, motion) = aligner.align(&counts, reference, &(0..frame_count));
            let merged =
                MergedFrame::from_blocks(&counts, &blocks, &motion, self.settings.wiener_c);
            let mut z = vst.stabilized(&merged.counts);
            if self.post_filter == PostFilter::Bm3d {
                let sigma = (frame_count as f64 * merged.noise).sqrt();
                let sigma = self.settings.bm3d_sigma_factor * sigma;
                z = denoise(SearchSettings::NORMAL, z, &vst, sigma);
            }
            image(&z, &vst, acquisition, ordinary_dark)
        };
        Ok(references.iter().map(|&reference| restore(reference)).collect())
    }

    /// Returns the number of frames in a block.
    pub(crate) fn block_length(self, acquisition: &Acquisition) -> Result<usize> {
        let sensor = &acquisition.sensor;
        let detections = sensor.quantum_efficiency * acquisition.ppp + sensor.dark_per_frame()?;
        let frames =
            (self.settings.detections_per_block / detections).ceil().clamp(1.0, 5.0) as usize;
        // An odd number, so that a block has a middle frame.
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

    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored> {
        Ok(Restored::gray(self.merge_frames(burst, acquisition, numbers)?, None))
    }
}

/// Motion of every patch of one frame to every frame of its window.
#[derive(Clone, Debug)]
pub struct PatchFlow {
    /// Corners of the 16 x 16 pixel patches, `(x, y)`.
    pub corners: Vec<[usize; 2]>,
    /// Displacements `[frame][patch]` in pixels, right and down.
    pub flow: PatchMotion,
}

impl PatchFlow {
    /// Finds the motion that [`Qbp`] uses for frame `reference`, for evaluation.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the sensor's dark rate is unknown.
    pub fn find(burst: BurstView<'_>, acquisition: &Acquisition, reference: usize) -> Result<Self> {
        let block_length = Qbp::new(PostFilter::None).block_length(acquisition)?;
        let counts = PreparedBurst::new(burst, acquisition);
        let all = 0..counts.frames.len();
        let (_, flow) = BlockAligner::new(&counts, block_length).align(&counts, reference, &all);
        let corners = (0..counts.grid.len()).map(|i| counts.grid.corner(i)).collect();
        Ok(Self { corners, flow })
    }
}
