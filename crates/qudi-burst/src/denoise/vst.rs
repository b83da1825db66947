//! Variance-stabilising transforms of sums of counts, and their exact unbiased inverses.
//!
//! - Binary sensors: the binomial Anscombe transform (Anscombe 1948; Chan, Elgendy and Wang, "Images from
//!   bits", Sensors 16(11):1961, 2016, eq. 14).
//! - Linear sensors: the generalized Anscombe transform (Murtagh et al. 1995; Makitalo and Foi 2013), or the
//!   integral of `1 / sqrt(Var y)` over the mean count. The integral also follows the counts into saturation,
//!   where their variance falls.
//!
//! All are scaled to a standard deviation of 1. The inverse is exact (Makitalo and Foi 2011): it returns the
//! detections at which the *expected* transform equals the given value, under the sensor's own distribution
//! with its rounding and clipping. Only counts too large to tabulate use the closed form.

use qudi_core::Frame;
use qudi_core::sensor::{CountLaw, CountMoments, Response, Sensor};
use rayon::prelude::*;

/// Variance-stabilising transform of sums of counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transform {
    /// No transform: the mean count.
    Identity,
    /// The binomial Anscombe transform for binary sensors, the generalized one for linear sensors.
    Anscombe,
    /// The integral of one over the standard deviation; equals `Anscombe` for binary sensors.
    Integral,
}

/// Largest maximum count of linear sensors that is tabulated. Above it, counts rarely clip and the closed
/// form is accurate enough.
const MAX_TABULATED_COUNT: u16 = 63;

/// Largest sum of binary counts that is tabulated. Larger sums are nearly Poisson-distributed.
const MAX_TABULATED_SUM: f64 = 4096.0;

/// Number of nodes of the inverse, spaced quadratically in the detections.
const NODES: usize = 256;

/// Number of steps of the integral.
const STEPS: usize = 4096;

/// A transform of sums of a given number of frames of one sensor.
#[derive(Clone, Debug)]
pub struct VarianceStabilizer {
    frames: f64,
    forward: Forward,
    /// Detections per frame, expected transform and its standard deviation, ascending. Empty where the closed
    /// form is used.
    nodes: Vec<[f64; 3]>,
    /// Gain in DN per electron; 1 for binary sensors.
    gain: f64,
    moments: CountMoments,
}

#[derive(Clone, Debug)]
enum Forward {
    Identity,
    Binomial {
        trials: f64,
    },
    Generalized {
        gain: f64,
        variance: f64,
    },
    /// Values at `STEPS + 1` mean counts from 0 to `full`.
    Table {
        full: f64,
        values: Vec<f64>,
    },
}

impl Forward {
    /// Transforms the sum of `frames` frames.
    fn at(&self, sum: f64, frames: f64) -> f64 {
        match self {
            Self::Identity => sum / frames,
            Self::Binomial { trials } => {
                let part = ((sum + 0.375) / (trials + 0.75)).clamp(0.0, 1.0);
                2.0 * (trials + 0.5).sqrt() * part.sqrt().asin()
            }
            Self::Generalized { gain, variance } => {
                2.0 * (sum / gain + 0.375 + frames * variance).max(0.0).sqrt()
            }
            Self::Table { full, values } => {
                // Anscombe's 3/8, at both ends.
                let mean = full * (sum + 0.375) / (frames * full + 0.75);
                let place = (mean / full * STEPS as f64).clamp(0.0, STEPS as f64);
                let i = (place as usize).min(STEPS - 1);
                let part = place - i as f64;
                frames.sqrt() * (values[i] + part * (values[i + 1] - values[i]))
            }
        }
    }
}

impl VarianceStabilizer {
    /// Creates the transform of sums of `frames` frames of `sensor`, at `gain` DN per electron.
    pub fn new(transform: Transform, sensor: &Sensor, gain: f64, frames: u32) -> Self {
        let law = CountLaw::new(sensor, gain);
        let moments = CountMoments::new(&law);
        let full = f64::from(sensor.max_count());
        let n = f64::from(frames);
        let forward = match (transform, sensor.response) {
            (Transform::Identity, _) => Forward::Identity,
            (_, Response::Binary) => Forward::Binomial { trials: n * full },
            (Transform::Integral, Response::Linear)
                if sensor.max_count() <= MAX_TABULATED_COUNT =>
            {
                Forward::Table { full, values: integral(&moments, full) }
            }
            (_, Response::Linear) => {
                // Rounding adds a variance of 1/12 DN^2.
                let variance = sensor.read_noise.powi(2) + 1.0 / (12.0 * gain * gain);
                Forward::Generalized { gain, variance }
            }
        };
        let mut stabilizer = Self { frames: n, forward, nodes: Vec::new(), gain, moments };
        let shallow = match sensor.response {
            Response::Linear => sensor.max_count() <= MAX_TABULATED_COUNT,
            Response::Binary => n * full <= MAX_TABULATED_SUM,
        };
        if shallow {
            stabilizer.tabulate(&law, sensor, frames);
        }
        stabilizer
    }

    /// Transforms a sum of counts, which may be fractional.
    pub fn transform(&self, sum: f64) -> f64 {
        self.forward.at(sum, self.frames)
    }

    /// Transforms a frame of mean counts.
    pub(crate) fn stabilized(&self, means: &Frame) -> Frame {
        let z = |&mean: &f32| self.transform(self.frames * f64::from(mean)) as f32;
        Frame { size: means.size, data: means.data.par_iter().map(z).collect() }
    }

    /// Returns the detections per frame whose expected transform is `z`, between 0 and half a count below
    /// saturation.
    pub fn invert(&self, z: f64) -> f64 {
        if self.nodes.is_empty() { self.closed_form(z) } else { self.look_up(z, 0) }
    }

    /// Clamps `z` to the range of expected transforms over all light levels.
    pub(crate) fn possible(&self, z: f64) -> f64 {
        match (self.nodes.first(), self.nodes.last()) {
            (Some(least), Some(most)) => z.clamp(least[1], most[1]),
            _ => z,
        }
    }

    /// Returns the mean count whose expected transform is `z`.
    pub fn mean_count(&self, z: f64) -> f64 {
        self.moments.at(self.invert(z)).0
    }

    /// Returns the standard deviation of the transform where its expected value is `z`: close to 1, or the
    /// mean count's own standard deviation for [`Transform::Identity`].
    pub fn sigma(&self, z: f64) -> f64 {
        match (&self.forward, self.nodes.is_empty()) {
            (_, false) => self.look_up(z, 2),
            (Forward::Identity, true) => (self.moments.variance_at_mean(z) / self.frames).sqrt(),
            _ => 1.0,
        }
    }

    fn look_up(&self, z: f64, column: usize) -> f64 {
        let above = self.nodes.partition_point(|node| node[1] < z).clamp(1, self.nodes.len() - 1);
        let (low, high) = (self.nodes[above - 1], self.nodes[above]);
        let part = ((z - low[1]) / (high[1] - low[1])).clamp(0.0, 1.0);
        low[column] + part * (high[column] - low[column])
    }

    fn closed_form(&self, z: f64) -> f64 {
        match self.forward {
            Forward::Identity | Forward::Table { .. } => (z / self.gain).max(0.0),
            Forward::Binomial { trials } => {
                let angle =
                    (z / (2.0 * (trials + 0.5).sqrt())).clamp(0.0, 0.5 * std::f64::consts::PI);
                let ones = (trials + 0.75) * angle.sin().powi(2) - 0.375;
                let part = (ones / trials).clamp(0.0, 1.0 - 0.5 / trials);
                -(-part).ln_1p() * trials / self.frames
            }
            // Makitalo and Foi 2013, eq. 10.
            Forward::Generalized { variance, .. } => {
                let noise = self.frames * variance;
                let z = z.max(2.0 * (0.375 + noise).sqrt());
                let root = 1.5f64.sqrt();
                let electrons = 0.25 * z * z + 0.25 * root / z - 1.375 / (z * z)
                    + 0.625 * root / (z * z * z)
                    - 0.125
                    - noise;
                electrons.max(0.0) / self.frames
            }
        }
    }

    /// Tabulates the expected value and standard deviation of the transform under the exact distribution of
    /// the sum.
    fn tabulate(&mut self, law: &CountLaw, sensor: &Sensor, frames: u32) {
        let full = f64::from(sensor.max_count());
        let most = match sensor.response {
            Response::Linear => law.detections_for_mean(full),
            Response::Binary => -full * (0.5 / (self.frames * full)).ln(),
        };
        // A sum of binary sums is a sum of more binary frames.
        let mut longer = sensor.clone();
        longer.frames_summed *= frames;
        let binary = CountLaw::new(&longer, 1.0);
        for i in 0..=NODES {
            let detections = most * (i as f64 / NODES as f64).powi(2);
            let sum = match sensor.response {
                Response::Binary => binary.probabilities(self.frames * detections),
                Response::Linear => {
                    let single = law.probabilities(detections);
                    (0..frames).fold(vec![1.0], |sum, _| convolve(&sum, &single))
                }
            };
            let values = || sum.iter().enumerate().map(|(s, p)| (self.transform(s as f64), p));
            let mean: f64 = values().map(|(z, p)| z * p).sum();
            let variance: f64 = values().map(|(z, p)| (z - mean) * (z - mean) * p).sum();
            // Without light and noise, the first nodes may coincide.
            if self.nodes.last().is_none_or(|node| node[1] < mean - 1e-9) {
                self.nodes.push([detections, mean, variance.max(0.0).sqrt()]);
            }
        }
        // The gain is so low that every count is 0: there is nothing to look up.
        if self.nodes.len() < 2 {
            self.nodes.clear();
        }
    }
}

/// Computes `integral from 0 to m of 1 / sqrt(Var y)` at `STEPS + 1` means.
fn integral(moments: &CountMoments, full: f64) -> Vec<f64> {
    let step = full / STEPS as f64;
    let mut total = 0.0;
    let mut values = vec![0.0];
    for i in 0..STEPS {
        let middle = (i as f64 + 0.5) * step;
        // A noiseless distribution has zero variance at its ends, where a count differs by at most half a
        // step.
        let variance = moments.variance_at_mean(middle).max(0.25 * step);
        total += step / variance.sqrt();
        values.push(total);
    }
    values
}

/// Convolves the distributions of two independent counts: the distribution of their sum.
fn convolve(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut sum = vec![0.0; a.len() + b.len() - 1];
    for (i, &p) in a.iter().enumerate().filter(|(_, p)| **p > 0.0) {
        for (cell, q) in sum[i..].iter_mut().zip(b) {
            *cell += p * q;
        }
    }
    sum
}
