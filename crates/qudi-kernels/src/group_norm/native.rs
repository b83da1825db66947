//! Group normalisation and its gradients on slices of memory.
// Plain indices over arrays of known length: the compiler turns them into vectors.
#![allow(clippy::needless_range_loop)]

use super::{Activation, EPSILON, Norm};
use crate::exp::exp;
use crate::uninitialised::fill;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Number of values summed in f32 before they are added to a sum in f64.
const BLOCK: usize = 1024;
/// Number of interleaved sums, so that the compiler can use vectors.
const LANES: usize = 16;

/// Gradients with respect to `x`, weight and bias.
#[derive(Debug)]
pub(super) struct NormGradients {
    pub(super) x: Vec<f32>,
    pub(super) weight: Vec<f32>,
    pub(super) bias: Vec<f32>,
}

/// Sizes derived from the shapes.
struct Sizes {
    /// Values per channel of one image.
    plane: usize,
    /// Channels per group.
    group: usize,
    channels: usize,
    groups: usize,
    /// Number of images that share a row of weights.
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

    /// Returns the index of the weight of channel `k` in group `number` of all images' groups.
    fn weight(&self, number: usize, k: usize) -> usize {
        let (image, group) = (number / self.groups, number % self.groups);
        image / self.share * self.channels + group * self.group + k
    }
}

/// Computes [`group_norm`](super::group_norm).
pub(super) fn forward(
    shape: [usize; 4],
    norm: Norm,
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
) -> Vec<f32> {
    let sizes = &Sizes::new(shape, norm, weight.len());
    let size = sizes.group * sizes.plane;
    let (arch, activation) = (Arch::new(), norm.activation);
    fill(x.len(), |result| {
        let groups = result.par_chunks_mut(size).zip(x.par_chunks(size)).enumerate();
        groups.for_each(|(number, (result, x))| {
            arch.dispatch(Forward { sizes, activation, number, x, weight, bias, result });
        });
    })
}

/// Forward pass of one group of one image.
struct Forward<'a> {
    sizes: &'a Sizes,
    activation: Activation,
    number: usize,
    x: &'a [f32],
    weight: &'a [f32],
    bias: &'a [f32],
    result: &'a mut [MaybeUninit<f32>],
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let (mean, scale) = moments(self.x);
        let plane = self.sizes.plane;
        let planes = self.result.chunks_mut(plane).zip(self.x.chunks(plane));
        for (k, (result, x)) in planes.enumerate() {
            let place = self.sizes.weight(self.number, k);
            let slope = scale * self.weight[place];
            let offset = self.bias[place] - mean * slope;
            match self.activation {
                Activation::None => affine(x, slope, offset, result),
                Activation::Silu => affine_silu(x, slope, offset, result),
            }
        }
    }
}

/// Computes the gradients of `x`, weight and bias from the gradient of the result.
pub(super) fn gradients(
    shape: [usize; 4],
    norm: Norm,
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    gradient: &[f32],
) -> NormGradients {
    let sizes = &Sizes::new(shape, norm, weight.len());
    let size = sizes.group * sizes.plane;
    let (arch, activation) = (Arch::new(), norm.activation);
    let count = shape[0] * sizes.groups;
    let mut sums: Vec<Vec<(f32, f32)>> = vec![Vec::new(); count];
    let mut dx = vec![0.0; x.len()];
    let groups = dx.par_chunks_mut(size).zip(x.par_chunks(size));
    let groups = groups.zip(gradient.par_chunks(size)).zip(&mut sums).enumerate();
    groups.for_each(|(number, (((dx, x), gradient), sums))| {
        *sums =
            arch.dispatch(Backward { sizes, activation, number, x, weight, bias, gradient, dx });
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

/// Backward pass of one group of one image.
struct Backward<'a> {
    sizes: &'a Sizes,
    activation: Activation,
    number: usize,
    x: &'a [f32],
    weight: &'a [f32],
    bias: &'a [f32],
    gradient: &'a [f32],
    dx: &'a mut [f32],
}

impl WithSimd for Backward<'_> {
    type Output = Vec<(f32, f32)>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        let weights: Vec<(f32, f32)> = (0..self.sizes.group)
            .map(|k| {
                let place = self.sizes.weight(self.number, k);
                (self.weight[place], self.bias[place])
            })
            .collect();
        group_gradient(self.x, self.gradient, &weights, self.sizes.plane, self.activation, self.dx)
    }
}

/// Writes the gradient of one group of one image. Returns the gradients of its channels' weights and biases.
#[inline(always)]
fn group_gradient(
    x: &[f32],
    gradient: &[f32],
    weights: &[(f32, f32)],
    plane: usize,
    activation: Activation,
    dx: &mut [f32],
) -> Vec<(f32, f32)> {
    let (mean, scale) = moments(x);
    let mut sums = Vec::with_capacity(weights.len());
    let planes = x.chunks(plane).zip(gradient.chunks(plane)).zip(dx.chunks_mut(plane));
    for (((x, gradient), dx), &affine) in planes.zip(weights) {
        sums.push(match activation {
            Activation::None => through::<false>(x, gradient, mean, scale, affine, dx),
            Activation::Silu => through::<true>(x, gradient, mean, scale, affine, dx),
        });
    }
    // dx = scale * (d * weight - mean(d * weight) - normal * mean(d * weight * normal))
    let count = x.len() as f32;
    let (mut plain, mut along) = (0.0, 0.0);
    for (&(affine, sum), (weight, _)) in sums.iter().zip(weights) {
        plain += sum * weight / count;
        along += affine * weight / count;
    }
    for ((x, (weight, _)), dx) in x.chunks(plane).zip(weights).zip(dx.chunks_mut(plane)) {
        let (slope, tilt) = (scale * weight, -scale * scale * along);
        let offset = -scale * plain - tilt * mean;
        for (&x, dx) in x.iter().zip(dx) {
            *dx = dx.mul_add(slope, x.mul_add(tilt, offset));
        }
    }
    sums
}

/// Writes the gradient before the affine part. Returns its sum and the sum of its products with the
/// normalised value.
#[inline(always)]
fn through<const SILU: bool>(
    x: &[f32],
    gradient: &[f32],
    mean: f32,
    scale: f32,
    (weight, bias): (f32, f32),
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
                let slope = if SILU {
                    let v = normal.mul_add(weight, bias);
                    let s = sigmoid(v);
                    s * (1.0 - s).mul_add(v, 1.0)
                } else {
                    1.0
                };
                let d = gradient * slope;
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

/// Returns the mean, and one over the standard deviation.
#[inline(always)]
fn moments(x: &[f32]) -> (f32, f32) {
    let (mut sum, mut squares) = (0f64, 0f64);
    for x in x.chunks(BLOCK) {
        let (mut a, mut b) = ([0f32; LANES], [0f32; LANES]);
        let (rows, rest) = x.as_chunks::<LANES>();
        for x in rows {
            for i in 0..LANES {
                a[i] += x[i];
                b[i] = x[i].mul_add(x[i], b[i]);
            }
        }
        for (i, &x) in rest.iter().enumerate() {
            a[i] += x;
            b[i] = x.mul_add(x, b[i]);
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

#[inline(always)]
fn sigmoid(v: f32) -> f32 {
    1.0 / (1.0 + exp(-v))
}

#[cfg(test)]
mod tests {
    use super::sigmoid;

    #[test]
    fn sigmoid_matches_the_library() {
        for i in -100_000..=100_000 {
            let v = i as f32 * 1e-3;
            let expected = 1.0 / (1.0 + (-f64::from(v)).exp());
            let error = (f64::from(sigmoid(v)) - expected).abs() / expected;
            assert!(error < 4e-7 || expected < 1e-36, "sigmoid({v}) is off by {error:e}");
        }
    }
}
