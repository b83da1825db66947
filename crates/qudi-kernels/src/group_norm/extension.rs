//! Group normalisation as an operation of Burn's backends, differentiable once.

use super::Norm;
use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};

/// Backends with the fused normalisation.
#[backend_extension(Flex: cfg(feature = "flex"), Autodiff)]
pub trait GroupNormBackend: Backend {
    /// Computes [`group_norm`](super::group_norm).
    fn group_norm_rows(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        norm: Norm,
    ) -> FloatTensor<Self>;
}

/// Backends with the gradients of the fused normalisation.
pub trait GroupNormGradients: Backend {
    /// Computes the gradients of [`group_norm`](super::group_norm) for `x`, weight and bias.
    fn group_norm_gradients(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        norm: Norm,
    ) -> [FloatTensor<Self>; 3];
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native;
    use super::{GroupNormBackend, GroupNormGradients, Norm};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl GroupNormBackend for Flex {
        fn group_norm_rows(
            x: FlexTensor,
            weight: FlexTensor,
            bias: FlexTensor,
            norm: Norm,
        ) -> FlexTensor {
            let (x, weight, bias) = (contiguous(x), contiguous(weight), contiguous(bias));
            let shape = x.shape().dims::<4>();
            let result = native::forward(shape, norm, values(&x), values(&weight), values(&bias));
            tensor(result, shape)
        }
    }

    impl GroupNormGradients for Flex {
        fn group_norm_gradients(
            x: FlexTensor,
            weight: FlexTensor,
            bias: FlexTensor,
            gradient: FlexTensor,
            norm: Norm,
        ) -> [FlexTensor; 3] {
            let (x, weight, bias) = (contiguous(x), contiguous(weight), contiguous(bias));
            let gradient = contiguous(gradient);
            let shape = x.shape().dims::<4>();
            let rows = weight.shape().dims::<2>();
            let (weight, bias) = (values(&weight), values(&bias));
            let sums = native::gradients(shape, norm, values(&x), weight, bias, values(&gradient));
            [tensor(sums.x, shape), tensor(sums.weight, rows), tensor(sums.bias, rows)]
        }
    }
}

/// Backward step of a normalisation.
#[derive(Debug)]
struct Step;

impl<B: GroupNormBackend + GroupNormGradients> Backward<B, 3> for Step {
    type State = ([NodeId; 3], Norm);

    fn backward(
        self,
        ops: Ops<Self::State, 3>,
        grads: &mut Gradients,
        checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let (checkpoints, norm) = ops.state;
        let [x, weight, bias] = checkpoints.map(|id| checkpointer.retrieve_node_output(id));
        let parts = B::group_norm_gradients(x, weight, bias, gradient, norm);
        for (parent, part) in ops.parents.iter().zip(parts) {
            if let Some(node) = parent {
                grads.register::<B>(node.id, part);
            }
        }
    }
}

impl<B: GroupNormBackend + GroupNormGradients, C: CheckpointStrategy> GroupNormBackend
    for Autodiff<B, C>
{
    fn group_norm_rows(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        norm: Norm,
    ) -> FloatTensor<Self> {
        let forward = |x: FloatTensor<Self>, weight: FloatTensor<Self>, bias: FloatTensor<Self>| {
            let (weight, bias) = (weight.into_primitive(), bias.into_primitive());
            B::group_norm_rows(x.into_primitive(), weight, bias, norm)
        };
        match Step.prepare::<C>([x.node(), weight.node(), bias.node()]).compute_bound().stateful() {
            OpsKind::Tracked(mut prep) => {
                let state = [&x, &weight, &bias].map(|tensor| prep.checkpoint(tensor));
                prep.finish((state, norm), forward(x, weight, bias))
            }
            OpsKind::UnTracked(prep) => prep.finish(forward(x, weight, bias)),
        }
    }
}
