//! BM3D on frames of stabilized variance, and their conversion back to image units.

use super::block_statistics::{Spread, spread};
use super::bm3d::{SearchSettings, bm3d_with};
use super::vst::VarianceStabilizer;
use qudi_core::Frame;
use qudi_core::restorer::Acquisition;
use rayon::prelude::*;

/// Denoises a stabilized frame with BM3D. `scale` is the noise sigma in units of the transform's own.
pub(crate) fn denoise(
    search: SearchSettings,
    mut z: Frame,
    vst: &VarianceStabilizer,
    scale: f64,
) -> Frame {
    let Spread { low, high, variance } = spread(&z, |mean| (scale * vst.sigma(mean)).powi(2));
    let sigma = variance.sqrt();
    // BM3D's thresholds are for contents within [0, 1].
    let range = (high - low).max(sigma).max(f64::MIN_POSITIVE);
    z.data.iter_mut().for_each(|v| *v = ((f64::from(*v) - low) / range) as f32);
    let mut clean = bm3d_with(search, &z, (sigma / range) as f32);
    clean.data.iter_mut().for_each(|v| *v = (f64::from(*v) * range + low) as f32);
    clean
}

/// Returns the image value of one detection.
pub(crate) fn units(acquisition: &Acquisition) -> f64 {
    1.0 / (acquisition.photons_per_unit() * acquisition.sensor.quantum_efficiency)
}

/// Inverts the transform of a denoised frame and subtracts dark detections, from the dark map or the
/// `ordinary` value.
pub(crate) fn image(
    z: &Frame,
    vst: &VarianceStabilizer,
    acquisition: &Acquisition,
    ordinary: f64,
) -> Frame {
    let units = units(acquisition);
    let pixel = |(i, &z): (usize, &f32)| {
        let detections = vst.invert(f64::from(z)) - acquisition.dark_of(i, ordinary);
        (detections.max(0.0) * units) as f32
    };
    Frame { size: z.size, data: z.data.par_iter().enumerate().map(pixel).collect() }
}
