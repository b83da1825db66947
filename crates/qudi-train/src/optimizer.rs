//! The optimizers, on lists of values, whose state is two more such lists: Adam (Kingma and Ba 2015), and
//! Muon for the weights of layers.
//!
//! Burn's own keep their state under numbers that change from run to run, and read it back onto the default
//! device, which a machine without a graphics card does not have; training must go on exactly, anywhere.

mod learning_rate;
mod muon;

use burn::tensor::Tensor;
use qudi_kernels::is_flex;
use rayon::prelude::*;
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
    groups: Vec<Group>,
    /// True on a device other than the processor, which moves one group after the other.
    joins: bool,
}

/// Values that move together, as one tensor: a graphics card takes as long for one layer as for all. On the
/// processor every layer is a group of its own, and threads take one each.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Group {
    /// Rows and columns of each layer that Muon moves; none for values that Adam moves.
    matrix: Option<[usize; 2]>,
    /// Places in the list of values.
    members: Vec<usize>,
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
        let joins = values.first().is_some_and(|value| !is_flex(&value.device()));
        let mut groups: Vec<Group> = Vec::new();
        for (place, (name, shape)) in shapes.into_iter().enumerate() {
            let matrix = match kind {
                OptimizerKind::Muon if !prefers_adam(name) => muon::matrix(shape),
                _ => None,
            };
            match groups.iter_mut().find(|group| joins && group.matrix == matrix) {
                Some(group) => group.members.push(place),
                None => groups.push(Group { matrix, members: vec![place] }),
            }
        }
        Self { mean: zeros(), square: zeros(), steps: 0, groups, joins }
    }

    /// Returns the state of Adam for all values.
    pub fn adam(values: &[Tensor<1>]) -> Self {
        let vectors: Vec<_> = values.iter().map(Tensor::dims).collect();
        let shapes = vectors.iter().map(|shape| ("", shape.as_slice()));
        Self::new(OptimizerKind::Adam, values, shapes, |_| true)
    }

    /// Returns the values after a step along `gradients` times `scale`, `[1]`, at learning rate `lr`. Nothing
    /// is read back from the device.
    pub fn step(
        &mut self,
        mut values: Vec<Tensor<1>>,
        gradients: &[Tensor<1>],
        scale: &Tensor<1>,
        lr: f64,
    ) -> Vec<Tensor<1>> {
        self.steps += 1;
        let steps = self.steps as f64;
        let bias = BETA.map(|beta| 1.0 - beta.powf(steps));
        let (means, squares) = (&self.mean, &self.square);
        let moved = |group: &Group| {
            let gradient = group.joined(gradients) * scale.clone();
            let kept = if group.matrix.is_some() { muon::MOMENTUM } else { BETA[0] };
            let mean = group.joined(means) * kept + gradient.clone() * (1.0 - kept);
            let (step, square) = if let Some(matrix) = group.matrix {
                // Nesterov's momentum: the mean as the next gradient like this one would make it.
                let ahead = mean.clone() * kept + gradient * (1.0 - kept);
                (muon::step(ahead, group.members.len(), matrix) * lr, None)
            } else {
                let square = group.joined(squares) * BETA[1];
                let square = square + gradient.powi_scalar(2) * (1.0 - BETA[1]);
                let size = (square.clone() / bias[1]).sqrt() + EPSILON;
                (mean.clone() / size * (lr / bias[0]), Some(square))
            };
            Moved { values: group.joined(&values) - step, mean, square }
        };
        let moved: Vec<Moved> = if self.joins {
            self.groups.iter().map(moved).collect()
        } else {
            self.groups.par_iter().map(moved).collect()
        };
        for (group, moved) in self.groups.iter().zip(moved) {
            group.put(&mut self.mean, &moved.mean);
            if let Some(square) = &moved.square {
                group.put(&mut self.square, square);
            }
            group.put(&mut values, &moved.values);
        }
        values
    }
}

/// The members of a group after a step.
struct Moved {
    values: Tensor<1>,
    mean: Tensor<1>,
    square: Option<Tensor<1>>,
}

impl Group {
    /// Returns the members of a list, one after the other.
    fn joined(&self, list: &[Tensor<1>]) -> Tensor<1> {
        if let [place] = self.members.as_slice() {
            return list[*place].clone();
        }
        Tensor::cat(self.members.iter().map(|&place| list[place].clone()).collect(), 0)
    }

    /// Puts the parts of what [`joined`](Self::joined) made back into a list.
    fn put(&self, list: &mut [Tensor<1>], joined: &Tensor<1>) {
        if let [place] = self.members.as_slice() {
            list[*place] = joined.clone();
            return;
        }
        let mut first = 0;
        for &place in &self.members {
            let [count] = list[place].dims();
            list[place] = joined.clone().narrow(0, first, count);
            first += count;
        }
    }
}
