//! The Adam optimizer (Kingma and Ba 2015) on lists of values, whose state is two more such lists.
//!
//! Burn's own keeps its state under numbers that change from run to run, and reads it back onto the default
//! device, which a machine without a graphics card does not have; training must go on exactly, anywhere.

mod learning_rate;

use burn::tensor::Tensor;

pub use learning_rate::learning_rate;

const BETA: [f64; 2] = [0.9, 0.999];
const EPSILON: f64 = 1e-8;

/// The optimizer's state: the moments of the gradients.
#[derive(Clone, Debug)]
pub struct Adam {
    /// The running mean of every gradient.
    pub mean: Vec<Tensor<1>>,
    /// The running mean of its square.
    pub square: Vec<Tensor<1>>,
    /// The number of steps taken.
    pub steps: u64,
}

impl Adam {
    /// The state before the first step, for values of these sizes, on their device.
    pub fn new(values: &[Tensor<1>]) -> Self {
        let zeros = || values.iter().map(Tensor::zeros_like).collect();
        Self { mean: zeros(), square: zeros(), steps: 0 }
    }

    /// Gives the values after a step along `gradients` times `scale` at learning rate `lr`.
    pub fn step(
        &mut self,
        values: Vec<Tensor<1>>,
        gradients: Vec<Tensor<1>>,
        scale: f64,
        lr: f64,
    ) -> Vec<Tensor<1>> {
        self.steps += 1;
        let steps = self.steps as f64;
        let bias = BETA.map(|beta| 1.0 - beta.powf(steps));
        let moments = self.mean.iter_mut().zip(&mut self.square);
        let moved = values.into_iter().zip(gradients).zip(moments);
        moved
            .map(|((value, gradient), (mean, square))| {
                let gradient = gradient * scale;
                *mean = mean.clone() * BETA[0] + gradient.clone() * (1.0 - BETA[0]);
                *square = square.clone() * BETA[1] + gradient.powi_scalar(2) * (1.0 - BETA[1]);
                let root = (square.clone() / bias[1]).sqrt() + EPSILON;
                value - mean.clone() / root * (lr / bias[0])
            })
            .collect()
    }
}
