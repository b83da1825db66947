//! Warping as an operation of Burn's backends, differentiable once.

use super::Interpolation;
use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};

/// Backends with the fused warp.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    LibTorch: cfg(feature = "libtorch"),
    Autodiff
)]
pub trait WarpBackend: Backend {
    /// Computes [`warp`](super::warp) or [`warp_cubic`](super::warp_cubic).
    fn warp(
        x: FloatTensor<Self>,
        flow: FloatTensor<Self>,
        interpolation: Interpolation,
    ) -> FloatTensor<Self>;
}

/// Backends with the gradients of the fused warp.
pub trait WarpGradients: Backend {
    /// Computes the gradients of the warp for `x` and `flow`, at least those that are `requested`. The flow
    /// of a cubic warp has none.
    fn warp_gradients(
        x: FloatTensor<Self>,
        flow: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        interpolation: Interpolation,
        requested: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2];
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::{cubic, native};
    use super::{Interpolation, WarpBackend, WarpGradients};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl WarpBackend for Flex {
        fn warp(x: FlexTensor, flow: FlexTensor, interpolation: Interpolation) -> FlexTensor {
            let (x, flow) = (contiguous(x), contiguous(flow));
            let shape = x.shape().dims::<4>();
            let forward = match interpolation {
                Interpolation::Bilinear => native::forward,
                Interpolation::Cubic => cubic::forward,
            };
            tensor(forward(shape, values(&x), values(&flow)), shape)
        }
    }

    impl WarpGradients for Flex {
        fn warp_gradients(
            x: FlexTensor,
            flow: FlexTensor,
            gradient: FlexTensor,
            interpolation: Interpolation,
            requested: [bool; 2],
        ) -> [Option<FlexTensor>; 2] {
            let (x, flow, gradient) = (contiguous(x), contiguous(flow), contiguous(gradient));
            let shape = x.shape().dims::<4>();
            if interpolation == Interpolation::Cubic {
                let dx = cubic::gradient(shape, values(&flow), values(&gradient));
                return [Some(tensor(dx, shape)), None];
            }
            let [dx, dflow] =
                native::gradients(shape, values(&x), values(&flow), values(&gradient), requested);
            let of_flow = flow.shape().dims::<4>();
            [dx.map(|dx| tensor(dx, shape)), dflow.map(|dflow| tensor(dflow, of_flow))]
        }
    }
}

#[cfg(feature = "libtorch")]
mod libtorch {
    use super::{Interpolation, WarpBackend, WarpGradients};
    use crate::libtorch::{recorded, unrecorded};
    use burn::backend::LibTorch;
    use burn::backend::libtorch::TchTensor;
    use tch::{Kind, Tensor};

    /// Samples `x` along `flow` by LibTorch's `grid_sampler`: border, aligned corners.
    fn sampled(inputs: &[Tensor], interpolation: Interpolation) -> Tensor {
        const BORDER: i64 = 1;
        let mode = match interpolation {
            Interpolation::Bilinear => 0,
            Interpolation::Cubic => 2,
        };
        let [x, flow] = inputs else { unreachable!("a tensor and its flow") };
        let (_, _, height, width) = x.size4().expect("four dimensions");
        let places = (Kind::Float, x.device());
        let column = Tensor::arange(width, places).view([1, 1, width]);
        let row = Tensor::arange(height, places).view([1, height, 1]);
        // From the first pixel's centre at -1 to the last one's at 1.
        let unit = |place: Tensor, size: i64| place * (2.0 / (size.max(2) - 1) as f64) - 1.0;
        let column = unit(flow.select(1, 0) + column, width);
        let row = unit(flow.select(1, 1) + row, height);
        x.grid_sampler(&Tensor::stack(&[column, row], 3), mode, BORDER, true)
    }

    impl WarpBackend for LibTorch {
        fn warp(x: TchTensor, flow: TchTensor, interpolation: Interpolation) -> TchTensor {
            unrecorded(&[x, flow], |inputs| sampled(inputs, interpolation))
        }
    }

    impl WarpGradients for LibTorch {
        fn warp_gradients(
            x: TchTensor,
            flow: TchTensor,
            gradient: TchTensor,
            interpolation: Interpolation,
            _wanted: [bool; 2],
        ) -> [Option<TchTensor>; 2] {
            let (_, record) = recorded(vec![x, flow], |inputs| sampled(inputs, interpolation));
            let mut gradients = record.gradients(&gradient).into_iter();
            std::array::from_fn(|_| gradients.next())
        }
    }
}

/// Backward step of a warp.
#[derive(Debug)]
struct Step;

/// What the backward step of a warp needs.
#[derive(Clone, Debug)]
struct State {
    nodes: [NodeId; 2],
    interpolation: Interpolation,
}

impl<B: WarpBackend + WarpGradients> Backward<B, 2> for Step {
    type State = State;

    fn backward(
        self,
        ops: Ops<Self::State, 2>,
        grads: &mut Gradients,
        checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let State { nodes, interpolation } = ops.state;
        let [x, flow] = nodes.map(|id| checkpointer.retrieve_node_output(id));
        let requested = ops.parents.each_ref().map(Option::is_some);
        let parts = B::warp_gradients(x, flow, gradient, interpolation, requested);
        for (parent, part) in ops.parents.iter().zip(parts) {
            if let (Some(node), Some(part)) = (parent, part) {
                grads.register::<B>(node.id, part);
            }
        }
    }
}

impl<B: WarpBackend + WarpGradients, C: CheckpointStrategy> WarpBackend for Autodiff<B, C> {
    fn warp(
        x: FloatTensor<Self>,
        flow: FloatTensor<Self>,
        interpolation: Interpolation,
    ) -> FloatTensor<Self> {
        let prepared = Step.prepare::<C>([x.node(), flow.node()]).compute_bound().stateful();
        match prepared {
            OpsKind::Tracked(mut prep) => {
                let nodes = [&x, &flow].map(|tensor| prep.checkpoint(tensor));
                let warped = B::warp(x.into_primitive(), flow.into_primitive(), interpolation);
                prep.finish(State { nodes, interpolation }, warped)
            }
            OpsKind::UnTracked(prep) => {
                prep.finish(B::warp(x.into_primitive(), flow.into_primitive(), interpolation))
            }
        }
    }
}
