//! An exponential moving average of the network's parameters, which generalises better than the last ones.

use burn::tensor::Tensor;
use qudi_kernels::is_flex;
use rayon::prelude::*;

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
        let learning = || learns.iter().enumerate().filter(|(_, learns)| **learns);
        if learning().next().is_none() {
            return;
        }
        if is_flex(&parameters[0].device()) {
            let average = self.average.par_iter_mut().zip(parameters).zip(learns);
            average.filter(|(_, learns)| **learns).for_each(|((average, parameter), _)| {
                *average = average.clone() * keep + parameter.clone() * (1.0 - keep);
            });
            return;
        }
        // As one tensor: a graphics card takes as long for one layer as for all.
        let joined = |list: &[Tensor<1>]| {
            Tensor::cat(learning().map(|(place, _)| list[place].clone()).collect(), 0)
        };
        let moved = joined(&self.average) * keep + joined(parameters) * (1.0 - keep);
        let mut first = 0;
        for (place, _) in learning() {
            let [count] = self.average[place].dims();
            self.average[place] = moved.clone().narrow(0, first, count);
            first += count;
        }
    }
}
