//! Warping as an operation of Burn's backends, differentiable once.

use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};

/// Backends with the fused warp.
#[backend_extension(Flex: cfg(feature = "flex"), Autodiff)]
pub trait WarpBackend: Backend {
    /// Computes [`warp`](super::warp).
    fn warp(x: FloatTensor<Self>, flow: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// Backends with the gradients of the fused warp.
pub trait WarpGradients: Backend {
    /// Computes the gradients of [`warp`](super::warp) for `x` and `flow`.
    fn warp_gradients(
        x: FloatTensor<Self>,
        flow: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 2];
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native;
    use super::{WarpBackend, WarpGradients};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl WarpBackend for Flex {
        fn warp(x: FlexTensor, flow: FlexTensor) -> FlexTensor {
            let (x, flow) = (contiguous(x), contiguous(flow));
            let shape = x.shape().dims::<4>();
            tensor(native::forward(shape, values(&x), values(&flow)), shape)
        }
    }

    impl WarpGradients for Flex {
        fn warp_gradients(
            x: FlexTensor,
            flow: FlexTensor,
            gradient: FlexTensor,
        ) -> [FlexTensor; 2] {
            let (x, flow, gradient) = (contiguous(x), contiguous(flow), contiguous(gradient));
            let shape = x.shape().dims::<4>();
            let (dx, dflow) =
                native::gradients(shape, values(&x), values(&flow), values(&gradient));
            [tensor(dx, shape), tensor(dflow, flow.shape().dims::<4>())]
        }
    }
}

/// Backward step of a warp.
#[derive(Debug)]
struct Step;

impl<B: WarpBackend + WarpGradients> Backward<B, 2> for Step {
    type State = [NodeId; 2];

    fn backward(
        self,
        ops: Ops<Self::State, 2>,
        grads: &mut Gradients,
        checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let [x, flow] = ops.state.map(|id| checkpointer.retrieve_node_output(id));
        let parts = B::warp_gradients(x, flow, gradient);
        for (parent, part) in ops.parents.iter().zip(parts) {
            if let Some(node) = parent {
                grads.register::<B>(node.id, part);
            }
        }
    }
}

impl<B: WarpBackend + WarpGradients, C: CheckpointStrategy> WarpBackend for Autodiff<B, C> {
    fn warp(x: FloatTensor<Self>, flow: FloatTensor<Self>) -> FloatTensor<Self> {
        match Step.prepare::<C>([x.node(), flow.node()]).compute_bound().stateful() {
            OpsKind::Tracked(mut prep) => {
                let state = [&x, &flow].map(|tensor| prep.checkpoint(tensor));
                prep.finish(state, B::warp(x.into_primitive(), flow.into_primitive()))
            }
            OpsKind::UnTracked(prep) => {
                prep.finish(B::warp(x.into_primitive(), flow.into_primitive()))
            }
        }
    }
}
