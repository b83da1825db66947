//! Forward warping: averages of the pixels that flow brings (Niklaus and Liu, "Softmax splatting for video
//! frame interpolation", CVPR 2020).

use burn::tensor::{IndexingUpdateOp, Tensor};

/// Spreads every pixel over the four around `(column + flow_x, row + flow_y)`, and averages what arrives;
/// zero where nothing does. The flow has no gradient.
///
/// # Shapes
/// - x, result: `[images, channels, height, width]`
/// - flow: `[images, 2, height, width]`, x before y, in pixels
pub fn splat_average(x: Tensor<4>, flow: Tensor<4>) -> Tensor<4> {
    let [images, channels, height, width] = x.dims();
    let device = x.device();
    let cells = |count: usize| Tensor::arange(0..count as i64, &device).float();
    let flow = flow.detach();
    let column = flow.clone().narrow(1, 0, 1) + cells(width).reshape([1, 1, 1, width]);
    let row = flow.narrow(1, 1, 1) + cells(height).reshape([1, 1, height, 1]);
    let values = Tensor::cat(vec![x.clone(), x.narrow(1, 0, 1).ones_like()], 1);
    let all = [images, channels + 1, height * width];
    let values: Tensor<3> = values.reshape(all);
    let mut total = Tensor::<3>::zeros(all, &device);
    let (left, top) = (column.clone().floor(), row.clone().floor());
    for (dx, dy) in [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)] {
        let (at_x, at_y) = (left.clone() + dx, top.clone() + dy);
        let part =
            |place: &Tensor<4>, cell: &Tensor<4>| (place.clone() - cell.clone()).abs().neg() + 1.0;
        let inside = |at: &Tensor<4>, count: usize| {
            at.clone().greater_equal_elem(0.0).float() * at.clone().lower_elem(count as f32).float()
        };
        let inside = inside(&at_x, width) * inside(&at_y, height);
        let weight = part(&column, &at_x) * part(&row, &at_y) * inside.clone();
        let place = (at_y * width as f32 + at_x) * inside;
        let place = place.reshape([images, 1, height * width]).int();
        let weight: Tensor<3> = weight.reshape([images, 1, height * width]);
        let place = place.repeat(&[1, channels + 1, 1]);
        total = total.scatter(2, place, values.clone() * weight, IndexingUpdateOp::Add);
    }
    let weight = total.clone().narrow(1, channels, 1);
    let none = weight.clone().equal_elem(0.0).float();
    (total.narrow(1, 0, channels) / (weight + none)).reshape([images, channels, height, width])
}
