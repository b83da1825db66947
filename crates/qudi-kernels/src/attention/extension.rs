//! Attention as an operation of Burn's backends, differentiable once.

use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};

/// Backends with the fused attention.
#[backend_extension(Flex: cfg(feature = "flex"), Autodiff)]
pub trait AttentionBackend: Backend {
    /// Computes [`attention`](super::attention).
    fn cell_attention(qkv: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// Backends with the gradient of the fused attention.
pub trait AttentionGradient: Backend {
    /// Computes the gradient of [`attention`](super::attention).
    fn cell_attention_gradient(
        qkv: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native;
    use super::{AttentionBackend, AttentionGradient};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl AttentionBackend for Flex {
        fn cell_attention(qkv: FlexTensor) -> FlexTensor {
            let qkv = contiguous(qkv);
            let shape @ [images, channels, height, width] = qkv.shape().dims::<4>();
            let result = native::forward(shape, values(&qkv));
            tensor(result, [images, channels / 3, height, width])
        }
    }

    impl AttentionGradient for Flex {
        fn cell_attention_gradient(qkv: FlexTensor, gradient: FlexTensor) -> FlexTensor {
            let (qkv, gradient) = (contiguous(qkv), contiguous(gradient));
            let shape = qkv.shape().dims::<4>();
            tensor(native::gradient(shape, values(&qkv), values(&gradient)), shape)
        }
    }
}

/// Backward step of an attention.
#[derive(Debug)]
struct Step;

impl<B: AttentionBackend + AttentionGradient> Backward<B, 1> for Step {
    type State = NodeId;

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        grads: &mut Gradients,
        checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let qkv = checkpointer.retrieve_node_output(ops.state);
        if let [Some(node)] = ops.parents {
            grads.register::<B>(node.id, B::cell_attention_gradient(qkv, gradient));
        }
    }
}

impl<B: AttentionBackend + AttentionGradient, C: CheckpointStrategy> AttentionBackend
    for Autodiff<B, C>
{
    fn cell_attention(qkv: FloatTensor<Self>) -> FloatTensor<Self> {
        match Step.prepare::<C>([qkv.node()]).compute_bound().stateful() {
            OpsKind::Tracked(mut prep) => {
                let state = prep.checkpoint(&qkv);
                prep.finish(state, B::cell_attention(qkv.into_primitive()))
            }
            OpsKind::UnTracked(prep) => prep.finish(B::cell_attention(qkv.into_primitive())),
        }
    }
}
