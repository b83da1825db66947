//! The uncertainty of a result: as the method predicts it, or from photons drawn again.

use super::restored::{CENTRE, stop_if_asked};
use super::scenes::{FRAMES, SIZE};
use crate::error::Result;
use crate::report::Bar;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::{Camera, Frame, Light};

/// Bursts drawn from the result for its uncertainty, where the method does not predict one.
const REDRAWN_BURSTS: u64 = 4;

/// The uncertainty of every pixel of a result.
pub(super) struct Uncertainty {
    /// One of every frame, or of the frame in the centre alone.
    pub(super) frames: Vec<Frame>,
    /// Description for the console.
    pub(super) said: &'static str,
    /// Description for the page.
    pub(super) meaning: &'static str,
}

impl Uncertainty {
    /// Takes the standard deviations that a method predicts.
    pub(super) fn predicted(sigmas: Vec<Frame>) -> Self {
        Self {
            frames: sigmas,
            said: "it predicts, without the truth,",
            meaning: "the standard deviation of its errors that the method predicts without the truth, in units of white",
        }
    }

    /// Estimates how the centre frame of `result` varies where the photons are drawn again, as if it were the
    /// truth: what a capture without truth can tell of its errors (Efron 1979, the parametric bootstrap).
    pub(super) fn redrawn(
        method: &mut dyn Restorer,
        result: &[Frame],
        acquisition: &Acquisition,
        bar: &mut Bar,
    ) -> Result<Self> {
        let light = Light { ppp: acquisition.ppp, mean_level: acquisition.mean_level };
        let mut sums = vec![[0.0f32; 2]; SIZE.pixels()];
        for draw in 1..=REDRAWN_BURSTS {
            let mut camera = Camera::new(&acquisition.sensor, SIZE, light, acquisition.seed)?;
            let mut burst = Vec::with_capacity(FRAMES);
            for (t, frame) in (draw * FRAMES as u64..).zip(result) {
                burst.push(camera.expose(t, &[frame])?);
            }
            let view = BurstView { size: SIZE, frames: &burst };
            let again = method.restore(view, acquisition)?.frames;
            for (sum, value) in sums.iter_mut().zip(&again[CENTRE].data) {
                *sum = [sum[0] + value, sum[1] + value * value];
            }
            bar.update("drawing photons again", draw, Some(REDRAWN_BURSTS));
            stop_if_asked()?;
        }
        let n = REDRAWN_BURSTS as f32;
        let sigma =
            |[sum, squares]: &[f32; 2]| ((squares - sum * sum / n).max(0.0) / (n - 1.0)).sqrt();
        Ok(Self {
            frames: vec![Frame { size: SIZE, data: sums.iter().map(sigma).collect() }],
            said: "where photons are drawn again from its result, it varies by",
            meaning: "how the middle frame of the result varies where photons are drawn again from it, in units of white",
        })
    }

    /// Returns the uncertainty of the frame in the centre.
    pub(super) fn centre(&self) -> &Frame {
        &self.frames[self.frames.len() / 2]
    }
}
