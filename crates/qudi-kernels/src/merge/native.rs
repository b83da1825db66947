//! Merging on slices of memory, frame by frame.

use super::MergeRule;
use crate::resample::upsample;
use crate::uninitialised::written;
use crate::warp::cubic::sample;
use multiversion::multiversion;
use rayon::prelude::*;

/// Cells to either side over which squared differences are averaged.
const AROUND: usize = 2;

/// Bursts of the same number of frames, one after the other.
pub(super) struct Burst<'a> {
    pub(super) images: &'a [f32],
    /// Usual errors of every frame.
    pub(super) sigma: &'a [f32],
    pub(super) flows: &'a [f32],
    /// Frames of a burst.
    pub(super) frames: usize,
    pub(super) channels: usize,
    /// Height and width.
    pub(super) size: [usize; 2],
    pub(super) rule: MergeRule,
}

/// Memory of the computation of one frame.
#[derive(Default)]
struct Scratch {
    /// The flow at full resolution.
    flow: Vec<f32>,
    between: Vec<f32>,
    aligned: Vec<f32>,
    squares: Vec<f32>,
    sums: Vec<f32>,
    squared_weights: Vec<f32>,
}

impl Burst<'_> {
    /// Merges every frame with its neighbours.
    pub(super) fn merged(&self) -> Vec<f32> {
        let plane = self.size[0] * self.size[1];
        let images = self.images.len() / (self.channels * plane);
        written(2 * images * plane, |result| {
            let tasks = result.par_chunks_mut(2 * plane).enumerate();
            tasks.for_each_init(Scratch::default, |scratch, (image, result)| {
                self.merge(image, result, scratch);
            });
        })
    }

    /// Returns all channels of an image.
    fn image(&self, number: usize) -> &[f32] {
        let image = self.channels * self.size[0] * self.size[1];
        &self.images[number * image..][..image]
    }

    /// Returns the neighbours of an image with the flow to them.
    fn neighbours(&self, image: usize) -> impl Iterator<Item = (usize, &[f32])> {
        let cells = 2 * (self.size[0] / 2) * (self.size[1] / 2);
        let bursts = self.sigma.len() / self.frames;
        let (burst, frame) = (image / self.frames, image % self.frames);
        let known = self.flows.len() / cells;
        // Flows of a distance follow the flows of all nearer ones.
        let distances = (1..self.frames).scan(0, move |first, distance| {
            let begin = *first;
            *first += 2 * bursts * (self.frames - distance);
            (begin < known).then_some((distance, begin))
        });
        distances.flat_map(move |(distance, begin)| {
            let pairs = self.frames - distance;
            let [later, earlier] =
                [begin, begin + bursts * pairs].map(|first| first + burst * pairs);
            let flow = move |pair: usize| &self.flows[pair * cells..][..cells];
            let later = (frame < pairs).then(|| (image + distance, flow(later + frame)));
            let earlier =
                (frame >= distance).then(|| (image - distance, flow(earlier + frame - distance)));
            later.into_iter().chain(earlier)
        })
    }

    /// Merges image number `number` with its neighbours: the mean first, then the number of frames.
    fn merge(&self, number: usize, result: &mut [f32], scratch: &mut Scratch) {
        let [height, width] = self.size;
        let plane = height * width;
        let own = self.image(number);
        let (mean, total) = result.split_at_mut(plane);
        let Scratch { flow, between, aligned, squares, sums, squared_weights } = scratch;
        mean.copy_from_slice(&own[own.len() - plane..]);
        total.fill(1.0);
        squared_weights.clear();
        squared_weights.resize(plane, 1.0);
        flow.resize(2 * plane, 0.0);
        aligned.resize(own.len(), 0.0);
        let scale = 1.0 / self.sigma[number].powi(2);
        for (neighbour, cells) in self.neighbours(number) {
            let axes = cells.chunks_exact(cells.len() / 2).zip(flow.chunks_exact_mut(plane));
            for (cells, flow) in axes {
                upsample(cells, width / 2, flow, between);
                for displacement in flow {
                    *displacement *= 2.0;
                }
            }
            sample(aligned, self.image(neighbour), flow, self.size);
            pooled_squares(&aligned[..plane], &own[..plane], width, scale, squares);
            weights(squares, sums, [height / 2, width / 2], self.rule);
            let merged = &aligned[aligned.len() - plane..];
            add(merged, squares, width, [mean, total, squared_weights]);
        }
        for ((mean, total), square) in mean.iter_mut().zip(total).zip(squared_weights) {
            *mean /= *total;
            *total = *total * *total / *square;
        }
    }
}

/// Averages squared differences over 2 x 2 pixels.
#[multiversion(targets("x86_64+avx2+fma"))]
fn pooled_squares(a: &[f32], b: &[f32], width: usize, scale: f32, squares: &mut Vec<f32>) {
    squares.clear();
    let square = |a: &[f32], b: &[f32]| {
        let difference = [a[0] - b[0], a[1] - b[1]];
        difference[0] * difference[0] + difference[1] * difference[1]
    };
    for (a, b) in a.chunks_exact(2 * width).zip(b.chunks_exact(2 * width)) {
        let (upper, lower) = (a[..width].chunks_exact(2).zip(b[..width].chunks_exact(2)), width..);
        let lower = a[lower.clone()].chunks_exact(2).zip(b[lower].chunks_exact(2));
        squares.extend(
            upper.zip(lower).map(|((a, b), (c, d))| 0.25 * scale * (square(a, b) + square(c, d))),
        );
    }
}

/// Replaces squared differences by the weights that follow from their means around every cell.
#[multiversion(targets("x86_64+avx2+fma"))]
fn weights(squares: &mut [f32], sums: &mut Vec<f32>, [height, width]: [usize; 2], rule: MergeRule) {
    const COUNT: usize = 2 * AROUND + 1;
    sums.clear();
    sums.resize(squares.len(), 0.0);
    let row = |at: usize, k: usize| (at + k).saturating_sub(AROUND).min(height - 1) * width;
    for (at, sums) in sums.chunks_exact_mut(width).enumerate() {
        for k in 0..COUNT {
            let squares = &squares[row(at, k)..][..width];
            for (sum, square) in sums.iter_mut().zip(squares) {
                *sum += square;
            }
        }
    }
    let share = 1.0 / ((COUNT * COUNT) as f32 * rule.tolerance);
    for (sums, weights) in sums.chunks_exact(width).zip(squares.chunks_exact_mut(width)) {
        for (at, weight) in weights.iter_mut().enumerate() {
            let column = |k: usize| (at + k).saturating_sub(AROUND).min(width - 1);
            let sum: f32 = (0..COUNT).map(|k| sums[column(k)]).sum();
            *weight = 1.0 / (1.0 + (sum * share).powi(rule.power));
        }
    }
}

/// Adds a neighbour with its weights, which are given in cells of 2 x 2 pixels.
#[multiversion(targets("x86_64+avx2+fma"))]
fn add(neighbour: &[f32], weights: &[f32], width: usize, [mean, total, squares]: [&mut [f32]; 3]) {
    for (row, neighbour) in neighbour.chunks_exact(width).enumerate() {
        let at = row * width;
        let weights = &weights[row / 2 * (width / 2)..][..width / 2];
        let (mean, total) = (&mut mean[at..][..width], &mut total[at..][..width]);
        let squares = &mut squares[at..][..width];
        for (column, value) in neighbour.iter().enumerate() {
            let weight = weights[column / 2];
            mean[column] += weight * value;
            total[column] += weight;
            squares[column] += weight * weight;
        }
    }
}
