//! The most likely flux of a moving mean: response inverted, dark counts subtracted, over as many
//! frames as the motion allows.

use super::{BurstView, Context, Restored, Restorer, moving_sums};
use crate::error::Result;
use crate::frame::Frame;
use crate::sensor::{CountLaw, CountMoments};

/// Frames on either side that are tried.
const HALVES: [usize; 6] = [0, 1, 2, 3, 4, 5];

/// Maximum-likelihood estimate over a window of 1 to 11 frames.
#[derive(Clone, Copy, Debug)]
pub struct Mle {
    half: usize,
}

impl Mle {
    /// Over `half` frames on either side.
    pub fn new(half: usize) -> Self {
        Self { half }
    }

    /// Chooses the length of least estimated risk on windows of the clip. With `y` a frame's counts
    /// and `m` the mean of the `L` frames around it, `E (m - y)^2 + (2 / L - 1) Var y` is the mean
    /// squared error of `m` (Stein 1981; Mallows 1973), and the sensor says what `Var y` is.
    pub fn choose(samples: &[BurstView<'_>], context: &Context) -> Self {
        let moments = CountMoments::new(&CountLaw::new(&context.sensor, context.gain));
        let risk = |half: usize| -> f64 {
            let mut total = 0.0;
            for burst in samples {
                let mut frame = 0;
                moving_sums(*burst, half, |sums, n| {
                    let n = f64::from(n);
                    for (&sum, &own) in sums.iter().zip(&burst.frames[frame]) {
                        let mean = f64::from(sum) / n;
                        let difference = mean - f64::from(own);
                        // The longest mean would know the variance best; it hardly matters.
                        let variance = moments.variance_at_mean(mean);
                        total += difference * difference + (2.0 / n - 1.0) * variance;
                    }
                    frame += 1;
                });
            }
            total
        };
        let risks = HALVES.map(risk);
        let best = (0..risks.len()).min_by(|&a, &b| risks[a].total_cmp(&risks[b])).unwrap_or(0);
        Self { half: HALVES[best] }
    }

    /// Frames that it sums.
    pub fn length(self) -> usize {
        2 * self.half + 1
    }
}

impl Restorer for Mle {
    fn name(&self) -> &'static str {
        "mle"
    }

    fn window(&self) -> usize {
        2 * HALVES[HALVES.len() - 1] + 1
    }

    fn restore(&mut self, burst: BurstView<'_>, context: &Context) -> Result<Restored> {
        let ordinary = context.sensor.dark_per_frame()?;
        let units = 1.0 / context.photons_per_unit();
        let mut frames = Vec::with_capacity(burst.frames.len());
        moving_sums(burst, self.half, |sums, n| {
            let pixel = |(i, &sum): (usize, &u32)| {
                let dark = context.dark_of(i, ordinary);
                let flux = context.sensor.estimate_flux(f64::from(sum), n, context.gain, dark);
                (flux * units) as f32
            };
            let data = sums.iter().enumerate().map(pixel).collect();
            frames.push(Frame { size: burst.size, data });
        });
        Ok(Restored { frames, std: None })
    }
}
