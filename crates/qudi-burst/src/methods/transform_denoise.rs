//! Transform Denoise (Chan, Elgendy and Wang, "Images from bits: non-iterative image reconstruction
//! for quanta image sensors", Sensors 16(11):1961, 2016): sums of frames, a variance-stabilising
//! transform, BM3D, the exact inverse. Without the transform it is BM3D alone.

use crate::denoise::bm3d::{Profile, bm3d_as};
use crate::denoise::plane::{Spread, spread};
use crate::denoise::stabilizer::{Transform, VarianceStabilizer};
use crate::{moving_sums, sure_window_radius};
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::windows::LONGEST_HALF;
use qudi_core::{Frame, Result};

/// What BM3D leaves of the variance of the noise, about (chosen on training clips, docs/results.md).
const NOISE_LEFT: f64 = 0.05;

/// BM3D on moving sums of frames.
#[derive(Clone, Copy, Debug)]
pub struct TransformDenoise {
    transform: Transform,
    half: usize,
}

impl TransformDenoise {
    /// On sums of `2 * half + 1` frames.
    pub fn new(transform: Transform, half: usize) -> Self {
        Self { transform, half }
    }

    /// Chooses the length of the sums on windows of the clip, so that what moves is not blurred more
    /// than the noise allows.
    pub fn choose(
        transform: Transform,
        samples: &[BurstView<'_>],
        acquisition: &Acquisition,
    ) -> Self {
        Self::new(transform, sure_window_radius(samples, acquisition, NOISE_LEFT))
    }

    /// Frames that it sums.
    pub fn length(self) -> usize {
        2 * self.half + 1
    }
}

impl Restorer for TransformDenoise {
    fn name(&self) -> &'static str {
        if self.transform == Transform::Identity { "bm3d" } else { "transform-denoise" }
    }

    fn window(&self) -> usize {
        2 * LONGEST_HALF + 1
    }

    fn restore(&mut self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Restored> {
        let ordinary = acquisition.sensor.dark_per_frame()?;
        let mut stabilizers: Vec<Option<VarianceStabilizer>> = vec![None; self.length() + 1];
        let mut frames = Vec::with_capacity(burst.frames.len());
        moving_sums(burst, self.half, |sums, n| {
            let stabilizer = stabilizers[n as usize].get_or_insert_with(|| {
                VarianceStabilizer::new(self.transform, &acquisition.sensor, acquisition.gain, n)
            });
            let z = sums.iter().map(|&sum| stabilizer.transform(f64::from(sum)) as f32).collect();
            let z = Frame { size: burst.size, data: z };
            let z = denoise(Profile::NORMAL, z, stabilizer, 1.0);
            frames.push(image(&z, stabilizer, acquisition, ordinary));
        });
        Ok(Restored { frames, std: None })
    }
}

/// BM3D on a transformed frame, whose noise is `scale` times that of the transform.
pub(crate) fn denoise(
    profile: Profile,
    mut z: Frame,
    stabilizer: &VarianceStabilizer,
    scale: f64,
) -> Frame {
    let Spread { low, high, variance } =
        spread(&z, |mean| (scale * stabilizer.sigma(mean)).powi(2));
    let sigma = variance.sqrt();
    // BM3D's thresholds are for contents within [0, 1].
    let range = (high - low).max(sigma).max(f64::MIN_POSITIVE);
    z.data.iter_mut().for_each(|v| *v = ((f64::from(*v) - low) / range) as f32);
    let mut clean = bm3d_as(profile, &z, (sigma / range) as f32);
    clean.data.iter_mut().for_each(|v| *v = (f64::from(*v) * range + low) as f32);
    clean
}

/// Image units of a detection.
pub(crate) fn units(acquisition: &Acquisition) -> f64 {
    1.0 / (acquisition.photons_per_unit() * acquisition.sensor.quantum_efficiency)
}

/// The image behind a denoised transform: inverse, dark counts subtracted.
pub(crate) fn image(
    z: &Frame,
    stabilizer: &VarianceStabilizer,
    acquisition: &Acquisition,
    ordinary: f64,
) -> Frame {
    let units = units(acquisition);
    let pixel = |(i, &z): (usize, &f32)| {
        let detections = stabilizer.invert(f64::from(z)) - acquisition.dark_of(i, ordinary);
        (detections.max(0.0) * units) as f32
    };
    Frame { size: z.size, data: z.data.iter().enumerate().map(pixel).collect() }
}
