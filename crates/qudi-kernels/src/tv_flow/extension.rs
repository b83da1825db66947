//! TV-L1 flow as an operation of Burn's backends.

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, backend_extension};

/// Backends with TV-L1 flow in one operation.
#[backend_extension(Flex: cfg(feature = "flex"))]
pub trait TvFlowBackend: Backend {
    /// Computes [`tv_flow`](super::tv_flow).
    fn tv_flow(
        reference: FloatTensor<Self>,
        neighbour: FloatTensor<Self>,
        start: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native;
    use super::TvFlowBackend;
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl TvFlowBackend for Flex {
        fn tv_flow(reference: FlexTensor, neighbour: FlexTensor, start: FlexTensor) -> FlexTensor {
            let [reference, neighbour, start] = [reference, neighbour, start].map(contiguous);
            let shape = start.shape().dims::<4>();
            let images = [values(&reference), values(&neighbour)];
            tensor(native::flow(images, values(&start), [shape[2], shape[3]]), shape)
        }
    }
}
