//! Convolution as an operation of Burn's backends, differentiable once.

use super::geometry::Geometry;
use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};

/// Maximum number of inputs of one call; longer lists are joined first.
pub(super) const MAX_INPUTS: usize = 5;

/// Backends with the convolution of this crate.
///
/// Extensions of Burn take no lists of tensors. Unused inputs and a missing addend are therefore arbitrary
/// tensors, which the geometry marks as unused.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    Cube: cfg(feature = "cube"),
    LibTorch: cfg(feature = "libtorch"),
    Autodiff
)]
#[allow(clippy::too_many_arguments)]
pub trait ConvBackend: Backend {
    /// Convolves inputs `[images, channels, height, width]` with the weight
    /// `[outputs, channels, frames, rows, columns]`; the addend has the output's shape.
    fn conv_frames(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        d: FloatTensor<Self>,
        e: FloatTensor<Self>,
        addend: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        geometry: Geometry,
    ) -> FloatTensor<Self>;
}

/// Backends with the convolution's gradients; `output` is given where the convolution has a ReLU.
pub trait ConvGradients: Backend {
    /// Computes the gradient of every input, the addend's last.
    fn conv_input_gradients(
        weight: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        output: Option<FloatTensor<Self>>,
        geometry: Geometry,
    ) -> Vec<FloatTensor<Self>>;

    /// Computes the gradients of weight and bias.
    fn conv_weight_gradients(
        inputs: Vec<FloatTensor<Self>>,
        gradient: FloatTensor<Self>,
        output: Option<FloatTensor<Self>>,
        geometry: Geometry,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native;
    use super::{ConvBackend, ConvGradients, Geometry};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::flex::FlexTensor;

    impl ConvBackend for Flex {
        fn conv_frames(
            a: FlexTensor,
            b: FlexTensor,
            c: FlexTensor,
            d: FlexTensor,
            e: FlexTensor,
            addend: FlexTensor,
            weight: FlexTensor,
            bias: FlexTensor,
            geometry: Geometry,
        ) -> FlexTensor {
            let inputs = [a, b, c, d, e].into_iter().take(geometry.channels.len());
            let inputs: Vec<_> = inputs.chain(geometry.addend.then_some(addend)).collect();
            let inputs: Vec<_> = inputs.into_iter().map(contiguous).collect();
            let slices: Vec<_> = inputs.iter().map(values).collect();
            let (weight, bias) = (contiguous(weight), contiguous(bias));
            let output = native::forward(&geometry, &slices, values(&weight), values(&bias));
            let [rows, columns] = geometry.output_grid();
            tensor(output, [geometry.images, geometry.outputs, rows, columns])
        }
    }

    impl ConvGradients for Flex {
        fn conv_input_gradients(
            weight: FlexTensor,
            gradient: FlexTensor,
            output: Option<FlexTensor>,
            geometry: Geometry,
        ) -> Vec<FlexTensor> {
            let (weight, gradient) = (contiguous(weight), contiguous(gradient));
            let output = output.map(contiguous);
            let mask = output.as_ref().map(values);
            let parts =
                native::input_gradients(&geometry, values(&weight), values(&gradient), mask);
            let (images, height, width) = (geometry.images, geometry.height, geometry.width);
            let parts = parts.into_iter().zip(&geometry.channels);
            let mut parts: Vec<_> = parts
                .map(|(part, &channels)| tensor(part, [images, channels, height, width]))
                .collect();
            if geometry.addend {
                parts.push(match mask {
                    None => gradient,
                    Some(output) => {
                        let [rows, columns] = geometry.output_grid();
                        let part = native::addend_gradient(values(&gradient), output);
                        tensor(part, [images, geometry.outputs, rows, columns])
                    }
                });
            }
            parts
        }

        fn conv_weight_gradients(
            inputs: Vec<FlexTensor>,
            gradient: FlexTensor,
            output: Option<FlexTensor>,
            geometry: Geometry,
        ) -> (FlexTensor, FlexTensor) {
            let inputs: Vec<_> = inputs.into_iter().map(contiguous).collect();
            let slices: Vec<_> = inputs.iter().map(values).collect();
            let gradient = contiguous(gradient);
            let output = output.map(contiguous);
            let mask = output.as_ref().map(values);
            let sums = native::weight_gradients(&geometry, &slices, values(&gradient), mask);
            let [depth, rows, columns] = geometry.kernel;
            let weight = [geometry.outputs, geometry.all_channels(), depth, rows, columns];
            (tensor(sums.weight, weight), tensor(sums.bias, [geometry.outputs]))
        }
    }
}

#[cfg(feature = "cube")]
mod cube {
    use super::super::stock;
    use super::{ConvBackend, ConvGradients, Geometry};
    use burn::backend::Cube;
    use burn::backend::tensor::FloatTensor;

    impl ConvBackend for Cube {
        fn conv_frames(
            a: FloatTensor<Self>,
            b: FloatTensor<Self>,
            c: FloatTensor<Self>,
            d: FloatTensor<Self>,
            e: FloatTensor<Self>,
            addend: FloatTensor<Self>,
            weight: FloatTensor<Self>,
            bias: FloatTensor<Self>,
            geometry: Geometry,
        ) -> FloatTensor<Self> {
            let inputs = [a, b, c, d, e].into_iter().take(geometry.channels.len()).collect();
            let addend = geometry.addend.then_some(addend);
            stock::forward::<Self>(&geometry, inputs, addend, weight, bias)
        }
    }

    impl ConvGradients for Cube {
        fn conv_input_gradients(
            weight: FloatTensor<Self>,
            gradient: FloatTensor<Self>,
            output: Option<FloatTensor<Self>>,
            geometry: Geometry,
        ) -> Vec<FloatTensor<Self>> {
            stock::input_gradients::<Self>(&geometry, weight, gradient, output)
        }

        fn conv_weight_gradients(
            inputs: Vec<FloatTensor<Self>>,
            gradient: FloatTensor<Self>,
            output: Option<FloatTensor<Self>>,
            geometry: Geometry,
        ) -> (FloatTensor<Self>, FloatTensor<Self>) {
            stock::weight_gradients::<Self>(&geometry, inputs, gradient, output)
        }
    }
}

#[cfg(feature = "libtorch")]
mod libtorch {
    use super::super::stock;
    use super::{ConvBackend, ConvGradients, Geometry};
    use burn::backend::LibTorch;
    use burn::backend::libtorch::TchTensor;

    impl ConvBackend for LibTorch {
        fn conv_frames(
            a: TchTensor,
            b: TchTensor,
            c: TchTensor,
            d: TchTensor,
            e: TchTensor,
            addend: TchTensor,
            weight: TchTensor,
            bias: TchTensor,
            geometry: Geometry,
        ) -> TchTensor {
            let inputs = [a, b, c, d, e].into_iter().take(geometry.channels.len()).collect();
            let addend = geometry.addend.then_some(addend);
            stock::forward::<Self>(&geometry, inputs, addend, weight, bias)
        }
    }

    impl ConvGradients for LibTorch {
        fn conv_input_gradients(
            weight: TchTensor,
            gradient: TchTensor,
            output: Option<TchTensor>,
            geometry: Geometry,
        ) -> Vec<TchTensor> {
            stock::input_gradients::<Self>(&geometry, weight, gradient, output)
        }

        fn conv_weight_gradients(
            inputs: Vec<TchTensor>,
            gradient: TchTensor,
            output: Option<TchTensor>,
            geometry: Geometry,
        ) -> (TchTensor, TchTensor) {
            stock::recorded_weight_gradients(&geometry, inputs, gradient, output).into()
        }
    }
}

/// Backward step of a convolution.
#[derive(Debug)]
struct Step;

/// State of the backward step: checkpointed inputs and weight, and the output where there is a ReLU.
#[derive(Clone, Debug)]
struct State<T> {
    inputs: Vec<NodeId>,
    weight: NodeId,
    output: Option<T>,
    geometry: Geometry,
}

/// Number of parents: inputs, addend, weight and bias.
const PARENTS: usize = MAX_INPUTS + 3;

impl<B: ConvBackend + ConvGradients> Backward<B, PARENTS> for Step {
    type State = State<FloatTensor<B>>;

    fn backward(
        self,
        ops: Ops<Self::State, PARENTS>,
        grads: &mut Gradients,
        checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let State { inputs, weight, output, geometry } = ops.state;
        let (values, weights) = ops.parents.split_at(MAX_INPUTS + 1);
        let used = values[..inputs.len()].iter();
        let used = used.chain(geometry.addend.then_some(&values[MAX_INPUTS]));
        if used.clone().any(Option::is_some) {
            let weight = checkpointer.retrieve_node_output(weight);
            let (gradient, output) = (gradient.clone(), output.clone());
            let parts = B::conv_input_gradients(weight, gradient, output, geometry.clone());
            for (parent, part) in used.zip(parts) {
                if let Some(node) = parent {
                    grads.register::<B>(node.id, part);
                }
            }
        }
        if weights.iter().any(Option::is_some) {
            let inputs = inputs.into_iter().map(|id| checkpointer.retrieve_node_output(id));
            let inputs = inputs.collect();
            let (weight, bias) = B::conv_weight_gradients(inputs, gradient, output, geometry);
            for (parent, part) in weights.iter().zip([weight, bias]) {
                if let Some(node) = parent {
                    grads.register::<B>(node.id, part);
                }
            }
        }
    }
}

#[allow(clippy::redundant_closure_for_method_calls)] // the tensors' type has no public path
impl<B: ConvBackend + ConvGradients, C: CheckpointStrategy> ConvBackend for Autodiff<B, C> {
    fn conv_frames(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        d: FloatTensor<Self>,
        e: FloatTensor<Self>,
        addend: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        geometry: Geometry,
    ) -> FloatTensor<Self> {
        let tensors = [a, b, c, d, e, addend, weight, bias];
        let forward = |tensors: [FloatTensor<Self>; PARENTS], geometry: Geometry| {
            let [a, b, c, d, e, addend, weight, bias] = tensors.map(|t| t.into_primitive());
            B::conv_frames(a, b, c, d, e, addend, weight, bias, geometry)
        };
        let nodes = tensors.each_ref().map(|tensor| tensor.node());
        match Step.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(mut prep) => {
                let used = &tensors[..geometry.channels.len()];
                let inputs = used.iter().map(|tensor| prep.checkpoint(tensor)).collect();
                let weight = prep.checkpoint(&tensors[MAX_INPUTS + 1]);
                let output = forward(tensors, geometry.clone());
                let kept = geometry.relu.then(|| output.clone());
                prep.finish(State { inputs, weight, output: kept, geometry }, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(forward(tensors, geometry)),
        }
    }
}
