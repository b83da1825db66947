//! Windows of frames, and what in them belongs together.

use super::swin::SIDE;
use burn::tensor::ops::PadMode;
use burn::tensor::{Device, Int, Tensor, TensorData};

/// Score added for cells that shifting brought together.
const SHIFT_PENALTY: f32 = -100.0;

/// The windows of bursts.
#[derive(Clone, Debug)]
pub(super) struct Windows {
    /// Frames of a window if there are enough of them.
    full_frames: usize,
    /// Frames, rows and columns.
    size: [usize; 3],
    /// Of a window.
    window: [usize; 3],
    /// How far rows and columns are shifted.
    shift: [usize; 2],
}

impl Windows {
    /// Makes windows of `frames` frames and [`SIDE`] rows and columns, or of as many as there are, shifted by
    /// half of them where there are more than one.
    pub(super) fn new(size: [usize; 3], frames: usize, shifted: bool) -> Self {
        let full = [frames, SIDE, SIDE];
        let window = [0, 1, 2].map(|axis| full[axis].min(size[axis]));
        let shift = |axis: usize| if shifted && size[axis] > SIDE { SIDE / 2 } else { 0 };
        Self { full_frames: frames, size, window, shift: [shift(1), shift(2)] }
    }

    /// Returns the cells of a window.
    pub(super) fn cells(&self) -> usize {
        self.window.iter().product()
    }

    /// Returns rows and columns, with padding that fills the last windows.
    fn whole(&self) -> [usize; 2] {
        [1, 2].map(|axis| self.size[axis].next_multiple_of(self.window[axis]))
    }

    /// Pads the image with zeros and shifts it.
    pub(super) fn padded(&self, x: Tensor<4>) -> Tensor<4> {
        let [height, width] = self.whole();
        let (below, right) = (height - self.size[1], width - self.size[2]);
        let x = if below + right > 0 {
            x.pad([(0, 0), (0, 0), (0, below), (0, right)], PadMode::Constant(0.0))
        } else {
            x
        };
        turned(turned(x, 2, self.shift[0]), 3, self.shift[1])
    }

    /// Undoes [`Self::padded`].
    pub(super) fn cropped(&self, x: Tensor<4>) -> Tensor<4> {
        let [height, width] = self.whole();
        let back = |length: usize, shift: usize| (length - shift) % length;
        let x = turned(x, 2, back(height, self.shift[0]));
        let x = turned(x, 3, back(width, self.shift[1]));
        x.narrow(2, 0, self.size[1]).narrow(3, 0, self.size[2])
    }

    /// Reshapes from `[bursts * frames, channels, height, width]` to `[windows, channels, cells]`: cells
    /// frame by frame, row by row.
    pub(super) fn split(&self, x: Tensor<4>) -> Tensor<3> {
        let [images, channels, height, width] = x.dims();
        let [frames, wh, ww] = self.window;
        let (rows, columns) = (height / wh, width / ww);
        let x: Tensor<5> = x.reshape([images * channels, rows, wh, columns, ww]);
        let x = x.permute([0, 1, 3, 2, 4]);
        let x: Tensor<5> = x.reshape([images / frames, frames, channels, rows * columns, wh * ww]);
        x.permute([0, 3, 2, 1, 4]).reshape([
            images / frames * rows * columns,
            channels,
            frames * wh * ww,
        ])
    }

    /// Undoes [`Self::split`].
    pub(super) fn join(&self, x: Tensor<3>) -> Tensor<4> {
        let [count, channels, _] = x.dims();
        let [height, width] = self.whole();
        let [frames, wh, ww] = self.window;
        let (rows, columns) = (height / wh, width / ww);
        let groups = count / (rows * columns);
        let x: Tensor<5> = x.reshape([groups, rows * columns, channels, frames, wh * ww]);
        let x = x.permute([0, 3, 2, 1, 4]);
        let x: Tensor<5> = x.reshape([groups * frames * channels, rows, columns, wh, ww]);
        x.permute([0, 1, 3, 2, 4]).reshape([groups * frames, channels, height, width])
    }

    /// Lowers scores, `[windows, heads, cells, cells]`, where shifting brought cells together.
    pub(super) fn masked(&self, scores: Tensor<4>) -> Tensor<4> {
        if self.shift == [0, 0] {
            return scores;
        }
        let [height, width] = self.whole();
        let [frames, wh, ww] = self.window;
        // Which of up to three parts, that shifting joins in a window, a row or column belongs to.
        let part = |at: usize, length: usize, window: usize, shift: usize| {
            let parts = usize::from(at >= length - window) + usize::from(at >= length - shift);
            if shift > 0 { parts } else { 0 }
        };
        let mut values = Vec::new();
        for top in (0..height).step_by(wh) {
            for left in (0..width).step_by(ww) {
                let places = (0..frames * wh * ww).map(|cell| {
                    let (y, x) = (top + cell / ww % wh, left + cell % ww);
                    let row = part(y, height, wh, self.shift[0]);
                    3 * row + part(x, width, ww, self.shift[1])
                });
                let parts: Vec<usize> = places.collect();
                let rows = parts.iter().flat_map(|a| {
                    parts.iter().map(move |b| if a == b { 0.0 } else { SHIFT_PENALTY })
                });
                values.extend(rows);
            }
        }
        let (windows, cells) = (height / wh * (width / ww), self.cells());
        let [count, heads, _, _] = scores.dims();
        let mask = TensorData::new(values, [1, windows, 1, cells, cells]);
        let mask: Tensor<5> = Tensor::from_data(mask, &scores.device());
        let scores: Tensor<5> = scores.reshape([count / windows, windows, heads, cells, cells]);
        (scores + mask).reshape([count, heads, cells, cells])
    }

    /// Returns the row in the table of biases for every pair of cells, `[cells * cells]`. Smaller windows
    /// take the rows of the first cells of the full one, whatever these stand for: as in the authors'
    /// program.
    pub(super) fn offsets(&self, device: &Device) -> Tensor<1, Int> {
        let span = (2 * SIDE - 1) as i64;
        let place = |cell: usize| {
            [cell / (SIDE * SIDE), cell / SIDE % SIDE, cell % SIDE].map(|at| at as i64)
        };
        let cells = self.cells();
        let row = |i: usize, j: usize| {
            let [d, h, w] = [0, 1, 2].map(|axis| place(i)[axis] - place(j)[axis]);
            let most = SIDE as i64 - 1;
            ((d + self.full_frames as i64 - 1) * span + h + most) * span + w + most
        };
        let rows = (0..cells).flat_map(|i| (0..cells).map(move |j| row(i, j)));
        Tensor::from_data(TensorData::new(rows.collect(), [cells * cells]), device)
    }
}

/// Returns rows or columns from number `shift` on, then the others.
fn turned(x: Tensor<4>, axis: usize, shift: usize) -> Tensor<4> {
    if shift == 0 {
        return x;
    }
    let length = x.dims()[axis];
    let (first, last) = (x.clone().narrow(axis, 0, shift), x.narrow(axis, shift, length - shift));
    Tensor::cat(vec![last, first], axis)
}
