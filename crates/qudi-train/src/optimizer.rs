//! The optimizers, on lists of values, whose state is two more such lists: Adam (Kingma and Ba 2015), and
//! Muon for the weights of layers.
//!
//! Burn's own keep their state under numbers that change from run to run, and read it back onto the default
//! device, which a machine without a graphics card does not have; training must go on exactly, anywhere.

mod learning_rate;
mod muon;

use burn::tensor::Tensor;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use learning_rate::learning_rate;

const BETA: [f64; 2] = [0.9, 0.999];
const EPSILON: f64 = 1e-8;

/// How weights move along gradients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum OptimizerKind {
    /// Adam (Kingma and Ba 2015).
    #[default]
    Adam,
    /// Steps along orthogonal matrices for the weights of layers (Muon; Jordan et al. 2024), Adam for biases
    /// and scales.
    Muon,
}

/// The optimizer's state: the moments of the gradients.
#[derive(Clone, Debug)]
pub struct Optimizer {
    /// The running mean of every gradient.
    pub mean: Vec<Tensor<1>>,
    /// The running mean of its square; zero where Muon makes the steps, which does not need it.
    pub square: Vec<Tensor<1>>,
    /// The number of steps taken.
    pub steps: u64,
    /// Rows and columns of the values that Muon moves.
    matrices: Vec<Option<[usize; 2]>>,
}

impl Optimizer {
    /// Returns the state before the first step, for values that have these shapes in the network, on their
    /// device.
    pub fn new<'a>(
        kind: OptimizerKind,
        values: &[Tensor<1>],
        shapes: impl IntoIterator<Item = (&'a str, &'a [usize])>,
        prefers_adam: fn(&str) -> bool,
    ) -> Self {
        let zeros = || values.iter().map(Tensor::zeros_like).collect();
        let matrices = shapes.into_iter().map(|(name, shape)| match kind {
            OptimizerKind::Muon if !prefers_adam(name) => muon::matrix(shape),
            _ => None,
        });
        Self { mean: zeros(), square: zeros(), steps: 0, matrices: matrices.collect() }
    }

    /// Adam for all values.
    pub fn adam(values: &[Tensor<1>]) -> Self {
        let vectors: Vec<_> = values.iter().map(Tensor::dims).collect();
        let shapes = vectors.iter().map(|shape| ("", shape.as_slice()));
        Self::new(OptimizerKind::Adam, values, shapes, |_| true)
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
        let moved = values.into_iter().zip(gradients).zip(moments).zip(&self.matrices);
        moved
            .map(|(((value, gradient), (mean, square)), matrix)| {
                let gradient = gradient * scale;
                let kept = if matrix.is_some() { muon::MOMENTUM } else { BETA[0] };
                *mean = mean.clone() * kept + gradient.clone() * (1.0 - kept);
                if let Some(matrix) = *matrix {
                    // Nesterov's momentum: the mean as the next gradient like this one would make it.
                    let ahead = mean.clone() * kept + gradient * (1.0 - kept);
                    return value - muon::step(ahead, matrix) * lr;
                }
                *square = square.clone() * BETA[1] + gradient.powi_scalar(2) * (1.0 - BETA[1]);
                let root = (square.clone() / bias[1]).sqrt() + EPSILON;
                value - mean.clone() / root * (lr / bias[0])
            })
            .collect()
    }
}
