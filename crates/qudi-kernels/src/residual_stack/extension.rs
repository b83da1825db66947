//! A fused stack as an operation of Burn's backends, differentiable once.

use super::Stack;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};
use std::fmt::Debug;

/// Inputs of one call; longer lists are joined first.
pub(super) const INPUTS: usize = 7;

/// Backends with fused stacks.
///
/// Extensions of Burn take no lists of tensors: unused inputs are any tensors; the stack says what counts.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    LibTorch: cfg(feature = "libtorch"),
    Autodiff
)]
#[allow(clippy::too_many_arguments)]
pub trait StackBackend: Backend {
    /// Inputs `[images, channels, height, width]`, and all parameters one after the other.
    fn residual_stack(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        d: FloatTensor<Self>,
        e: FloatTensor<Self>,
        f: FloatTensor<Self>,
        g: FloatTensor<Self>,
        parameters: FloatTensor<Self>,
        stack: Stack,
    ) -> FloatTensor<Self>;
}

/// The gradients of fused stacks.
pub trait StackGradients: Backend {
    /// What a gradient needs of the forward pass.
    type Activations: Clone + Send + Sync + Debug + 'static;

    /// Applies the stack, and keeps what its gradient needs.
    fn residual_stack_kept(
        inputs: Vec<FloatTensor<Self>>,
        parameters: FloatTensor<Self>,
        stack: &Stack,
    ) -> (FloatTensor<Self>, Self::Activations);

    /// Returns the gradients for the inputs, at least for those that are `requested`, and for the parameters.
    fn residual_stack_gradients(
        parameters: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        activations: &Self::Activations,
        stack: &Stack,
        requested: &[bool],
    ) -> (Vec<Option<FloatTensor<Self>>>, FloatTensor<Self>);
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::backward::backward;
    use super::super::forward::{Activations, forward};
    use super::{Stack, StackBackend, StackGradients};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::flex::FlexTensor;
    use std::sync::Arc;

    /// Computes a stack, and keeps its activations if asked for.
    fn computed(
        inputs: Vec<FlexTensor>,
        parameters: FlexTensor,
        stack: &Stack,
        keeps: bool,
    ) -> (FlexTensor, Arc<Activations>) {
        let inputs: Vec<_> = inputs.into_iter().map(contiguous).collect();
        let slices: Vec<_> = inputs.iter().map(values).collect();
        let parameters = contiguous(parameters);
        let (output, activations) = forward(stack, &slices, values(&parameters), keeps);
        let shape = [stack.images, stack.features, stack.height, stack.width];
        (tensor(output, shape), activations)
    }

    impl StackBackend for Flex {
        fn residual_stack(
            a: FlexTensor,
            b: FlexTensor,
            c: FlexTensor,
            d: FlexTensor,
            e: FlexTensor,
            f: FlexTensor,
            g: FlexTensor,
            parameters: FlexTensor,
            stack: Stack,
        ) -> FlexTensor {
            let inputs = [a, b, c, d, e, f, g].into_iter().take(stack.inputs.len()).collect();
            computed(inputs, parameters, &stack, false).0
        }
    }

    impl StackGradients for Flex {
        type Activations = Arc<Activations>;

        fn residual_stack_kept(
            inputs: Vec<FlexTensor>,
            parameters: FlexTensor,
            stack: &Stack,
        ) -> (FlexTensor, Arc<Activations>) {
            computed(inputs, parameters, stack, true)
        }

        fn residual_stack_gradients(
            parameters: FlexTensor,
            gradient: FlexTensor,
            activations: &Arc<Activations>,
            stack: &Stack,
            requested: &[bool],
        ) -> (Vec<Option<FlexTensor>>, FlexTensor) {
            let (parameters, gradient) = (contiguous(parameters), contiguous(gradient));
            let (parameters, gradient) = (values(&parameters), values(&gradient));
            let (inputs, flat) = backward(stack, activations, parameters, gradient, requested);
            let parts = inputs.into_iter().zip(&stack.inputs);
            let parts = parts.map(|(part, &channels)| {
                let shape = [stack.images, channels, stack.height, stack.width];
                part.map(|part| tensor(part, shape))
            });
            let count = flat.len();
            (parts.collect(), tensor(flat, [count]))
        }
    }
}

#[cfg(feature = "libtorch")]
mod libtorch {
    use super::super::torch;
    use super::{Stack, StackBackend, StackGradients};
    use crate::libtorch::{Recorded, recorded, unrecorded};
    use burn::backend::LibTorch;
    use burn::backend::libtorch::TchTensor;

    impl StackBackend for LibTorch {
        fn residual_stack(
            a: TchTensor,
            b: TchTensor,
            c: TchTensor,
            d: TchTensor,
            e: TchTensor,
            f: TchTensor,
            g: TchTensor,
            parameters: TchTensor,
            stack: Stack,
        ) -> TchTensor {
            let inputs = [a, b, c, d, e, f, g].into_iter().take(stack.inputs.len());
            let all: Vec<_> = inputs.chain([parameters]).collect();
            unrecorded(&all, |values| torch::forward(values, &stack))
        }
    }

    impl StackGradients for LibTorch {
        type Activations = Recorded;

        fn residual_stack_kept(
            mut inputs: Vec<TchTensor>,
            parameters: TchTensor,
            stack: &Stack,
        ) -> (TchTensor, Recorded) {
            inputs.push(parameters);
            recorded(inputs, |leaves| torch::forward(leaves, stack))
        }

        fn residual_stack_gradients(
            _parameters: TchTensor,
            gradient: TchTensor,
            record: &Recorded,
            _stack: &Stack,
            _wanted: &[bool],
        ) -> (Vec<Option<TchTensor>>, TchTensor) {
            let mut gradients = record.gradients(&gradient);
            let flat = gradients.pop().expect("parameters come last");
            (gradients.into_iter().map(Some).collect(), flat)
        }
    }
}

/// The step behind a stack.
#[derive(Debug)]
struct Step;

/// What the step needs.
#[derive(Clone, Debug)]
struct State<T, A> {
    parameters: T,
    activations: A,
    stack: Stack,
}

/// Inputs and parameters.
const PARENTS: usize = INPUTS + 1;

impl<B: StackBackend + StackGradients> Backward<B, PARENTS> for Step {
    type State = State<FloatTensor<B>, B::Activations>;

    fn backward(
        self,
        ops: Ops<Self::State, PARENTS>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let State { parameters, activations, stack } = ops.state;
        let parents = &ops.parents[..stack.inputs.len()];
        let requested: Vec<bool> = parents.iter().map(Option::is_some).collect();
        let (inputs, flat) =
            B::residual_stack_gradients(parameters, gradient, &activations, &stack, &requested);
        let used = parents.iter().zip(inputs);
        for (parent, part) in used.chain(std::iter::once((&ops.parents[INPUTS], Some(flat)))) {
            if let (Some(node), Some(part)) = (parent, part) {
                grads.register::<B>(node.id, part);
            }
        }
    }
}

#[allow(clippy::redundant_closure_for_method_calls)] // the tensors' type has no public path
impl<B: StackBackend + StackGradients, C: CheckpointStrategy> StackBackend for Autodiff<B, C> {
    fn residual_stack(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        d: FloatTensor<Self>,
        e: FloatTensor<Self>,
        f: FloatTensor<Self>,
        g: FloatTensor<Self>,
        parameters: FloatTensor<Self>,
        stack: Stack,
    ) -> FloatTensor<Self> {
        let tensors = [a, b, c, d, e, f, g, parameters];
        let nodes = tensors.each_ref().map(|tensor| tensor.node());
        let forward = |tensors: [FloatTensor<Self>; PARENTS], stack: &Stack| {
            let mut tensors: Vec<_> = tensors.into_iter().map(|t| t.into_primitive()).collect();
            let parameters = tensors.pop().expect("parameters come last");
            tensors.truncate(stack.inputs.len());
            let (output, activations) = B::residual_stack_kept(tensors, parameters.clone(), stack);
            (output, parameters, activations)
        };
        match Step.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (output, parameters, activations) = forward(tensors, &stack);
                prep.finish(State { parameters, activations, stack }, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(forward(tensors, &stack).0),
        }
    }
}
