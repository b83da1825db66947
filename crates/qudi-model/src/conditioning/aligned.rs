//! The planes of aligned frames: reference estimate, merged frame, noise, and standardized counts of all
//! neighbours.

use super::MAX_IMAGE;
use burn::tensor::{Device, Tensor};
use qudi_burst::{AlignedBurst, AlignedFrame, Alignments};
use qudi_core::Size;
use qudi_layers::tensor::to_tensor;
use std::ops::Range;

/// The neighbours that are aligned with each frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AlignedNeighbours {
    /// How many frames, the nearest ones.
    pub neighbours: usize,
    /// How each of them is aligned.
    pub alignments: Alignments,
}

impl AlignedNeighbours {
    /// None: of networks that see single frames.
    pub const NONE: Self = Self { neighbours: 0, alignments: Alignments::Selected };

    /// The number of aligned frames `K`: every neighbour once for each of its alignments.
    pub fn count(self) -> usize {
        self.alignments.count() * self.neighbours
    }

    /// The number of standardized planes: counts of the frame, then counts and expectations of `K`
    /// neighbours.
    pub fn standardized_planes(self) -> usize {
        2 * self.count() + 1
    }

    /// Frame `frame` of a burst with its aligned neighbours.
    pub(crate) fn frame(self, burst: &AlignedBurst<'_>, frame: usize) -> AlignedFrame {
        burst.frame(frame, self.neighbours, self.alignments)
    }
}

/// The planes of aligned frames, frame after frame, row-major. Images are in image units, in [0, 2];
/// standardized planes in units of the sigma of the frame's noise ([`AlignedFrame`]).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AlignedPlanes {
    /// The reference estimate.
    pub reference: Vec<f32>,
    /// The merged frame: unbiased and still noisy.
    pub merged: Vec<f32>,
    /// Sigma of the merged frame's noise.
    pub noise_sigma: Vec<f32>,
    /// Standardized counts of the frame itself, then of its `K` aligned neighbours.
    pub counts: Vec<Vec<f32>>,
    /// Standardized expectations of the `K` aligned neighbours.
    pub expected: Vec<Vec<f32>>,
}

impl AlignedPlanes {
    /// The planes of some frames of an aligned burst.
    pub fn new(
        burst: &AlignedBurst<'_>,
        neighbours: AlignedNeighbours,
        frames: Range<usize>,
    ) -> Self {
        let mut planes = Self::default();
        for frame in frames {
            planes.extend(Self::from_frame(neighbours.frame(burst, frame)));
        }
        planes
    }

    /// The planes of one frame.
    pub(crate) fn from_frame(frame: AlignedFrame) -> Self {
        let AlignedFrame { reference, merged, noise_sigma, counts, expected } = frame;
        let image = |plane: qudi_core::Frame| {
            plane.data.into_iter().map(|value| value.min(MAX_IMAGE as f32)).collect()
        };
        let planes =
            |list: Vec<qudi_core::Frame>| list.into_iter().map(|plane| plane.data).collect();
        Self {
            reference: image(reference),
            merged: image(merged),
            noise_sigma: image(noise_sigma),
            counts: planes(counts),
            expected: planes(expected),
        }
    }

    /// Changes every plane by `f`.
    #[must_use]
    pub fn map(&self, f: impl Fn(&[f32]) -> Vec<f32>) -> Self {
        let each = |planes: &[Vec<f32>]| planes.iter().map(|plane| f(plane)).collect();
        Self {
            reference: f(&self.reference),
            merged: f(&self.merged),
            noise_sigma: f(&self.noise_sigma),
            counts: each(&self.counts),
            expected: each(&self.expected),
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

    /// Moves the planes to a device; `size` is that of a frame.
    pub fn into_tensors(self, size: Size, device: &Device) -> AlignedTensors {
        let channels = |planes: Vec<Vec<f32>>| {
            let planes = planes.into_iter().map(|plane| to_tensor(plane, size, device));
            Tensor::cat(planes.collect(), 1)
        };
        AlignedTensors {
            reference: to_tensor(self.reference, size, device),
            merged: to_tensor(self.merged, size, device),
            noise_sigma: to_tensor(self.noise_sigma, size, device),
            counts: channels(self.counts),
            expected: (!self.expected.is_empty()).then(|| channels(self.expected)),
        }
    }
}

/// [`AlignedPlanes`] on a device.
///
/// # Shapes
/// - reference, merged, noise_sigma: `[images, 1, height, width]`
/// - counts: `[images, 1 + K, height, width]`
/// - expected: `[images, K, height, width]`
#[derive(Clone, Debug)]
pub struct AlignedTensors {
    /// The reference estimate.
    pub reference: Tensor<4>,
    /// The merged frame.
    pub merged: Tensor<4>,
    /// Sigma of the merged frame's noise.
    pub noise_sigma: Tensor<4>,
    /// Standardized counts of the frame itself, then of its aligned neighbours.
    pub counts: Tensor<4>,
    /// Standardized expectations of the aligned neighbours; none without neighbours.
    pub expected: Option<Tensor<4>>,
}

impl AlignedTensors {
    /// Changes every tensor by `f`.
    #[must_use]
    pub fn map(&self, f: impl Fn(Tensor<4>) -> Tensor<4>) -> Self {
        Self {
            reference: f(self.reference.clone()),
            merged: f(self.merged.clone()),
            noise_sigma: f(self.noise_sigma.clone()),
            counts: f(self.counts.clone()),
            expected: self.expected.clone().map(f),
        }
    }
}
