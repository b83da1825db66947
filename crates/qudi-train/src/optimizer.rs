//! The Adam optimizer (Kingma and Ba 2015) on lists of values, whose state is two more such lists.
//!
//! Burn's own keeps its state under numbers that change from run to run, and reads it back onto the default device,
//! which a machine without a graphics card does not have; training must go on exactly, anywhere.

use burn::tensor::Tensor;

const BETA: [f64; 2] = [0.9, 0.999];
const EPSILON: f64 = 1e-8;

/// Moments of the gradients.
#[derive(Clone, Debug)]
pub struct Adam {
    /// Running mean of every value's gradient.
    pub mean: Vec<Tensor<1>>,
    /// Running mean of its square.
    pub square: Vec<Tensor<1>>,
    /// Steps taken.
    pub steps: u64,
}

impl Adam {
    /// For values of these sizes, on their device.
    pub fn new(values: &[Tensor<1>]) -> Self {
        let zeros = || values.iter().map(Tensor::zeros_like).collect();
        Self { mean: zeros(), square: zeros(), steps: 0 }
    }

    /// The values after a step along `gradients` times `scale` at learning rate `rate`.
    pub fn step(
        &mut self,
        values: Vec<Tensor<1>>,
        gradients: Vec<Tensor<1>>,
        scale: f64,
        rate: f64,
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
                let deviation = (square.clone() / bias[1]).sqrt() + EPSILON;
                value - mean.clone() / deviation * (rate / bias[0])
            })
            .collect()
    }
}
