//! Frames as an operation of Burn's backends, differentiable once.

use super::Frame;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, TensorMetadata, backend_extension};
use burn::tensor::Shape;
use std::sync::atomic::Ordering;

/// Backends with frames of bursts.
#[backend_extension(Flex: cfg(feature = "flex"), Autodiff)]
pub trait FrameBackend: Backend {
    /// Copies one of the [`frames`](super::frames).
    fn frame(x: FloatTensor<Self>, frame: Frame) -> FloatTensor<Self>;
}

/// Backends with the gradients of frames.
pub trait FrameGradients: Backend {
    /// Adds a frame to images of `shape`; zeros where there are none yet.
    fn add_frame(
        images: Option<FloatTensor<Self>>,
        part: FloatTensor<Self>,
        frame: &Frame,
        shape: &Shape,
    ) -> FloatTensor<Self>;
}

#[cfg(feature = "flex")]
mod flex {
    use super::{Frame, FrameBackend, FrameGradients};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;
    use burn::tensor::Shape;

    impl FrameBackend for Flex {
        fn frame(x: FlexTensor, frame: Frame) -> FlexTensor {
            let x = contiguous(x);
            let [images, channels, height, width] = x.shape().dims::<4>();
            let image = channels * height * width;
            let bursts = values(&x).chunks_exact(image).skip(frame.number).step_by(frame.count);
            let bursts: Vec<&[f32]> = bursts.collect();
            tensor(bursts.concat(), [images / frame.count, channels, height, width])
        }
    }

    impl FrameGradients for Flex {
        fn add_frame(
            images: Option<FlexTensor>,
            part: FlexTensor,
            frame: &Frame,
            shape: &Shape,
        ) -> FlexTensor {
            let part = contiguous(part);
            let [count, channels, height, width] = shape.dims::<4>();
            let image = channels * height * width;
            let parts = values(&part).chunks_exact(image);
            let Some(images) = images else {
                // Frame by frame: only the others are filled with zeros.
                let mut all = Vec::with_capacity(count * image);
                for part in parts {
                    all.resize(all.len() + frame.number * image, 0.0);
                    all.extend_from_slice(part);
                    all.resize(all.len() + (frame.count - 1 - frame.number) * image, 0.0);
                }
                return tensor(all, [count, channels, height, width]);
            };
            let mut images = contiguous(images);
            let all: &mut [f32] = images.storage_mut();
            let places = all.chunks_exact_mut(image).skip(frame.number).step_by(frame.count);
            for (to, part) in places.zip(parts) {
                to.iter_mut().zip(part).for_each(|(to, part)| *to += part);
            }
            images
        }
    }
}

/// Backward step of a frame.
#[derive(Debug)]
struct Step;

impl<B: FrameBackend + FrameGradients> Backward<B, 1> for Step {
    type State = (Frame, Shape);

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let part = grads.consume::<B>(&ops.node);
        let [Some(parent)] = &ops.parents else { return };
        let (frame, shape) = ops.state;
        // The gradients of leaves can only be added to.
        let is_leaf = parent.parents.is_empty();
        let begun = !is_leaf && frame.begun.swap(true, Ordering::Relaxed);
        let before = begun.then(|| grads.consume::<B>(parent));
        grads.register::<B>(parent.id, B::add_frame(before, part, &frame, &shape));
    }
}

impl<B: FrameBackend + FrameGradients, C: CheckpointStrategy> FrameBackend for Autodiff<B, C> {
    fn frame(x: FloatTensor<Self>, frame: Frame) -> FloatTensor<Self> {
        let shape = x.shape();
        match Step.prepare::<C>([x.node()]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let output = B::frame(x.into_primitive(), frame.clone());
                prep.finish((frame, shape), output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::frame(x.into_primitive(), frame)),
        }
    }
}
