//! The only bridge between counts, frames and tensors.

use burn::tensor::{Device, Tensor, TensorData};
use qudi_sim::{Frame, Size};

/// Counts of `frames` frames as a tensor in [0, 1].
///
/// # Shapes
/// `counts`: `[frames * height * width]`, result: `[frames, 1, height, width]`, `count / max_count`.
///
/// # Errors
/// [`ShapeError`] if the counts are not that many.
pub fn counts_to_tensor(
    counts: &[u16],
    frames: usize,
    size: Size,
    max_count: u16,
    device: &Device,
) -> Result<Tensor<4>, ShapeError> {
    let expected = frames * size.pixels();
    if counts.len() != expected {
        return Err(ShapeError { got: counts.len(), expected });
    }
    let scale = 1.0 / f32::from(max_count);
    let values: Vec<f32> = counts.iter().map(|&c| f32::from(c) * scale).collect();
    Ok(Tensor::from_data(TensorData::new(values, [frames, 1, size.height, size.width]), device))
}

/// A tensor as frames, values as they are.
///
/// # Shapes
/// `frames`: `[frames, 1, height, width]`.
///
/// # Errors
/// [`ReadError`] if the device fails; kernels report their errors only here.
pub fn tensor_to_frames(frames: Tensor<4>) -> Result<Vec<Frame>, ReadError> {
    let [_, channels, height, width] = frames.dims();
    if channels != 1 {
        return Err(ReadError(format!("frames have 1 channel, these have {channels}")));
    }
    let size = Size { height, width };
    let data = frames.try_into_data().map_err(|e| ReadError(e.to_string()))?;
    let values = data.try_into_vec::<f32>().map_err(|e| ReadError(e.to_string()))?;
    Ok(values
        .chunks_exact(size.pixels())
        .map(|frame| Frame { size, data: frame.to_vec() })
        .collect())
}

/// Counts that do not fill their frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{got} counts where the frames hold {expected}")]
pub struct ShapeError {
    /// Counts given.
    pub got: usize,
    /// Counts that fill the frames.
    pub expected: usize,
}

/// A tensor that cannot be read back.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("cannot read the result from the device: {0}")]
pub struct ReadError(String);
