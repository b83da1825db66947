//! Batch normalisation (Ioffe and Szegedy, ICML 2015): statistics of the batch in training, running ones in
//! use.

use burn::module::{Module, Param, ParamId};
use burn::tensor::{Device, Tensor};
use qudi_layers::zeros;
use std::cell::RefCell;
use std::collections::HashMap;

/// Term added to variances.
const EPSILON: f32 = 1e-5;

/// The fraction of a batch's statistics in the running ones after it.
const MOMENTUM: f64 = 0.1;

/// Channels less their mean, over their standard deviation.
#[derive(Module, Debug)]
pub(super) struct BatchNorm {
    /// `[channels]`, as all that follow.
    weight: Param<Tensor<1>>,
    bias: Param<Tensor<1>>,
    running_mean: Param<Tensor<1>>,
    running_var: Param<Tensor<1>>,
}

/// The running statistics of all layers, as batches of training move them. They are parameters of the
/// network, of which the loss has no gradient: whoever trains puts them there after the step.
#[derive(Debug, Default)]
pub struct BatchStatistics {
    moved: RefCell<HashMap<ParamId, Tensor<1>>>,
}

impl BatchStatistics {
    /// Returns the running statistics that batches have moved, `[channels]` each, outside autodiff.
    pub fn into_moved(self) -> HashMap<ParamId, Tensor<1>> {
        self.moved.into_inner()
    }

    /// Moves a running statistic towards a batch's.
    fn move_towards(&self, running: &Param<Tensor<1>>, of_batch: Tensor<1>) {
        let mut moved = self.moved.borrow_mut();
        let before = moved.remove(&running.id).unwrap_or_else(|| running.val().inner());
        let after = before * (1.0 - MOMENTUM) + of_batch.inner() * MOMENTUM;
        moved.insert(running.id, after);
    }
}

impl BatchNorm {
    pub(super) fn zeros(channels: usize, device: &Device) -> Self {
        let values = || zeros([channels], device);
        Self { weight: values(), bias: values(), running_mean: values(), running_var: values() }
    }

    /// Normalises by running statistics, or by the batch's, which move `statistics`; then `x` is on an
    /// autodiff device.
    ///
    /// # Shapes
    /// - x, result: `[images, channels, height, width]`
    pub(super) fn forward(&self, x: Tensor<4>, statistics: Option<&BatchStatistics>) -> Tensor<4> {
        let [images, channels, height, width] = x.dims();
        let of = |values: &Param<Tensor<1>>| values.val().reshape([1, channels, 1, 1]);
        let (centred, variance) = match statistics {
            None => (x - of(&self.running_mean).detach(), of(&self.running_var).detach()),
            Some(statistics) => {
                let mean = |x: Tensor<4>| x.mean_dim(0).mean_dim(2).mean_dim(3);
                let mean_of_batch = mean(x.clone());
                let centred = x - mean_of_batch.clone();
                let variance = mean(centred.clone().powi_scalar(2));
                // The running variance is for all images, of which a batch is a sample.
                let count = images * height * width;
                let of_all = count as f64 / count.saturating_sub(1).max(1) as f64;
                statistics.move_towards(&self.running_mean, mean_of_batch.reshape([channels]));
                statistics
                    .move_towards(&self.running_var, variance.clone().reshape([channels]) * of_all);
                (centred, variance)
            }
        };
        centred / (variance + EPSILON).sqrt() * of(&self.weight) + of(&self.bias)
    }
}
