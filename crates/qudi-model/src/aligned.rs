//! The planes of aligned frames: reference estimate, merged frame, noise, and standardized counts of all
//! neighbours.

use crate::counts::MAX_IMAGE;
use burn::tensor::{Device, Tensor};
use qudi_burst::{AlignedBurst, AlignedFrame, Alignments};
use qudi_core::{Frame, Size};
use qudi_layers::tensor::to_tensor;
use std::ops::Range;

/// The neighbours that are aligned with each frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AlignedNeighbours {
    /// Number of frames, the nearest ones.
    pub neighbours: usize,
    /// Alignments of each of them.
    pub alignments: Alignments,
}

impl AlignedNeighbours {
    /// Returns the number of aligned frames `K`: every neighbour once for each of its alignments.
    pub fn count(self) -> usize {
        self.alignments.count() * self.neighbours
    }

    /// Returns the number of standardized planes: counts of the frame, then counts and expectations of `K`
    /// neighbours.
    pub fn standardized_planes(self) -> usize {
        2 * self.count() + 1
    }

    /// Returns frame `frame` of a burst with its aligned neighbours.
    pub(crate) fn frame(self, burst: &AlignedBurst, frame: usize) -> AlignedFrame {
        burst.frame(frame, self.neighbours, self.alignments)
    }
}

/// Planes of aligned frames: images of type `T`, in image units, and standardized planes of type `S`, in
/// units of the sigma of the frame's noise ([`AlignedFrame`]).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Aligned<T, S = T> {
    /// Reference estimate.
    pub reference: T,
    /// Merged frame: unbiased and still noisy.
    pub merged: T,
    /// Sigma of the merged frame's noise.
    pub noise_sigma: T,
    /// Standardized counts of the frame itself, then of its `K` aligned neighbours.
    pub counts: Vec<S>,
    /// Standardized expectations of the `K` aligned neighbours.
    pub expected: Vec<S>,
}

impl<T, S> Aligned<T, S> {
    /// Applies `image` to every image and `standardized` to every standardized plane.
    pub fn map<U, V>(
        &self,
        image: impl Fn(&T) -> U,
        standardized: impl Fn(&S) -> V,
    ) -> Aligned<U, V> {
        Aligned {
            reference: image(&self.reference),
            merged: image(&self.merged),
            noise_sigma: image(&self.noise_sigma),
            counts: self.counts.iter().map(&standardized).collect(),
            expected: self.expected.iter().map(&standardized).collect(),
        }
    }

    /// Returns the images.
    pub fn images(&self) -> [&T; 3] {
        [&self.reference, &self.merged, &self.noise_sigma]
    }

    /// Returns the standardized planes: counts, then expectations.
    pub fn standardized(&self) -> impl Iterator<Item = &S> {
        self.counts.iter().chain(&self.expected)
    }
}

/// Frame after frame, row-major; images are in [0, 2].
impl Aligned<Vec<f32>> {
    /// Collects the planes of some frames of an aligned burst.
    pub fn of_frames(
        burst: &AlignedBurst,
        neighbours: AlignedNeighbours,
        frames: Range<usize>,
    ) -> Self {
        let mut planes = Self::default();
        for frame in frames {
            planes.extend(Self::of_frame(neighbours.frame(burst, frame)));
        }
        planes
    }

    /// Converts the planes of one frame.
    pub(crate) fn of_frame(frame: AlignedFrame) -> Self {
        let AlignedFrame { reference, merged, noise_sigma, counts, expected } = frame;
        let image = |plane: Frame| {
            plane.data.into_iter().map(|value| value.min(MAX_IMAGE as f32)).collect()
        };
        let planes = |list: Vec<Frame>| list.into_iter().map(|plane| plane.data).collect();
        Self {
            reference: image(reference),
            merged: image(merged),
            noise_sigma: image(noise_sigma),
            counts: planes(counts),
            expected: planes(expected),
        }
    }

    /// Appends the frames of other planes.
    pub fn extend(&mut self, more: Self) {
        self.reference.extend(more.reference);
        self.merged.extend(more.merged);
        self.noise_sigma.extend(more.noise_sigma);
        let lists = [(&mut self.counts, more.counts), (&mut self.expected, more.expected)];
        for (planes, more) in lists {
            planes.resize(more.len(), Vec::new());
            for (plane, more) in planes.iter_mut().zip(more) {
                plane.extend(more);
            }
        }
    }

    /// Copies the planes to a device, `[images, 1, height, width]` each; `size` is the size of a frame.
    pub fn to_tensors(&self, size: Size, device: &Device) -> Aligned<Tensor<4>> {
        let tensor = |plane: &Vec<f32>| to_tensor(plane.clone(), size, device);
        self.map(tensor, tensor)
    }
}
