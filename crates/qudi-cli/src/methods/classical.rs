//! Classical methods whose settings are chosen on the capture.

use super::Built;
use crate::error::Result;
use crate::report::counted;
use qudi_burst::{Mle, Transform, TransformDenoise};
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_io::capture::Capture;

/// Windows of a capture that a method's settings are chosen on.
const SAMPLES: u64 = 4;

/// Makes the restorer of `mle`, with the number of frames chosen on the capture.
pub(super) fn mle(capture: &mut Capture, acquisition: &Acquisition) -> Result<Built> {
    let mle = sampled(capture, |views| Mle::choose(views, acquisition))?;
    Ok((Box::new(mle), over(mle.length(), capture)))
}

/// Makes the restorer of `transform-denoise` and `bm3d`, with the number of frames chosen on the capture.
pub(super) fn transform_denoise(
    transform: Transform,
    capture: &mut Capture,
    acquisition: &Acquisition,
) -> Result<Built> {
    let chosen = sampled(capture, |views| TransformDenoise::choose(transform, views, acquisition))?;
    Ok((Box::new(chosen), over(chosen.length(), capture)))
}

/// Returns the number of frames in a sum, in words; a capture may have fewer.
fn over(length: usize, capture: &Capture) -> String {
    format!(" over {}", counted(capture.frames().min(length as u64), "frame"))
}

/// Applies `choose` to a few windows of the capture.
fn sampled<T>(capture: &mut Capture, choose: impl FnOnce(&[BurstView<'_>]) -> T) -> Result<T> {
    let samples = sample_windows(capture)?;
    let size = capture.size();
    let views: Vec<_> = samples.iter().map(|frames| BurstView { size, frames }).collect();
    Ok(choose(&views))
}

/// Reads a few windows spread over the capture, or the first ones of a file that cannot be rewound.
fn sample_windows(capture: &mut Capture) -> Result<Vec<Vec<Vec<u16>>>> {
    let length = capture.frames().min(11);
    let last = capture.frames() - length;
    let spread = if capture.forward_only() { last.min(SAMPLES * length) } else { last };
    let windows = SAMPLES.min(spread / length + 1);
    let mut samples = Vec::new();
    for n in 0..windows {
        let first = spread * n / (windows - 1).max(1);
        let mut frames = vec![vec![0; capture.size().pixels()]; length as usize];
        for (frame, counts) in (first..).zip(&mut frames) {
            capture.read(frame, counts)?;
        }
        samples.push(frames);
    }
    Ok(samples)
}
