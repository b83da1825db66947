//! Merging as an operation of Burn's backends.

use super::MergeRule;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, backend_extension};

/// Backends that merge frames in one operation.
#[backend_extension(Flex: cfg(feature = "flex"))]
pub trait MergeBackend: Backend {
    /// Computes [`merged_frames`](super::merged_frames); the flows of all distances and directions follow one
    /// another.
    fn merged_frames(
        images: FloatTensor<Self>,
        sigma: FloatTensor<Self>,
        flows: FloatTensor<Self>,
        frames: usize,
        rule: MergeRule,
    ) -> FloatTensor<Self>;
}

#[cfg(feature = "flex")]
mod flex {
    use super::super::native::Burst;
    use super::{MergeBackend, MergeRule};
    use crate::flex::{contiguous, tensor, values};
    use burn::backend::Flex;
    use burn::backend::TensorMetadata;
    use burn::backend::flex::FlexTensor;

    impl MergeBackend for Flex {
        fn merged_frames(
            images: FlexTensor,
            sigma: FlexTensor,
            flows: FlexTensor,
            frames: usize,
            rule: MergeRule,
        ) -> FlexTensor {
            let [images, sigma, flows] = [images, sigma, flows].map(contiguous);
            let [count, channels, height, width] = images.shape().dims::<4>();
            let bursts = Burst {
                images: values(&images),
                sigma: values(&sigma),
                flows: values(&flows),
                frames,
                channels,
                size: [height, width],
                rule,
            };
            tensor(bursts.merged(), [count, 2, height, width])
        }
    }
}
