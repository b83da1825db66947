//! Memory of the flex backend's tensors.

use burn::backend::flex::{FlexTensor, Layout};
use burn::tensor::{Bytes, DType, Shape};

/// Returns the tensor with contiguous values in row-major order.
pub(crate) fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.is_contiguous() && tensor.layout().start_offset() == 0 {
        tensor
    } else {
        tensor.to_contiguous()
    }
}

/// Returns all values of a [contiguous] tensor. Its storage may hold more: the first frames of a burst share
/// the memory of the whole.
pub(crate) fn values(tensor: &FlexTensor) -> &[f32] {
    &tensor.storage()[..tensor.layout().shape().num_elements()]
}

/// Creates a tensor of `values`.
pub(crate) fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D]) -> FlexTensor {
    FlexTensor::new(Bytes::from_elems(values), Layout::contiguous(Shape::new(shape)), DType::F32)
}
