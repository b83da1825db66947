//! Differences of blocks as an operation of Burn's backends.

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, backend_extension};

/// Backends with differences of blocks in one operation.
#[backend_extension(Flex: cfg(feature = "flex"))]
pub trait BlockBackend: Backend {
    /// Computes [`block_differences`](super::block_differences).
    fn block_differences(
        reference: FloatTensor<Self>,
        neighbour: FloatTensor<Self>,
        radius: usize,
    ) -> FloatTensor<Self>;
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native;
    use super::BlockBackend;
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl BlockBackend for Flex {
        fn block_differences(
            reference: FlexTensor,
            neighbour: FlexTensor,
            radius: usize,
        ) -> FlexTensor {
            let (reference, neighbour) = (contiguous(reference), contiguous(neighbour));
            let [pairs, _, height, width] = reference.shape().dims::<4>();
            let size = [height, width];
            let values = native::differences(values(&reference), values(&neighbour), size, radius);
            tensor(values, [pairs, (2 * radius + 1).pow(2), height, width])
        }
    }
}
