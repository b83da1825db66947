//! An exponential moving average of the network's parameters, which generalises better than the last ones.

use burn::tensor::Tensor;

/// The average, in the order of [`parameters`](crate::parameters).
#[derive(Clone, Debug)]
pub(super) struct Ema {
    decay: f64,
    pub(super) average: Vec<Tensor<1>>,
}

impl Ema {
    /// Starts at `parameters`. `decay` is the fraction of the average that a step keeps.
    pub(super) fn new(parameters: Vec<Tensor<1>>, decay: f64) -> Self {
        Self { decay, average: parameters }
    }

    /// Moves the average towards `parameters`, after `steps` steps before this one. What does not learn stays
    /// as it is: an average of equal numbers is not always that number.
    pub(super) fn update(&mut self, parameters: &[Tensor<1>], learns: &[bool], steps: u64) {
        // An average over few steps at first, or the initial weights would stay in it for long.
        let keep = self.decay.min((1 + steps) as f64 / (10 + steps) as f64);
        for ((a, b), _) in
            self.average.iter_mut().zip(parameters).zip(learns).filter(|(_, learns)| **learns)
        {
            *a = a.clone() * keep + b.clone() * (1.0 - keep);
        }
    }
}
