//! Linear maps of images: pixels into channels and back, coarser and finer grids. Composed of Burn's
//! operations each is three to ten of them, and as many copies.

#[allow(unreachable_pub)] // the macro wants public traits
mod extension;
#[cfg(feature = "flex")]
mod native;
#[cfg(feature = "flex")]
pub(crate) use native::upsample;
#[cfg(all(test, feature = "flex"))]
mod tests;

use crate::backend::is_native;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use extension::ResampleBackend;

/// A linear map of the planes of images, `[images, channels, height, width]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resampling {
    /// Moves squares of so many pixels a side into channels.
    Unshuffle(usize),
    /// Moves channels into squares of so many pixels a side.
    Shuffle(usize),
    /// Averages squares of 2 x 2 pixels.
    Pool,
    /// Gives a quarter of each pixel to 2 x 2 pixels: the gradient of [`Self::Pool`].
    Unpool,
    /// Doubles the size with bilinear interpolation, half-pixel centres and repeated edges.
    Upsample,
    /// Halves the size: the gradient of [`Self::Upsample`].
    Downsample,
}

impl Resampling {
    /// Returns the map of gradients.
    fn transposed(self) -> Self {
        match self {
            Self::Unshuffle(fold) => Self::Shuffle(fold),
            Self::Shuffle(fold) => Self::Unshuffle(fold),
            Self::Pool => Self::Unpool,
            Self::Unpool => Self::Pool,
            Self::Upsample => Self::Downsample,
            Self::Downsample => Self::Upsample,
        }
    }

    /// Returns the shape of the result; none if the map does not divide `shape` evenly.
    fn shape(self, [images, channels, height, width]: [usize; 4]) -> Option<[usize; 4]> {
        let finer = |fold: usize, channels| [images, channels, height * fold, width * fold];
        let coarser = |fold: usize, channels| {
            let fits = height.is_multiple_of(fold) && width.is_multiple_of(fold);
            fits.then(|| [images, channels, height / fold, width / fold])
        };
        match self {
            Self::Unshuffle(fold) => coarser(fold, channels * fold * fold),
            Self::Shuffle(fold) => {
                let squares = fold * fold;
                channels.is_multiple_of(squares).then(|| finer(fold, channels / squares))
            }
            Self::Pool | Self::Downsample => coarser(2, channels),
            Self::Unpool | Self::Upsample => Some(finer(2, channels)),
        }
    }
}

/// Applies a map in one operation; none where it has to be composed of Burn's operations.
pub fn resampled(x: &Tensor<4>, how: Resampling) -> Option<Tensor<4>> {
    let shape = how.shape(x.dims())?;
    let is_one_operation = is_native(x) && shape.iter().all(|&size| size > 0);
    is_one_operation
        .then(|| Tensor::from_dispatch(Dispatch::resample(x.clone().into_dispatch(), how)))
}
