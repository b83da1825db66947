//! Wavelets whose filters are learnt: squares of 2 x 2 pixels into four bands, and back.

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use qudi_layers::zeros;

/// The transform: two filters of two pixels, along rows and along columns.
#[derive(Module, Debug)]
pub(super) struct Wavelet {
    net1: Filters,
}

/// The inverse: what each of two bands adds to two pixels.
#[derive(Module, Debug)]
pub(super) struct Inverse {
    net1: Filters,
    net2: Filters,
}

/// Filters of two pixels, `[filters, 1, 1, 2]` or `[1, filters, 2, 1]`.
#[derive(Module, Debug)]
struct Filters {
    weight: Param<Tensor<4>>,
}

impl Filters {
    /// Returns the filters, `[filters, 2]`.
    fn matrix(&self) -> Tensor<2> {
        let weight = self.weight.val();
        let filters = weight.shape().num_elements() / 2;
        weight.reshape([filters, 2])
    }
}

impl Wavelet {
    pub(super) fn zeros(device: &Device) -> Self {
        Self { net1: Filters { weight: zeros([2, 1, 1, 2], device) } }
    }

    /// Returns filters by pixels, `[2, 2]`.
    pub(super) fn matrix(&self) -> Tensor<2> {
        self.net1.matrix()
    }

    /// Splits an image into bands, one after the other: low along both; low along rows and high along
    /// columns; the reverse; high along both.
    ///
    /// # Shapes
    /// - x: `[images, channels, 2 h, 2 w]`
    /// - result: `[images, 4 * channels, h, w]`
    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let [images, channels, height, width] = x.dims();
        let [h, w] = [height / 2, width / 2];
        // Columns of a square, rows of a square, then the rest.
        let pixels: Tensor<6> = x.reshape([images, channels, h, 2, w, 2]);
        let pixels = pixels.permute([0, 5, 3, 1, 2, 4]).reshape([images, 4, channels * h * w]);
        let matrix = square(self.matrix()).reshape([1, 4, 4]);
        matrix.matmul(pixels).reshape([images, 4 * channels, h, w])
    }
}

impl Inverse {
    pub(super) fn zeros(device: &Device) -> Self {
        let filters = || Filters { weight: zeros([1, 1, 2, 1], device) };
        Self { net1: filters(), net2: filters() }
    }

    /// Returns bands by pixels, `[2, 2]`.
    pub(super) fn matrix(&self) -> Tensor<2> {
        Tensor::cat(vec![self.net1.matrix(), self.net2.matrix()], 0)
    }

    /// Joins four bands to an image.
    ///
    /// # Shapes
    /// - bands: `[images, 4 * channels, h, w]`
    /// - result: `[images, channels, 2 h, 2 w]`
    pub(super) fn forward(&self, bands: Tensor<4>) -> Tensor<4> {
        let [images, all, h, w] = bands.dims();
        let channels = all / 4;
        let bands = bands.reshape([images, 4, channels * h * w]);
        let matrix = square(self.matrix()).transpose().reshape([1, 4, 4]);
        let pixels = matrix.matmul(bands).reshape([images, 2, 2, channels, h, w]);
        pixels.permute([0, 3, 4, 2, 5, 1]).reshape([images, channels, 2 * h, 2 * w])
    }
}

/// Applies the same filters along rows and along columns: from `[2, 2]` to `[4, 4]`, both indices with the
/// row direction first.
fn square(matrix: Tensor<2>) -> Tensor<2> {
    let along_rows = matrix.clone().reshape([2, 1, 2, 1]);
    let along_columns = matrix.reshape([1, 2, 1, 2]);
    (along_rows * along_columns).reshape([4, 4])
}
