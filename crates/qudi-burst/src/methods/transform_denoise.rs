//! Transform Denoise (Chan, Elgendy and Wang, "Images from bits: non-iterative image reconstruction for
//! quanta image sensors", Sensors 16(11):1961, 2016): sums of frames, a variance-stabilising transform, BM3D,
//! and the exact inverse. Without the transform it is BM3D alone.

use crate::denoise::bm3d::SearchSettings;
use crate::denoise::stabilized::{denoise, image};
use crate::denoise::vst::{Transform, VarianceStabilizer};
use crate::moving_sums::{moving_sums, sure_window_radius};
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::windows::LONGEST_HALF;
use qudi_core::{Frame, Result};

/// Approximate fraction of the noise variance that remains after BM3D (chosen on training clips,
/// docs/notes/burst/stabilization-and-length.md).
const REMAINING_NOISE: f64 = 0.05;

/// BM3D on moving sums of frames.
#[derive(Clone, Copy, Debug)]
pub struct TransformDenoise {
    transform: Transform,
    radius: usize,
}

impl TransformDenoise {
    /// Creates a method that denoises sums of `2 * radius + 1` frames.
    pub fn new(transform: Transform, radius: usize) -> Self {
        Self { transform, radius }
    }

    /// Chooses the length of the sums on windows of the clip, as a trade-off between motion blur and noise
    /// ([`sure_window_radius`]).
    pub fn choose(
        transform: Transform,
        samples: &[BurstView<'_>],
        acquisition: &Acquisition,
    ) -> Self {
        Self::new(transform, sure_window_radius(samples, acquisition, REMAINING_NOISE))
    }

    /// Returns the number of frames in each sum.
    pub fn length(self) -> usize {
        2 * self.radius + 1
    }
}

impl Restorer for TransformDenoise {
    fn name(&self) -> &'static str {
        if self.transform == Transform::Identity { "bm3d" } else { "transform-denoise" }
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
        let ordinary = acquisition.sensor.dark_per_frame()?;
        let mut vsts: Vec<Option<VarianceStabilizer>> = vec![None; self.length() + 1];
        let mut frames = Vec::with_capacity(burst.frames.len());
        moving_sums(burst, self.radius, |sums, n| {
            let vst = vsts[n as usize].get_or_insert_with(|| {
                VarianceStabilizer::new(self.transform, &acquisition.sensor, acquisition.gain, n)
            });
            let z = sums.iter().map(|&sum| vst.transform(f64::from(sum)) as f32).collect();
            let z = Frame { size: burst.size, data: z };
            let z = denoise(SearchSettings::NORMAL, z, vst, 1.0);
            frames.push(image(&z, vst, acquisition, ordinary));
        });
        Ok(Restored::gray(frames, None).only(numbers))
    }
}
