//! The normalisation and its gradients on plain memory.

use super::{Activation, EPSILON, Norm};
use crate::uninitialised::fill;
use pulp::Arch;
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Values summed in f32 before they go into a sum in f64.
const BLOCK: usize = 1024;
/// Sums side by side, so that the compiler can use vectors.
const LANES: usize = 16;

/// Gradients for `x`, weight and bias.
#[derive(Debug)]
pub(super) struct NormGradients {
    pub(super) x: Vec<f32>,
    pub(super) weight: Vec<f32>,
    pub(super) bias: Vec<f32>,
}

/// Sizes that follow from the shapes.
struct Sizes {
    /// Values of a channel of one image.
    plane: usize,
    /// Channels of a group.
    group: usize,
    channels: usize,
    groups: usize,
    /// Images that share a row of weights.
    share: usize,
}

impl Sizes {
    fn new([images, channels, height, width]: [usize; 4], norm: Norm, weights: usize) -> Self {
        Self {
            plane: height * width,
            group: channels / norm.groups,
            channels,
            groups: norm.groups,
            share: images / (weights / channels),
        }
    }

    /// Number of the weight of channel `k` of group `number` among all images' groups.
    fn weight(&self, number: usize, k: usize) -> usize {
        let (image, group) = (number / self.groups, number % self.groups);
        image / self.share * self.channels + group * self.group + k
    }
}

/// See [`group_norm`](super::group_norm).
pub(super) fn forward(
    shape: [usize; 4],
    norm: Norm,
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
) -> Vec<f32> {
    let sizes = Sizes::new(shape, norm, weight.len());
    let size = sizes.group * sizes.plane;
    let arch = Arch::new();
    fill(x.len(), |result| {
        let groups = result.par_chunks_mut(size).zip(x.par_chunks(size)).enumerate();
        groups.for_each(|(number, (result, x))| {
            arch.dispatch(|| {
                let (mean, scale) = moments(x);
                let planes = result.chunks_mut(sizes.plane).zip(x.chunks(sizes.plane));
                for (k, (result, x)) in planes.enumerate() {
                    let place = sizes.weight(number, k);
                    let slope = scale * weight[place];
                    let offset = bias[place] - mean * slope;
                    match norm.activation {
                        Activation::None => affine(x, slope, offset, result),
                        Activation::Silu => affine_silu(x, slope, offset, result),
                    }
                }
            });
        });
    })
}

/// Gradients of a sum whose gradient for the result is `gradient`.
pub(super) fn gradients(
    shape: [usize; 4],
    norm: Norm,
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    gradient: &[f32],
) -> NormGradients {
    let sizes = Sizes::new(shape, norm, weight.len());
    let size = sizes.group * sizes.plane;
    let arch = Arch::new();
    let count = shape[0] * sizes.groups;
    let mut sums: Vec<Vec<(f32, f32)>> = vec![Vec::new(); count];
    let mut dx = vec![0.0; x.len()];
    let groups = dx.par_chunks_mut(size).zip(x.par_chunks(size));
    let groups = groups.zip(gradient.par_chunks(size)).zip(&mut sums).enumerate();
    groups.for_each(|(number, (((dx, x), gradient), sums))| {
        arch.dispatch(|| {
            let weights = (0..sizes.group).map(|k| {
                let place = sizes.weight(number, k);
                (weight[place], bias[place])
            });
            *sums = group_gradient(x, gradient, weights, sizes.plane, norm.activation, dx);
        });
    });
    let (mut dweight, mut dbias) = (vec![0.0; weight.len()], vec![0.0; weight.len()]);
    for (number, sums) in sums.iter().enumerate() {
        for (k, &(affine, plain)) in sums.iter().enumerate() {
            let place = sizes.weight(number, k);
            dweight[place] += affine;
            dbias[place] += plain;
        }
    }
    NormGradients { x: dx, weight: dweight, bias: dbias }
}

/// Writes the gradient for one group of one image; gives those for its channels' weights and biases.
#[inline(always)]
fn group_gradient(
    x: &[f32],
    gradient: &[f32],
    weights: impl Iterator<Item = (f32, f32)> + Clone,
    plane: usize,
    activation: Activation,
    dx: &mut [f32],
) -> Vec<(f32, f32)> {
    let (mean, scale) = moments(x);
    let mut sums = Vec::with_capacity(x.len() / plane);
    let planes = || x.chunks(plane).zip(weights.clone());
    for (((x, (weight, bias)), gradient), dx) in
        planes().zip(gradient.chunks(plane)).zip(dx.chunks_mut(plane))
    {
        sums.push(match activation {
            Activation::None => through(x, gradient, mean, scale, |_| 1.0, dx),
            Activation::Silu => {
                let slope = |normal: f32| {
                    let v = normal.mul_add(weight, bias);
                    let s = sigmoid(v);
                    s * (1.0 - s).mul_add(v, 1.0)
                };
                through(x, gradient, mean, scale, slope, dx)
            }
        });
    }
    // dx = scale * (d * weight - mean(d * weight) - normal * mean(d * weight * normal))
    let count = x.len() as f32;
    let (mut plain, mut along) = (0.0, 0.0);
    for (&(affine, sum), (weight, _)) in sums.iter().zip(weights.clone()) {
        plain += sum * weight / count;
        along += affine * weight / count;
    }
    for ((x, (weight, _)), dx) in planes().zip(dx.chunks_mut(plane)) {
        let (slope, tilt) = (scale * weight, -scale * scale * along);
        let offset = -scale * plain - tilt * mean;
        for (&x, dx) in x.iter().zip(dx) {
            *dx = dx.mul_add(slope, x.mul_add(tilt, offset));
        }
    }
    sums
}

/// Writes the gradient before the affine part, `gradient * slope(normal)`, and sums it, once times
/// `normal` and once alone.
#[inline(always)]
fn through(
    x: &[f32],
    gradient: &[f32],
    mean: f32,
    scale: f32,
    slope: impl Fn(f32) -> f32,
    dx: &mut [f32],
) -> (f32, f32) {
    let (mut affine, mut plain) = (0f64, 0f64);
    let blocks = x.chunks(BLOCK).zip(gradient.chunks(BLOCK)).zip(dx.chunks_mut(BLOCK));
    for ((x, gradient), dx) in blocks {
        let (mut along, mut alone) = ([0f32; LANES], [0f32; LANES]);
        let rows = x.chunks(LANES).zip(gradient.chunks(LANES)).zip(dx.chunks_mut(LANES));
        for ((x, gradient), dx) in rows {
            let lanes = along.iter_mut().zip(&mut alone);
            for ((((along, alone), &x), &gradient), dx) in lanes.zip(x).zip(gradient).zip(dx) {
                let normal = (x - mean) * scale;
                let d = gradient * slope(normal);
                *dx = d;
                *along = d.mul_add(normal, *along);
                *alone += d;
            }
        }
        affine += f64::from(along.iter().sum::<f32>());
        plain += f64::from(alone.iter().sum::<f32>());
    }
    (affine as f32, plain as f32)
}

/// Mean, and one over the deviation.
#[inline(always)]
fn moments(x: &[f32]) -> (f32, f32) {
    let (mut sum, mut squares) = (0f64, 0f64);
    for x in x.chunks(BLOCK) {
        let (mut a, mut b) = ([0f32; LANES], [0f32; LANES]);
        for x in x.chunks(LANES) {
            for ((a, b), &x) in a.iter_mut().zip(&mut b).zip(x) {
                *a += x;
                *b = x.mul_add(x, *b);
            }
        }
        sum += f64::from(a.iter().sum::<f32>());
        squares += f64::from(b.iter().sum::<f32>());
    }
    let mean = sum / x.len() as f64;
    let variance = (squares / x.len() as f64 - mean * mean).max(0.0);
    (mean as f32, (1.0 / (variance + f64::from(EPSILON)).sqrt()) as f32)
}

#[inline(always)]
fn affine(x: &[f32], slope: f32, offset: f32, result: &mut [MaybeUninit<f32>]) {
    for (&x, result) in x.iter().zip(result) {
        result.write(x.mul_add(slope, offset));
    }
}

#[inline(always)]
fn affine_silu(x: &[f32], slope: f32, offset: f32, result: &mut [MaybeUninit<f32>]) {
    for (&x, result) in x.iter().zip(result) {
        let v = x.mul_add(slope, offset);
        result.write(v * sigmoid(v));
    }
}

/// `1 / (1 + exp(-v))` to 2e-7, in operations that have vector forms: exp by a polynomial of degree six after
/// reduction to half a power of two (Cephes, expf).
#[inline(always)]
fn sigmoid(v: f32) -> f32 {
    let x = (-v).clamp(-87.0, 88.0);
    let n = (x * std::f32::consts::LOG2_E).round_ties_even();
    let r = n.mul_add(-0.693_359_4, x);
    let r = n.mul_add(2.121_944_4e-4, r);
    let p = 1.987_569_1e-4_f32
        .mul_add(r, 1.398_199_9e-3)
        .mul_add(r, 8.333_452e-3)
        .mul_add(r, 4.166_579_6e-2)
        .mul_add(r, 0.166_666_65)
        .mul_add(r, 0.5);
    let exp = p.mul_add(r * r, r) + 1.0;
    let power = f32::from_bits(((n as i32 + 127) << 23) as u32);
    1.0 / (1.0 + exp * power)
}

#[cfg(test)]
mod tests {
    use super::sigmoid;

    #[test]
    fn sigmoid_is_that_of_the_library() {
        for i in -100_000..=100_000 {
            let v = i as f32 * 1e-3;
            let expected = 1.0 / (1.0 + (-f64::from(v)).exp());
            let error = (f64::from(sigmoid(v)) - expected).abs() / expected;
            assert!(error < 4e-7 || expected < 1e-36, "sigmoid({v}) is off by {error:e}");
        }
    }
}
