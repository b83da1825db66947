//! LibTorch's own operations, with the gradients that LibTorch records.
//!
//! Burn composes gradients of a few general operations; LibTorch has one kernel for each. An operation here
//! runs on leaves of LibTorch's autograd, and its result keeps the record until its gradient is asked for.

use burn::backend::libtorch::TchTensor;
use std::sync::Arc;
use tch::{Kind, Tensor};

/// An operation that LibTorch has recorded. Its buffers are freed with the gradient: it has one.
#[derive(Clone, Debug)]
#[allow(unreachable_pub)] // a type of a public trait
pub struct Recorded {
    output: TchTensor,
    leaves: Vec<TchTensor>,
    /// Burn changes a tensor in place that nobody else holds; the record needs the values as they were.
    _sources: Arc<Vec<TchTensor>>,
}

/// Runs `run` on the values of `inputs`, and records it.
pub(crate) fn recorded(
    inputs: Vec<TchTensor>,
    run: impl FnOnce(&[Tensor]) -> Tensor,
) -> (TchTensor, Recorded) {
    let leaf = |input: &TchTensor| input.tensor.detach().set_requires_grad(true);
    let leaves: Vec<Tensor> = inputs.iter().map(leaf).collect();
    let recorded = TchTensor::new(run(&leaves));
    let output = TchTensor::from_existing(recorded.tensor.detach(), recorded.storage.clone());
    let leaves = leaves.into_iter().map(TchTensor::new).collect();
    (output, Recorded { output: recorded, leaves, _sources: Arc::new(inputs) })
}

/// Runs `run` on the values of `inputs` without a record.
pub(crate) fn unrecorded(inputs: &[TchTensor], run: impl FnOnce(&[Tensor]) -> Tensor) -> TchTensor {
    let values: Vec<Tensor> = inputs.iter().map(|input| input.tensor.shallow_clone()).collect();
    TchTensor::new(run(&values))
}

impl Recorded {
    /// Computes the gradients of all inputs from the output's.
    pub(crate) fn gradients(&self, gradient: &TchTensor) -> Vec<TchTensor> {
        let gradient = gradient.tensor.to_kind(self.output.tensor.kind());
        let sum = (&self.output.tensor * gradient).sum(Kind::Float);
        let leaves: Vec<&Tensor> = self.leaves.iter().map(|leaf| &leaf.tensor).collect();
        let gradients = Tensor::run_backward(&[sum], &leaves, false, false);
        gradients.into_iter().map(TchTensor::new).collect()
    }
}

/// Returns the tensor with channels last in memory, which is what tensor cores load: convolutions of it, and
/// what is computed of them, stay so.
pub(crate) fn channels_last(x: &Tensor) -> Tensor {
    x.permute([0, 2, 3, 1]).contiguous().permute([0, 3, 1, 2])
}

/// Returns the number of NVIDIA cards that LibTorch sees.
pub fn count_libtorch_cards() -> usize {
    usize::try_from(tch::Cuda::device_count()).unwrap_or_default()
}
