//! Resampling as an operation of Burn's backends, differentiable once.

use super::Resampling;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};

/// Backends with resampling in one operation.
#[backend_extension(Flex: cfg(feature = "flex"), Autodiff)]
pub trait ResampleBackend: Backend {
    /// Computes [`resampled`](super::resampled).
    fn resample(x: FloatTensor<Self>, how: Resampling) -> FloatTensor<Self>;
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native;
    use super::{ResampleBackend, Resampling};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl ResampleBackend for Flex {
        fn resample(x: FlexTensor, how: Resampling) -> FlexTensor {
            let x = contiguous(x);
            let shape = x.shape().dims::<4>();
            let result = how.shape(shape).expect("checked before");
            tensor(native::resample(values(&x), shape, how, result), result)
        }
    }
}

/// Backward step of a map.
#[derive(Debug)]
struct Step;

impl<B: ResampleBackend> Backward<B, 1> for Step {
    type State = Resampling;

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        if let [Some(parent)] = &ops.parents {
            grads.register::<B>(parent.id, B::resample(gradient, ops.state.transposed()));
        }
    }
}

impl<B: ResampleBackend, C: CheckpointStrategy> ResampleBackend for Autodiff<B, C> {
    fn resample(x: FloatTensor<Self>, how: Resampling) -> FloatTensor<Self> {
        match Step.prepare::<C>([x.node()]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish(how, B::resample(x.into_primitive(), how)),
            OpsKind::UnTracked(prep) => prep.finish(B::resample(x.into_primitive(), how)),
        }
    }
}
