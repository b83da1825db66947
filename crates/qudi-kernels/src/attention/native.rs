//! Attention on slices of memory. Matrix products are 1x1 convolutions whose weights are the keys or values.
//! Scores are stored as `[keys][queries]`, so that the softmax of neighbouring queries vectorizes.

use crate::conv::Geometry;
use crate::conv::native::{forward as convolve, weight_gradients};
use crate::exp::exp;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// Number of queries whose sums are computed together.
const LANES: usize = 64;

/// Multiplies a matrix `[outputs][planes]` by `cells` pixels:
/// `result[o] = sum over p of weight[o][p] * planes[p]`.
fn product(weight: &[f32], planes: &[f32], outputs: usize, cells: usize) -> Vec<f32> {
    let geometry = geometry(planes.len() / cells, outputs, cells);
    convolve(&geometry, &[planes], weight, &vec![0.0; outputs])
}

/// Computes `result[a][b] = sum over cells of left[a] * right[b]`.
fn outer(left: &[f32], right: &[f32], cells: usize) -> Vec<f32> {
    let geometry = geometry(right.len() / cells, left.len() / cells, cells);
    weight_gradients(&geometry, &[right], left, None).weight
}

fn geometry(planes: usize, outputs: usize, cells: usize) -> Geometry {
    Geometry {
        images: 1,
        frames: 1,
        channels: vec![planes],
        height: 1,
        width: cells,
        outputs,
        kernel: [1, 1, 1],
        stride: 1,
        addend: false,
        relu: false,
        bf16: false,
    }
}

/// Transposes `[rows][columns]` to `[columns][rows]`, and multiplies by `scale`.
fn transposed(values: &[f32], columns: usize, scale: f32) -> Vec<f32> {
    let rows = values.len() / columns;
    let mut result = Vec::with_capacity(values.len());
    for column in 0..columns {
        result.extend((0..rows).map(|row| values[row * columns + column] * scale));
    }
    result
}

/// Splits an image into queries, keys and values, `[channels][cells]` each.
fn parts(qkv: &[f32]) -> [&[f32]; 3] {
    let size = qkv.len() / 3;
    [&qkv[..size], &qkv[size..2 * size], &qkv[2 * size..]]
}

/// Computes the attention probabilities `[keys][queries]` of an image.
fn probabilities(qkv: &[f32], channels: usize, cells: usize) -> Vec<f32> {
    let [queries, keys, _] = parts(qkv);
    let scale = (channels as f32).sqrt().recip();
    let mut scores = product(&transposed(keys, cells, scale), queries, cells, cells);
    Arch::new().dispatch(Softmax { scores: &mut scores, queries: cells });
    scores
}

/// Softmax over the first axis of `[keys][queries]`, in place.
struct Softmax<'a> {
    scores: &'a mut [f32],
    queries: usize,
}

impl WithSimd for Softmax<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        softmax(self.scores, self.queries);
    }
}

#[inline(always)]
fn softmax(scores: &mut [f32], queries: usize) {
    for start in (0..queries).step_by(LANES) {
        let count = LANES.min(queries - start);
        let mut most = [f32::MIN; LANES];
        for row in scores.chunks_exact(queries) {
            for (most, &score) in most.iter_mut().zip(&row[start..start + count]) {
                *most = most.max(score);
            }
        }
        let mut sum = [0f32; LANES];
        for row in scores.chunks_exact_mut(queries) {
            let row = &mut row[start..start + count];
            for ((score, most), sum) in row.iter_mut().zip(&most).zip(&mut sum) {
                *score = exp(*score - most);
                *sum += *score;
            }
        }
        let share = sum.map(f32::recip);
        for row in scores.chunks_exact_mut(queries) {
            for (score, share) in row[start..start + count].iter_mut().zip(&share) {
                *score *= share;
            }
        }
    }
}

/// Computes [`attention`](super::attention).
pub(super) fn forward([_, channels, height, width]: [usize; 4], qkv: &[f32]) -> Vec<f32> {
    let (channels, cells) = (channels / 3, height * width);
    let images = qkv.par_chunks(3 * channels * cells).map(|qkv| {
        let probabilities = probabilities(qkv, channels, cells);
        product(parts(qkv)[2], &probabilities, channels, cells)
    });
    images.collect::<Vec<_>>().concat()
}

/// Computes the gradient with respect to `qkv`.
pub(super) fn gradient(
    [_, channels, height, width]: [usize; 4],
    qkv: &[f32],
    gradient: &[f32],
) -> Vec<f32> {
    let (channels, cells) = (channels / 3, height * width);
    let scale = (channels as f32).sqrt().recip();
    let images = qkv.par_chunks(3 * channels * cells).zip(gradient.par_chunks(channels * cells));
    let images = images.map(|(qkv, gradient)| {
        let [queries, keys, values] = parts(qkv);
        let shares = probabilities(qkv, channels, cells);
        let to_values = outer(gradient, &shares, cells);
        let mut scores = product(&transposed(values, cells, 1.0), gradient, cells, cells);
        let gradient = &mut scores;
        Arch::new().dispatch(ThroughSoftmax { shares: &shares, gradient, queries: cells });
        let scaled: Vec<f32> = keys.iter().map(|key| key * scale).collect();
        let to_queries = product(&scaled, &scores, channels, cells);
        let mut to_keys = outer(queries, &scores, cells);
        for value in &mut to_keys {
            *value *= scale;
        }
        [to_queries, to_keys, to_values].concat()
    });
    images.collect::<Vec<_>>().concat()
}

/// Conversion of gradients with respect to probabilities into gradients with respect to scores, in place.
struct ThroughSoftmax<'a> {
    shares: &'a [f32],
    gradient: &'a mut [f32],
    queries: usize,
}

impl WithSimd for ThroughSoftmax<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        through_softmax(self.shares, self.gradient, self.queries);
    }
}

#[inline(always)]
fn through_softmax(shares: &[f32], gradient: &mut [f32], queries: usize) {
    for start in (0..queries).step_by(LANES) {
        let count = LANES.min(queries - start);
        let place = start..start + count;
        let mut mean = [0f32; LANES];
        for (share, gradient) in shares.chunks_exact(queries).zip(gradient.chunks_exact(queries)) {
            let row = share[place.clone()].iter().zip(&gradient[place.clone()]);
            for ((share, gradient), mean) in row.zip(&mut mean) {
                *mean = share.mul_add(*gradient, *mean);
            }
        }
        let rows = shares.chunks_exact(queries).zip(gradient.chunks_exact_mut(queries));
        for (share, gradient) in rows {
            let row = share[place.clone()].iter().zip(&mut gradient[place.clone()]);
            for ((share, gradient), mean) in row.zip(&mean) {
                *gradient = share * (*gradient - mean);
            }
        }
    }
}
