//! The motion between all frames of a window, near and far, and images sampled along it.

use super::flow::WindowFlow;
use burn::tensor::Tensor;
use qudi_kernels::{warp, warp_cubic};
use qudi_layers::resample::{by_burst, upsample2};

/// Flow from every frame to the frames around it, on the grid of half the resolution, in its cells.
#[derive(Clone, Debug)]
pub(in crate::window) struct Paths {
    /// Flow by `distance - 1` and direction, to later frames first:
    /// `[bursts * (frames - distance), 2, h, w]`.
    flows: Vec<[Tensor<4>; 2]>,
    frames: usize,
}

impl Paths {
    /// Follows the flow from frame to frame. No gradient reaches it.
    pub(in crate::window) fn new(flow: &WindowFlow, frames: usize) -> Self {
        let pairs = flow.pairs.clone().detach();
        let [all, _, h, w] = pairs.dims();
        let half = all / 2;
        let near =
            [0, half].map(|first| by_burst(pairs.clone().narrow(0, first, half), frames - 1));
        let bursts = half / (frames - 1);
        let part = |x: &Tensor<5>, first: usize, count: usize| {
            x.clone().narrow(1, first, count).reshape([bursts * count, 2, h, w])
        };
        let mut flows: Vec<[Tensor<4>; 2]> = Vec::with_capacity(frames - 1);
        for distance in 1..frames {
            let count = frames - distance;
            let [later, earlier] = &near;
            // First to the neighbour, from there on as the neighbour's flow says.
            let start = [part(later, 0, count), part(earlier, distance - 1, count)];
            let Some(before) = flows.last() else {
                flows.push(start);
                continue;
            };
            let [on_later, on_earlier] = before.clone().map(|flow| by_burst(flow, count + 1));
            let rest = [part(&on_later, 1, count), part(&on_earlier, 0, count)];
            let [a, b] = start;
            let [rest_a, rest_b] = rest;
            flows.push([warp(rest_a, a.clone()) + a, warp(rest_b, b.clone()) + b]);
        }
        Self { flows, frames }
    }

    /// Takes the flow that is known for every distance, from 1: to later frames, then to earlier ones.
    pub(in crate::window) fn of(flows: Vec<[Tensor<4>; 2]>, frames: usize) -> Self {
        Self { flows, frames }
    }

    /// Samples the images of neighbours up to so many frames away along the flow, for the frames that have
    /// such a neighbour.
    ///
    /// # Shapes
    /// - images: `[bursts * frames, c, H, W]`
    /// - results: `[bursts * (frames - distance), c, H, W]`
    pub(in crate::window) fn aligned(
        &self,
        images: &Tensor<4>,
        most: usize,
    ) -> impl Iterator<Item = (Place, Tensor<4>)> {
        let near = self.up_to(most).iter().zip(1..);
        near.flat_map(move |(flows, distance)| {
            flows.iter().zip([true, false]).map(move |(flow, later)| {
                let place = Place { distance, later, frames: self.frames };
                let whole = upsample2(flow.clone()) * 2.0;
                (place, warp_cubic(place.part(images, true), whole))
            })
        })
    }

    /// Returns the number of frames of a burst.
    pub(in crate::window) fn frames(&self) -> usize {
        self.frames
    }

    /// Returns the flow to neighbours up to so many frames away, by distance.
    pub(in crate::window) fn up_to(&self, most: usize) -> &[[Tensor<4>; 2]] {
        &self.flows[..self.flows.len().min(most)]
    }

    /// Returns the flow to the neighbours at a distance, later or earlier ones, of all frames that have them:
    /// `[bursts * (frames - distance), 2, h, w]`.
    pub(in crate::window) fn between(&self, distance: usize, later: bool) -> &Tensor<4> {
        &self.flows[distance - 1][usize::from(!later)]
    }

    /// Returns all tensors.
    pub(in crate::window) fn tensors(&self) -> impl Iterator<Item = &Tensor<4>> {
        self.flows.iter().flatten()
    }

    /// Returns the same inside autodiff, without gradient.
    pub(in crate::window) fn from_inner(paths: Self) -> Self {
        let flows = paths.flows.into_iter().map(|pair| pair.map(Tensor::from_inner)).collect();
        Self { flows, frames: paths.frames }
    }

    /// Returns the same outside autodiff.
    pub(in crate::window) fn inner(&self) -> Self {
        let flows = self.flows.iter().map(|pair| pair.clone().map(Tensor::inner)).collect();
        Self { flows, frames: self.frames }
    }
}

/// The place of a neighbour among the frames of a burst.
#[derive(Clone, Copy, Debug)]
pub(in crate::window) struct Place {
    pub(in crate::window) distance: usize,
    /// True for neighbours after a frame.
    later: bool,
    frames: usize,
}

impl Place {
    /// Returns the frames of every burst that have such a neighbour, or these neighbours.
    pub(in crate::window) fn part(&self, x: &Tensor<4>, neighbours: bool) -> Tensor<4> {
        let [images, c, h, w] = x.dims();
        let (bursts, count) = (images / self.frames, self.frames - self.distance);
        let first = if neighbours == self.later { self.distance } else { 0 };
        let part = by_burst(x.clone(), self.frames).narrow(1, first, count);
        part.reshape([bursts * count, c, h, w])
    }

    /// Adds zeros for frames that have no such neighbour.
    pub(in crate::window) fn whole(&self, x: Tensor<4>) -> Tensor<4> {
        let count = self.frames - self.distance;
        let [images, c, h, w] = x.dims();
        let bursts = images / count;
        let nothing = Tensor::zeros([bursts, self.distance, c, h, w], &x.device());
        let x = by_burst(x, count);
        let parts = if self.later { vec![x, nothing] } else { vec![nothing, x] };
        Tensor::cat(parts, 1).reshape([bursts * self.frames, c, h, w])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::window::scenes::{FRAMES, moving};
    use qudi_layers::tensor::read;

    #[test]
    fn paths_are_followed_from_frame_to_frame() {
        let (_, flow) = moving(1.0);
        let paths = Paths::new(&flow, FRAMES);
        assert_eq!(paths.flows.len(), FRAMES - 1);
        for ([later, earlier], distance) in paths.flows.iter().zip(1u8..) {
            let most = 0.5 * f32::from(distance);
            for (flow, expected) in [(later, most), (earlier, -most)] {
                assert_eq!(flow.dims()[0], FRAMES - usize::from(distance));
                let x = read(flow.clone().narrow(1, 0, 1)).unwrap_or_else(|e| panic!("{e}"));
                assert!(x.iter().all(|x| (x - expected).abs() < 1e-5), "{distance}: {x:?}");
            }
        }
    }
}
