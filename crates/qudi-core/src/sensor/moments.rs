//! Mean and variance of a count as functions of the detections expected, from a table.

use super::echoes::counted;
use super::{CountLaw, Response};

/// Nodes of the table; between them both moments are nearly straight.
const NODES: usize = 512;

/// Largest count whose moments are summed exactly; deeper samples are close to Poisson and Gaussian laws.
const MAX_EXACT_COUNT: u16 = 1023;

/// Mean and variance of counts under one law.
#[derive(Clone, Debug)]
pub struct CountMoments {
    /// Detections at the last node; nodes lie at `max_detections * (i / NODES)^2`.
    max_detections: f64,
    nodes: Vec<(f64, f64)>,
}

impl CountMoments {
    /// Tabulates `law` up to where counts are nearly saturated.
    pub fn new(law: &CountLaw) -> Self {
        let full = f64::from(law.max_count);
        let exact = law.max_count <= MAX_EXACT_COUNT && law.response == Response::Linear;
        let max_detections = if exact {
            law.detections_for_mean(0.98 * full)
        } else if law.response == Response::Binary {
            full * 5.0
        } else if law.dead_time() > 0.0 {
            let room = (1.0 - 0.98 * full / law.gain * law.dead_time()).max(0.0);
            (0.98 * full / law.gain / room).min(100.0 / law.dead_time())
        } else {
            full / law.gain
        };
        let node = |i: usize| {
            let detections = max_detections * (i as f64 / NODES as f64).powi(2);
            if exact {
                let (mut mean, mut square) = (0.0, 0.0);
                for (y, p) in law.probabilities(detections).iter().enumerate() {
                    mean += y as f64 * p;
                    square += (y * y) as f64 * p;
                }
                return (mean, square - mean * mean);
            }
            if law.response == Response::Binary {
                let p = -(-detections / full).exp_m1();
                return (full * p, full * p * (1.0 - p));
            }
            let counted = counted(detections, law.dead_time());
            // Dead time spaces counts more evenly (Cox 1962).
            let variance = detections / (1.0 + detections * law.dead_time()).powi(3);
            let variance = variance + law.read_noise * law.read_noise;
            (law.gain * counted, law.gain * law.gain * variance + 1.0 / 12.0)
        };
        Self { max_detections, nodes: (0..=NODES).map(node).collect() }
    }

    /// Returns mean and variance at `detections` expected per output frame.
    pub fn at(&self, detections: f64) -> (f64, f64) {
        let detections = detections.clamp(0.0, self.max_detections);
        let i =
            ((NODES as f64 * (detections / self.max_detections).sqrt()) as usize).min(NODES - 1);
        let node = |i: usize| self.max_detections * (i as f64 / NODES as f64).powi(2);
        let part = (detections - node(i)) / (node(i + 1) - node(i));
        let (low, high) = (self.nodes[i], self.nodes[i + 1]);
        (low.0 + part * (high.0 - low.0), low.1 + part * (high.1 - low.1))
    }

    /// Returns the variance where the mean is `mean`.
    pub fn variance_at_mean(&self, mean: f64) -> f64 {
        let (above, part) = self.place_of_mean(mean);
        let (low, high) = (self.nodes[above - 1], self.nodes[above]);
        low.1 + part * (high.1 - low.1)
    }

    /// Returns the detections expected per output frame where the mean is `mean`: the inverse of
    /// [`at`](Self::at), within the table.
    pub fn detections_at_mean(&self, mean: f64) -> f64 {
        let (above, part) = self.place_of_mean(mean);
        let node = |i: usize| self.max_detections * (i as f64 / NODES as f64).powi(2);
        node(above - 1) + part * (node(above) - node(above - 1))
    }

    /// Returns the node above a mean, and how far the mean lies on the way to it from the one before.
    fn place_of_mean(&self, mean: f64) -> (usize, f64) {
        let above = self.nodes.partition_point(|node| node.0 < mean).clamp(1, NODES);
        let (low, high) = (self.nodes[above - 1].0, self.nodes[above].0);
        let step = high - low;
        (above, if step > 0.0 { ((mean - low) / step).clamp(0.0, 1.0) } else { 0.0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::Sensor;

    #[test]
    fn count_tables_match_the_law() {
        for (name, gain) in [("qudi-paper", 1.077), ("swissspad2", 1.0), ("qis4-gj", 1.0)] {
            let law = CountLaw::new(&Sensor::load(name).unwrap(), gain);
            let moments = CountMoments::new(&law);
            for detections in [1e-4, 0.03, 0.7, 2.2, 5.9] {
                // Deep sensors are approximated: near darkness the cut at zero counts.
                let deep = law.max_count > MAX_EXACT_COUNT && detections < 5.0;
                if deep || law.max_count == 1 && detections > 4.0 {
                    continue;
                }
                let (mut mean, mut square) = (0.0, 0.0);
                for (y, p) in law.probabilities(detections).iter().enumerate() {
                    mean += y as f64 * p;
                    square += (y * y) as f64 * p;
                }
                let (m, v) = moments.at(detections);
                let variance = square - mean * mean;
                assert!((m - mean).abs() < 2e-3 * mean + 1e-5, "{name} {detections}: {m} {mean}");
                assert!((v - variance).abs() < 0.02 * variance + 1e-4, "{name} {detections}: {v}");
                assert!((moments.variance_at_mean(m) - v).abs() < 0.01 * v + 1e-6, "{name}");
                let inverse = moments.detections_at_mean(m);
                assert!(
                    (inverse - detections).abs() < 1e-6 + 1e-6 * detections,
                    "{name}: {inverse}"
                );
            }
        }
    }
}
