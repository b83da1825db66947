//! A memory of positions: keys by which they are found, and values.

use burn::tensor::Tensor;
use burn::tensor::activation::softmax;

/// Keys and values of positions, the oldest first.
#[derive(Debug)]
pub(super) struct Bank {
    /// Entries that are read, the most alike ones.
    top: usize,
    /// Frames whose positions stay.
    frames: usize,
    /// `[images, size, positions]`
    keys: Option<Tensor<3>>,
    /// The same, of another size.
    values: Vec<Tensor<3>>,
}

impl Bank {
    pub(super) fn new(top: usize, frames: usize) -> Self {
        Self { top, frames, keys: None, values: Vec::new() }
    }

    /// Adds the positions of a frame; only the last frames of its size stay.
    pub(super) fn store(&mut self, key: Tensor<4>, values: Vec<Tensor<4>>) {
        let [_, _, height, width] = key.dims();
        let most = self.frames.saturating_mul(height * width);
        let flat = |x: Tensor<4>| -> Tensor<3> {
            let [images, size, height, width] = x.dims();
            x.reshape([images, size, height * width])
        };
        let last = |x: Tensor<3>| {
            let count = x.dims()[2];
            let first = count.saturating_sub(most);
            x.narrow(2, first, count - first)
        };
        let new: Vec<_> = values.into_iter().map(flat).collect();
        let key = flat(key);
        let (keys, values) = match self.keys.take() {
            None => (key, new),
            Some(keys) => {
                let joined = std::mem::take(&mut self.values).into_iter().zip(new);
                let joined = joined.map(|(old, new)| Tensor::cat(vec![old, new], 2));
                (Tensor::cat(vec![keys, key], 2), joined.collect())
            }
        };
        self.keys = Some(last(keys));
        self.values = values.into_iter().map(last).collect();
    }

    /// Returns values for the positions of a query: means of the values whose keys are most similar.
    ///
    /// # Panics
    /// If nothing has been stored.
    pub(super) fn read(&self, query: &Tensor<4>) -> Vec<Tensor<4>> {
        let [images, size, height, width] = query.dims();
        let keys = self.keys.clone().expect("something was stored");
        let query: Tensor<3> = query.clone().reshape([images, size, height * width]);
        let product = keys.clone().transpose().matmul(query);
        let lengths = keys.powi_scalar(2).sum_dim(1).transpose();
        let mut scores = (product * 2.0 - lengths) / (size as f32).sqrt();
        let count = scores.dims()[1];
        if self.top < count {
            let least = scores.clone().detach().topk(self.top, 1).narrow(1, self.top - 1, 1);
            let others = scores.clone().detach().lower(least.expand(scores.dims()));
            scores = scores.mask_fill(others, f32::NEG_INFINITY);
        }
        let weights = softmax(scores, 1);
        let read = |value: &Tensor<3>| {
            let size = value.dims()[1];
            value.clone().matmul(weights.clone()).reshape([images, size, height, width])
        };
        self.values.iter().map(read).collect()
    }
}
