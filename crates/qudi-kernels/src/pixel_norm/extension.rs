//! The scaling as an operation of Burn's backends, differentiable once.

use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};

/// Backends with the scaling in one operation.
#[backend_extension(Flex: cfg(feature = "flex"), Autodiff)]
pub trait PixelNormBackend: Backend {
    /// Computes [`pixel_norm`](super::pixel_norm).
    fn pixel_norm(x: FloatTensor<Self>, floor: f32) -> FloatTensor<Self>;
}

/// Backends with the gradient of the scaling.
pub trait PixelNormGradients: Backend {
    /// Computes the gradient of [`pixel_norm`](super::pixel_norm).
    fn pixel_norm_gradient(
        x: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        floor: f32,
    ) -> FloatTensor<Self>;
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native;
    use super::{PixelNormBackend, PixelNormGradients};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl PixelNormBackend for Flex {
        fn pixel_norm(x: FlexTensor, floor: f32) -> FlexTensor {
            let x = contiguous(x);
            let shape = x.shape().dims::<4>();
            tensor(native::forward(values(&x), shape, floor), shape)
        }
    }

    impl PixelNormGradients for Flex {
        fn pixel_norm_gradient(x: FlexTensor, gradient: FlexTensor, floor: f32) -> FlexTensor {
            let (x, gradient) = (contiguous(x), contiguous(gradient));
            let shape = x.shape().dims::<4>();
            tensor(native::gradient(values(&x), values(&gradient), shape, floor), shape)
        }
    }
}

/// Backward step of the scaling.
#[derive(Debug)]
struct Step;

impl<B: PixelNormBackend + PixelNormGradients> Backward<B, 1> for Step {
    type State = (NodeId, f32);

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        grads: &mut Gradients,
        checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let (x, floor) = ops.state;
        let x = checkpointer.retrieve_node_output(x);
        if let [Some(parent)] = &ops.parents {
            grads.register::<B>(parent.id, B::pixel_norm_gradient(x, gradient, floor));
        }
    }
}

impl<B: PixelNormBackend + PixelNormGradients, C: CheckpointStrategy> PixelNormBackend
    for Autodiff<B, C>
{
    fn pixel_norm(x: FloatTensor<Self>, floor: f32) -> FloatTensor<Self> {
        match Step.prepare::<C>([x.node()]).compute_bound().stateful() {
            OpsKind::Tracked(mut prep) => {
                let state = (prep.checkpoint(&x), floor);
                prep.finish(state, B::pixel_norm(x.into_primitive(), floor))
            }
            OpsKind::UnTracked(prep) => prep.finish(B::pixel_norm(x.into_primitive(), floor)),
        }
    }
}
