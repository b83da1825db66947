//! A window of frames, and how networks of several kinds go over it.

use burn::tensor::Tensor;
use qudi_core::Result;
use qudi_core::progress::progress;
use qudi_layers::mirrored;
use std::ops::Range;

/// Frames to restore, `[1, 1, height, width]` each.
#[derive(Debug)]
pub(crate) struct Window<'a> {
    /// The name of the method, for reports of progress.
    pub(super) name: &'static str,
    /// All frames.
    pub(super) all: &'a [Tensor<4>],
    /// The places of the requested ones.
    pub(super) requested: Range<usize>,
}

impl Window<'_> {
    /// Returns all frames.
    pub(crate) fn all(&self) -> &[Tensor<4>] {
        self.all
    }

    /// Returns the requested frames with so many before and after them, mirrored at the first and the last
    /// frame.
    pub(crate) fn around(&self, [before, after]: [usize; 2]) -> Vec<Tensor<4>> {
        (0..before + self.requested.len() + after)
            .map(|i| (self.requested.start + i) as i64 - before as i64)
            .map(|place| self.all[mirrored(place, self.all.len())].clone())
            .collect()
    }

    /// Returns the requested ones of `images`, which are of all frames: `[frames, channels, height, width]`.
    pub(crate) fn requested_of(&self, images: Tensor<4>) -> Vec<Tensor<4>> {
        self.split(images, self.requested.start)
    }

    /// Returns the frames of `images` from `first` on, as many as are requested. Channels are copies of one
    /// picture, and are averaged.
    pub(crate) fn split(&self, images: Tensor<4>, first: usize) -> Vec<Tensor<4>> {
        let images = images.mean_dim(1);
        (0..self.requested.len()).map(|i| images.clone().narrow(0, first + i, 1)).collect()
    }

    /// Runs `restore` once for every requested frame, in order, and reports progress.
    ///
    /// # Errors
    /// [`Error::Interrupted`](qudi_core::Error::Interrupted) if asked to stop.
    pub(crate) fn each(
        &self,
        mut restore: impl FnMut(usize) -> Tensor<4>,
    ) -> Result<Vec<Tensor<4>>> {
        let total = self.requested.len();
        let image = |done| {
            progress(self.name, done, total)?;
            Ok(restore(done))
        };
        (0..total).map(image).collect()
    }
}

/// Joins frames of one channel each to images of `channels` copies.
pub(crate) fn copies(frames: &[Tensor<4>], channels: usize) -> Tensor<4> {
    Tensor::cat(frames.to_vec(), 0).repeat(&[1, channels, 1, 1])
}
