//! Two rounds of aligning and merging: what the first one restores shows the second where things are and which
//! frames fit, far better than noisy frames can. Basic estimates that guide a second pass are BM3D's idea (Dabov et al.
//! 2007, section III-B), here applied to the whole of quanta burst photography with BM3D.

use crate::denoise::bm3d::Profile;
use crate::denoise::stabilizer::{Transform, VarianceStabilizer};
use crate::methods::qbp::{Merged, Merger, Pilots, PostFilter, Qbp, QbpSettings, at_least};
use crate::methods::transform_denoise::{denoise, image};
use crate::motion::camera::Camera;
use crate::motion::paths::Even;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::windows::LONGEST_HALF;
use qudi_core::{Frame, Result};
use rayon::prelude::*;

/// Numbers of the second round, chosen on the validation clips (docs/results.md).
const TRUST: f32 = 0.7;
const NOISE: f64 = 1.0;

/// Variance of the first round's errors, in that of one frame's noise, about.
const ERROR: f32 = 0.3;

/// Variance of a pilot's errors, in the same, when the camera's motion is found: its squares are of many pixels.
const SHIFTED: f32 = 0.05;

/// BM3D for the pilots, and for the result: half the time and more is saved for less than 0.1 dB (docs/results.md).
const QUICK: Profile = Profile { radius: 8, step: [4, 3] };
const THOROUGH: Profile = Profile { radius: 12, step: [4, 3] };

/// The best classical estimate of a window, for a network to go on from.
#[derive(Debug)]
pub struct ReferenceEstimate {
    /// Restored frames, in image units.
    pub clean: Vec<Frame>,
    /// The same in mean counts, at least as large as a patch.
    pub(crate) means: Vec<Frame>,
    /// What found them.
    pub(crate) merger: Merger,
    pub(crate) stabilizer: VarianceStabilizer,
    /// Dark detections of an ordinary pixel.
    pub(crate) ordinary: f64,
}

impl ReferenceEstimate {
    /// Restores the window twice.
    ///
    /// # Errors
    /// [`SimError`](qudi_core::SimError) if the sensor's dark rate is unknown.
    pub fn compute(burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Self> {
        let ordinary = acquisition.sensor.dark_per_frame()?;
        let count = burst.frames.len();
        let n = count as f64;
        let stabilizer = VarianceStabilizer::new(
            Transform::Integral,
            &acquisition.sensor,
            acquisition.gain,
            count as u32,
        );
        let qbp = Qbp::new(PostFilter::Bm3d);
        let QbpSettings { wiener_c, bm3d_sigma_factor: first_noise, .. } = qbp.settings;
        let mut merger = Merger::new(burst, acquisition, qbp.block(acquisition)?, wiener_c);
        merger.even = Even::find(&merger);
        merger.camera = Camera::find(&merger.frames, &merger.moments, 1.0);
        let round = |merger: &Merger, profile, assumed| {
            let restored = |frame: usize| {
                let Merged { counts, noise, .. } = merger.merge(frame);
                let scale = assumed * (n * noise).sqrt();
                denoise(profile, stabilizer.stabilized(&counts), &stabilizer, scale)
            };
            (0..count).map(restored).collect::<Vec<Frame>>()
        };
        let means = |frames: &[Frame], size| {
            let mean = |&z: &f32| stabilizer.mean_count(f64::from(z)) as f32;
            let means = |z: &Frame| z.data.iter().map(mean).collect::<Vec<f32>>();
            frames.iter().map(|z| at_least(&means(z), burst.size, size)).collect()
        };
        let size = merger.frames[0].size;
        let frames = means(&round(&merger, QUICK, first_noise), size);
        merger.follow(Pilots { frames, error: ERROR });
        let restored = round(&merger, THOROUGH, NOISE);
        let clean = restored.iter().map(|z| image(z, &stabilizer, acquisition, ordinary)).collect();
        let means = means(&restored, size);
        Ok(Self { clean, means, merger, stabilizer, ordinary })
    }
}

/// The guide's restored frames as a method.
#[derive(Clone, Copy, Debug)]
pub struct QbpRefined;

impl Restorer for QbpRefined {
    fn name(&self) -> &'static str {
        "qbp-refined"
    }

    fn window(&self) -> usize {
        2 * LONGEST_HALF + 1
    }

    fn restore(&mut self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Restored> {
        Ok(Restored { frames: ReferenceEstimate::compute(burst, acquisition)?.clean, std: None })
    }
}

impl Merger {
    /// From now on goes by `pilots`, frame by frame.
    pub(crate) fn follow(&mut self, pilots: Pilots) {
        self.pyramids =
            pilots.frames.par_iter().map(crate::motion::pyramid::Pyramid::new).collect();
        (self.block, self.trust) = (1, TRUST);
        self.camera = Camera::find(&pilots.frames, &self.moments, SHIFTED);
        self.pilots = Some(pilots);
    }
}
