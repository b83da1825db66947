//! Merging of predicted frames: each with its nearest neighbours along the flow, as far as they agree. What a
//! frame's prediction gets wrong, its neighbours often do not.

use super::config::{FOLD, IMAGE};
use super::flow::WindowFlow;
use burn::module::Module;
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor};
use qudi_kernels::{warp, warp_cubic};
use qudi_layers::resample::{
    avg_pool2, by_burst, mean_around, pixel_shuffle, pixel_unshuffle, upsample2,
};
use qudi_layers::{Bias, Conv2d};

/// Neighbours on either side.
pub(super) const NEIGHBOURS: usize = 3;

/// Channels between the convolutions.
const HIDDEN: usize = 32;

/// Planes that describe a neighbour: differences, their sizes, their mean square around, and its distance.
const PLANES: usize = 2 * IMAGE + 2;

/// Squared difference at which a neighbour gets half its weight, in units of the usual squared error.
const TOLERANCE: f32 = 0.5;

/// The largest difference that convolutions see, in units of usual errors.
const MAX_DIFFERENCE: f32 = 4.0;

/// Bounds of the logarithm of a neighbour's weight; a frame's own is zero.
const LOG_WEIGHT: [f32; 2] = [-12.0, 4.0];

/// The network that weights neighbours.
#[derive(Module, Debug)]
pub(super) struct Agreement {
    frame: Conv2d,
    neighbour: Conv2d,
    out: Conv2d,
}

/// Flow from every frame to the frames around it, on the grid of half the resolution, in its cells.
#[derive(Clone, Debug)]
pub(super) struct Paths {
    /// Flow by `distance - 1` and direction, to later frames first:
    /// `[bursts * (frames - distance), 2, h, w]`.
    flows: Vec<[Tensor<4>; 2]>,
    frames: usize,
}

impl Paths {
    /// Follows the flow from frame to frame. No gradient reaches it.
    pub(super) fn new(flow: &WindowFlow, frames: usize) -> Self {
        let pairs = flow.pairs.clone().detach();
        let [all, _, h, w] = pairs.dims();
        let half = all / 2;
        let near =
            [0, half].map(|first| by_burst(pairs.clone().narrow(0, first, half), frames - 1));
        let bursts = half / (frames - 1);
        let part = |x: &Tensor<5>, first: usize, count: usize| {
            x.clone().narrow(1, first, count).reshape([bursts * count, 2, h, w])
        };
        let mut flows: Vec<[Tensor<4>; 2]> = Vec::with_capacity(NEIGHBOURS);
        for distance in 1..=NEIGHBOURS.min(frames - 1) {
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
    pub(super) fn of(flows: Vec<[Tensor<4>; 2]>, frames: usize) -> Self {
        Self { flows, frames }
    }

    /// Returns all tensors.
    pub(super) fn tensors(&self) -> impl Iterator<Item = &Tensor<4>> {
        self.flows.iter().flatten()
    }

    /// Returns the same inside autodiff, without gradient.
    pub(super) fn from_inner(paths: Self) -> Self {
        let flows = paths.flows.into_iter().map(|pair| pair.map(Tensor::from_inner)).collect();
        Self { flows, frames: paths.frames }
    }

    /// Returns the same outside autodiff.
    pub(super) fn inner(&self) -> Self {
        let flows = self.flows.iter().map(|pair| pair.clone().map(Tensor::inner)).collect();
        Self { flows, frames: self.frames }
    }
}

/// Merges every frame with its neighbours as the formula weights them, without a network.
///
/// # Shapes
/// As for [`Agreement::forward`].
pub(super) fn merged(images: Tensor<4>, sigma: &Tensor<4>, paths: &Paths) -> Tensor<4> {
    merge(images, sigma, paths, |difference, _| {
        let [count, _, h, w] = difference.dims();
        let formula = formula(difference);
        pixel_shuffle(formula.expand([count, IMAGE, h / FOLD, w / FOLD]), FOLD)
    })
}

/// Returns the logarithm of a neighbour's weight for its difference in units of usual errors, at half the
/// resolution.
fn formula(difference: Tensor<4>) -> Tensor<4> {
    let square = mean_around(avg_pool2(difference.powi_scalar(2)), 2);
    -(square / TOLERANCE + 1.0).log()
}

/// The place of a neighbour among the frames of a burst.
#[derive(Clone, Copy, Debug)]
struct Place {
    distance: usize,
    /// True for neighbours after a frame.
    later: bool,
    frames: usize,
}

impl Place {
    /// Returns the frames of every burst that have such a neighbour, or these neighbours.
    fn part(&self, x: &Tensor<4>, neighbours: bool) -> Tensor<4> {
        let [images, c, h, w] = x.dims();
        let (bursts, count) = (images / self.frames, self.frames - self.distance);
        let first = if neighbours == self.later { self.distance } else { 0 };
        let part = by_burst(x.clone(), self.frames).narrow(1, first, count);
        part.reshape([bursts * count, c, h, w])
    }

    /// Adds zeros for frames that have no such neighbour.
    fn whole(&self, x: Tensor<4>) -> Tensor<4> {
        let count = self.frames - self.distance;
        let [images, c, h, w] = x.dims();
        let bursts = images / count;
        let nothing = Tensor::zeros([bursts, self.distance, c, h, w], &x.device());
        let x = by_burst(x, count);
        let parts = if self.later { vec![x, nothing] } else { vec![nothing, x] };
        Tensor::cat(parts, 1).reshape([bursts * self.frames, c, h, w])
    }
}

/// Merges every frame with its neighbours. `log_weight` gives the logarithm of a neighbour's weight in every
/// pixel from its difference in units of usual errors.
fn merge(
    images: Tensor<4>,
    sigma: &Tensor<4>,
    paths: &Paths,
    log_weight: impl Fn(Tensor<4>, Place) -> Tensor<4>,
) -> Tensor<4> {
    let mut sum = images.clone();
    let mut total = images.ones_like();
    for (flows, distance) in paths.flows.iter().zip(1..) {
        for (flow, later) in flows.iter().zip([true, false]) {
            let place = Place { distance, later, frames: paths.frames };
            let aligned = warp_cubic(place.part(&images, true), upsample2(flow.clone()) * 2.0);
            let difference = aligned.clone() - place.part(&images, false);
            let difference = difference / place.part(sigma, false);
            let log_weight = log_weight(difference, place);
            let weight = log_weight.clamp(LOG_WEIGHT[0], LOG_WEIGHT[1]).exp();
            let both = Tensor::cat(vec![aligned * weight.clone(), weight], 1);
            let both = place.whole(both);
            sum = sum + both.clone().narrow(1, 0, 1);
            total = total + both.narrow(1, 1, 1);
        }
    }
    sum / total
}

impl Agreement {
    /// Creates the convolutions for so many features of the U-Net.
    pub(super) fn zeros(features: usize, device: &Device) -> Self {
        Self {
            frame: Conv2d::zeros([features, HIDDEN], 3, Bias::Yes, device),
            neighbour: Conv2d::zeros([PLANES, HIDDEN], 3, Bias::No, device),
            out: Conv2d::zeros([HIDDEN, IMAGE], 3, Bias::Yes, device),
        }
    }

    /// Merges every frame with its neighbours.
    ///
    /// # Shapes
    /// - images: `[bursts * frames, 1, H, W]`
    /// - features: `[bursts * frames, features, H / 2, W / 2]`
    /// - sigma: of usual errors, `[bursts * frames, 1, 1, 1]`
    pub(super) fn forward(
        &self,
        images: Tensor<4>,
        features: Tensor<4>,
        sigma: &Tensor<4>,
        paths: &Paths,
    ) -> Tensor<4> {
        let of_frames = self.frame.linear(&[features]);
        merge(images, sigma, paths, |difference, place| {
            let formula = formula(difference.clone());
            let planes = pixel_unshuffle(difference.clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE), FOLD);
            let far = formula.ones_like() * (place.distance as f32 - 2.0);
            let planes = Tensor::cat(vec![planes.clone(), planes.abs(), formula.clone(), far], 1);
            let of_frame = place.part(&of_frames, false);
            let hidden = relu(self.neighbour.add(&[planes], of_frame));
            pixel_shuffle(self.out.linear(&[hidden]) + formula, FOLD)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;
    use qudi_layers::tensor::read;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    const SIDE: usize = 32;
    const FRAMES: usize = 5;

    /// Returns frames of a texture that moves by `speed` pixels a frame, and its flow at half the resolution.
    fn moving(speed: f32) -> (Tensor<4>, WindowFlow) {
        let device = Device::flex();
        let value = |t: usize, i: usize| {
            let (x, y) = ((i % SIDE) as f32 - speed * t as f32, (i / SIDE) as f32);
            0.2 * (0.5 * x + 0.2 * y).sin() + 0.2 * (0.31 * x - 0.6 * y).cos()
        };
        let frame = |t: usize| (0..SIDE * SIDE).map(move |i| value(t, i));
        let values = (0..FRAMES).flat_map(frame).collect();
        let shape = [FRAMES, 1, SIDE, SIDE];
        let frames = Tensor::from_data(TensorData::new::<f32, _>(values, shape), &device);
        let cells = SIDE / FOLD;
        let plane = |value| Tensor::full([FRAMES - 1, 1, cells, cells], value, &device);
        let of_direction =
            |sign: f32| Tensor::cat(vec![plane(sign * speed / FOLD as f32), plane(0.0)], 1);
        let pairs = Tensor::cat(vec![of_direction(1.0), of_direction(-1.0)], 0);
        (frames, WindowFlow { pairs, scale: FOLD })
    }

    /// Returns the mean squared difference far from the edges.
    fn error(a: &Tensor<4>, b: &Tensor<4>) -> f32 {
        let inner = |x: &Tensor<4>| x.clone().narrow(2, 10, 12).narrow(3, 10, 12);
        (inner(a) - inner(b)).powi_scalar(2).mean().into_scalar::<f32>()
    }

    fn noise(sigma: f32) -> Tensor<4> {
        let normal = Normal::new(0.0, sigma).unwrap_or_else(|e| panic!("{e}"));
        let values = normal.sample_iter(ChaCha8Rng::seed_from_u64(1));
        let values = values.take(FRAMES * SIDE * SIDE).collect();
        let data = TensorData::new::<f32, _>(values, [FRAMES, 1, SIDE, SIDE]);
        Tensor::from_data(data, &Device::flex())
    }

    fn sigma(value: f32) -> Tensor<4> {
        Tensor::full([FRAMES, 1, 1, 1], value, &Device::flex())
    }

    #[test]
    fn paths_are_followed_from_frame_to_frame() {
        let (_, flow) = moving(1.0);
        let paths = Paths::new(&flow, FRAMES);
        assert_eq!(paths.flows.len(), NEIGHBOURS);
        for ([later, earlier], distance) in paths.flows.iter().zip(1u8..) {
            let most = 0.5 * f32::from(distance);
            for (flow, expected) in [(later, most), (earlier, -most)] {
                assert_eq!(flow.dims()[0], FRAMES - usize::from(distance));
                let x = read(flow.clone().narrow(1, 0, 1)).unwrap_or_else(|e| panic!("{e}"));
                assert!(x.iter().all(|x| (x - expected).abs() < 1e-5), "{distance}: {x:?}");
            }
        }
    }

    #[test]
    fn errors_of_their_own_are_averaged() {
        for speed in [0.0, 1.3] {
            let (truth, flow) = moving(speed);
            let frames = truth.clone() + noise(0.05);
            let merged = merged(frames.clone(), &sigma(0.1), &Paths::new(&flow, FRAMES));
            let share = error(&merged, &truth) / error(&frames, &truth);
            assert!(share < 0.45, "{share} of the error at {speed} pixels a frame");
        }
    }

    /// A frame that shows something else stays as it is.
    #[test]
    fn frames_that_do_not_agree_are_left_out() {
        let (frames, flow) = moving(0.0);
        let middle = FRAMES / 2;
        let other = noise(0.4).narrow(0, middle, 1);
        let parts = [frames.clone().narrow(0, 0, middle), other.clone()];
        let rest = frames.narrow(0, middle + 1, FRAMES - middle - 1);
        let frames = Tensor::cat([parts.to_vec(), vec![rest]].concat(), 0);
        let merged = merged(frames, &sigma(0.05), &Paths::new(&flow, FRAMES));
        let change = error(&merged.narrow(0, middle, 1), &other);
        assert!(change < 0.05 * 0.16, "{change}");
    }
}
