//! The law of a count as tables: mean, variance and slope by detections, and the inverse.

use qudi_core::Result;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::{CountLaw, CountMoments, Response};
use rayon::prelude::*;

/// Nodes of the tables.
const NODES: usize = 1024;

/// Share of full scale at which counts tell no more light: bright colours saturate long before luma does.
const SATURATION: f64 = 0.998;

/// Detections of a binary sensor that saturate it, in units of the frames it sums.
const BINARY_SATURATION: f64 = 5.0;

/// Largest count of which the moments are summed exactly; deeper samples are nearly linear.
const MAX_EXACT_COUNT: u16 = 63;

/// Lower bound of variances, and of the response's slope.
const MIN_VARIANCE: f32 = 1e-3;

/// Response of the pixels of an acquisition to light.
#[derive(Debug)]
pub(super) struct CountResponse {
    /// Detections of the last node; nodes lie at `last * (i / NODES)^2`.
    last: f32,
    means: Vec<f32>,
    variances: Vec<f32>,
    /// Detections per unit of luma in image units.
    pub(super) per_unit: f32,
    /// Dark detections of an ordinary pixel.
    pub(super) dark: f32,
}

impl CountResponse {
    pub(super) fn new(acquisition: &Acquisition) -> Result<Self> {
        let sensor = &acquisition.sensor;
        let law = CountLaw::new(sensor, acquisition.gain);
        let full = f64::from(sensor.max_count());
        let exact = sensor.response == Response::Linear && sensor.max_count() <= MAX_EXACT_COUNT;
        let last = match sensor.response {
            Response::Binary => BINARY_SATURATION * full,
            Response::Linear if exact => saturating_detections(&law, SATURATION * full),
            Response::Linear => SATURATION * full / acquisition.gain,
        };
        let moments = CountMoments::new(&law);
        let node = |i: usize| {
            let detections = last * (i as f64 / NODES as f64).powi(2);
            let (mean, variance) =
                if exact { exact_moments(&law, detections) } else { moments.at(detections) };
            (mean as f32, variance as f32)
        };
        let (means, variances) = (0..=NODES).into_par_iter().map(node).unzip();
        Ok(Self {
            last: last as f32,
            means,
            variances,
            per_unit: (acquisition.photons_per_unit() * sensor.quantum_efficiency) as f32,
            dark: sensor.dark_per_frame()? as f32,
        })
    }

    /// Returns mean, variance and slope at the detections of light of value `image`, and dark ones.
    pub(super) fn at(&self, image: f32, dark: f32) -> CountAt {
        let detections = (image * self.per_unit + dark).clamp(0.0, self.last);
        let place = NODES as f32 * (detections / self.last).sqrt();
        let i = (place as usize).min(NODES - 1);
        let node = |i: usize| self.last * (i as f32 / NODES as f32).powi(2);
        let width = node(i + 1) - node(i);
        let part = (detections - node(i)) / width;
        let between = |table: &[f32]| table[i] + part * (table[i + 1] - table[i]);
        CountAt {
            mean: between(&self.means),
            variance: between(&self.variances).max(MIN_VARIANCE),
            slope: ((self.means[i + 1] - self.means[i]) / width).max(MIN_VARIANCE) * self.per_unit,
        }
    }

    /// Returns the light whose mean count is `mean` for an ordinary pixel; negative where there is less than
    /// dark counts.
    pub(super) fn image(&self, mean: f32) -> f32 {
        let above = self.means.partition_point(|&m| m < mean).clamp(1, NODES);
        let node = |i: usize| self.last * (i as f32 / NODES as f32).powi(2);
        let (low, high) = (self.means[above - 1], self.means[above]);
        let part = ((mean - low) / (high - low).max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
        let detections = node(above - 1) + part * (node(above) - node(above - 1));
        (detections - self.dark) / self.per_unit
    }
}

/// Returns the detections whose mean count is `mean`, or the most that the full well lets count.
fn saturating_detections(law: &CountLaw, mean: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    while law.mean(high) < mean && high < 1e4 {
        (low, high) = (high, 2.0 * high);
    }
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if law.mean(middle) < mean { low = middle } else { high = middle }
    }
    high
}

/// Returns mean and variance of a count.
fn exact_moments(law: &CountLaw, detections: f64) -> (f64, f64) {
    let (mut mean, mut square) = (0.0, 0.0);
    for (count, probability) in law.probabilities(detections).iter().enumerate() {
        mean += count as f64 * probability;
        square += (count * count) as f64 * probability;
    }
    (mean, square - mean * mean)
}

/// Law of a count at some light.
#[derive(Clone, Copy, Debug)]
pub(super) struct CountAt {
    /// Mean count.
    pub(super) mean: f32,
    /// Variance of the count.
    pub(super) variance: f32,
    /// Change of the mean per unit of light.
    pub(super) slope: f32,
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::sensor::Sensor;

    #[test]
    fn light_is_found_from_mean_counts() {
        for name in ["qudi-paper", "swissspad2", "qis4-gj"] {
            let sensor = Sensor { frames_summed: 7, ..Sensor::load(name).unwrap() };
            let sensor = if name == "swissspad2" { sensor } else { Sensor::load(name).unwrap() };
            let acquisition = Acquisition::new(sensor, 3.25, 0.45).unwrap();
            let response = CountResponse::new(&acquisition).unwrap();
            for image in [0.02, 0.2, 0.45, 0.7] {
                let there = response.at(image, response.dark);
                let back = response.image(there.mean);
                assert!((back - image).abs() < 2e-3, "{name}: {back} {image}");
                let more = response.at(image + 0.02, response.dark).mean;
                let slope = (more - there.mean) / 0.02;
                assert!((slope / there.slope - 1.0).abs() < 0.1, "{name}: {slope} {there:?}");
            }
        }
    }
}
