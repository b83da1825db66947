//! Drawing one count from first principles: electrons, read noise, digitiser; or binary frames.

use super::{CountLaw, Response};
use crate::random::uniform;
use rand::Rng;
use rand_distr::{Binomial, Distribution, Poisson, StandardNormal};

impl CountLaw {
    /// Draws a count at `detections` expected per output frame.
    pub(crate) fn draw(&self, detections: f64, rng: &mut impl Rng) -> u16 {
        self.draw_with_extra(detections, 0, rng)
    }

    /// Draws a count with `extra` detections on top of a Poisson number of mean `detections`.
    pub(crate) fn draw_with_extra(&self, detections: f64, extra: u32, rng: &mut impl Rng) -> u16 {
        match self.response {
            Response::Linear if self.dead_time > 0.0 => {
                debug_assert_eq!(extra, 0, "dead time makes arrivals dependent");
                self.digitise(counted(detections, self.dead_time, rng), rng)
            }
            Response::Linear => self.digitise(poisson(detections, rng) + f64::from(extra), rng),
            Response::Binary => {
                let n = f64::from(self.max_count);
                let mut fired =
                    binomial(u64::from(self.max_count), -(-detections / n).exp_m1(), rng) as u16;
                for _ in 0..extra {
                    // The extra photon falls into one of the n binary frames.
                    fired += u16::from(uniform(rng) * n >= f64::from(fired));
                }
                fired
            }
        }
    }

    /// Adds read noise, applies the gain, adds the pedestal, rounds half to even and clips.
    pub(crate) fn digitise(&self, electrons: f64, rng: &mut impl Rng) -> u16 {
        let mut voltage = electrons.min(self.full_well);
        if self.read_noise > 0.0 {
            let z: f64 = StandardNormal.sample(rng);
            voltage += self.read_noise * z;
        }
        let value = (self.gain * voltage + self.pedestal).round_ties_even();
        value.clamp(0.0, f64::from(self.max_count)) as u16
    }
}

/// Mean below which inversion is faster than the rejection method of `rand_distr`.
const INVERSION_LIMIT: f64 = 12.0;

/// Draws a Poisson number as f64.
pub(crate) fn poisson(mean: f64, rng: &mut impl Rng) -> f64 {
    if mean >= INVERSION_LIMIT {
        return Poisson::new(mean).expect("means are checked to be finite").sample(rng);
    }
    let mut u = uniform(rng);
    let (mut k, mut p) = (0.0, (-mean).exp());
    // The bound ends the search where rounding leaves a sliver of probability above the sum.
    while u >= p && k < 200.0 {
        u -= p;
        k += 1.0;
        p *= mean / k;
    }
    k
}

/// Draws a binomial number.
pub(crate) fn binomial(n: u64, p: f64, rng: &mut impl Rng) -> u64 {
    if n <= 16 {
        return (0..n).map(|_| u64::from(uniform(rng) < p)).sum();
    }
    Binomial::new(n, p.clamp(0.0, 1.0)).expect("a probability").sample(rng)
}

/// Draws the count of a non-paralysable counter in one exposure; `dead_time` is a fraction of the exposure.
pub(crate) fn counted(mean: f64, dead_time: f64, rng: &mut impl Rng) -> f64 {
    if mean <= 0.0 {
        return 0.0;
    }
    let (mut time, mut count) = (0.0, 0.0);
    loop {
        time += -(-uniform(rng)).ln_1p() / mean;
        if time >= 1.0 {
            return count;
        }
        count += 1.0;
        time += dead_time;
    }
}
