//! The gradients of a stack, from its features back to its inputs.
#![allow(unsafe_code)]

use super::Stack;
use super::forward::{
    Activations, GroupActivations, convolutions, convolve, convolve_into, correlate, groups,
    of_group,
};
use super::grid::{BLOCK, TILE};
use super::layout::{CHANNELS, Line, Shared};
use super::unit::{Finish, Gradient};
use super::weights::{TAPS, Tiles};
use crate::uninitialised::written;
use rayon::prelude::*;

const PLAIN: Finish<'_> = Finish { bias: None, addend: None, relu: false, mask: None };

/// Computes the gradients for the inputs that `requested` names, `[images, channels, height, width]`, and for
/// the flat parameters.
pub(super) fn backward(
    stack: &Stack,
    activations: &Activations,
    parameters: &[f32],
    gradient: &[f32],
    requested: &[bool],
) -> (Vec<Option<Vec<f32>>>, Vec<f32>) {
    let convolutions = convolutions(stack, parameters);
    let tiles = stack.packed.backward(&convolutions);
    let groups = groups(stack);
    let images = groups[0].images;
    let pixels = stack.height * stack.width;
    let lengths = stack.inputs.iter().map(|channels| stack.images * channels * pixels);
    let inputs =
        lengths.zip(requested).map(|(length, requested)| requested.then(|| Planes::new(length)));
    let mut inputs: Vec<Option<Planes>> = inputs.collect();
    let targets = inputs.iter_mut().map(|planes| planes.as_mut().map(Planes::shared));
    let targets: Vec<Option<Shared<f32>>> = targets.collect();
    let work = |(number, (group, activations)): (usize, (&Stack, &GroupActivations))| {
        let gradient = of_group(gradient, group, number * images, stack.features);
        let (gradient, sums) = backward_group(group, activations, tiles, gradient);
        if requested.contains(&true) {
            let grid = &activations.grid;
            let inputs = convolve(stack.units, grid, &gradient, &tiles[0], PLAIN);
            let mut first = 0;
            for (to, &channels) in targets.iter().zip(&stack.inputs) {
                if let Some(to) = to {
                    let place = number * images * channels * pixels;
                    let length = group.images * channels * pixels;
                    // SAFETY: images of this group, in memory of all.
                    let to = unsafe { std::slice::from_raw_parts_mut(to.at(place), length) };
                    inputs.write_planes(grid, first, channels, to);
                }
                first += channels;
            }
        }
        sums
    };
    let parts: Vec<Vec<Gradient>> =
        groups.par_iter().zip(&activations.0).enumerate().map(work).collect();
    let mut sums: Vec<Vec<Gradient>> = convolutions.iter().map(|_| Vec::new()).collect();
    for group_sums in parts {
        for (sums, sum) in sums.iter_mut().zip(group_sums) {
            sums.push(sum);
        }
    }
    let flat = written(parameters.len(), |mut rest| {
        let lengths = convolutions.iter().map(|conv| conv.weight.len() + conv.bias.len());
        let parts: Vec<&mut [f32]> = lengths
            .map(|length| rest.split_off_mut(..length).expect("values of a convolution"))
            .collect();
        // Summed in the order of the groups: the result does not depend on threads.
        let work = parts.into_par_iter().zip(sums).zip(&convolutions);
        work.for_each(|((to, sums), conv)| {
            let all = sums.into_iter().reduce(Gradient::plus).expect("a group");
            let (weight, bias) = to.split_at_mut(conv.weight.len());
            unpack(&all, conv.sizes, weight);
            bias.copy_from_slice(&all.bias[..conv.sizes[1]]);
        });
    });
    // SAFETY: the groups have written all images.
    let inputs = inputs.into_iter().map(|planes| planes.map(|planes| unsafe { planes.written() }));
    (inputs.collect(), flat)
}

/// The gradient of an input, which the groups write.
struct Planes(Vec<f32>, usize);

impl Planes {
    fn new(length: usize) -> Self {
        Self(Vec::with_capacity(length), length)
    }

    fn shared(&mut self) -> Shared<f32> {
        Shared(self.0.as_mut_ptr())
    }

    /// Returns the values.
    ///
    /// # Safety
    /// All must have been written.
    unsafe fn written(mut self) -> Vec<f32> {
        // SAFETY: the caller's promise.
        unsafe { self.0.set_len(self.1) };
        self.0
    }
}

/// Computes the gradients for what the entry's convolution makes of a group, and for every convolution.
fn backward_group(
    stack: &Stack,
    activations: &GroupActivations,
    tiles: &[Tiles],
    gradient: &[f32],
) -> (Line, Vec<Gradient>) {
    let GroupActivations { grid, input, features, hidden } = activations;
    let mut sums = Vec::with_capacity(tiles.len());
    let mut gradient = Line::from_planes(grid, &[(gradient, stack.features)]);
    for block in (0..stack.blocks).rev() {
        let (first, second) = (1 + 2 * block, 2 + 2 * block);
        sums.push(correlate(stack.units, grid, &hidden[block], &gradient));
        let finish = Finish { mask: Some(&hidden[block]), ..PLAIN };
        let between = convolve(stack.units, grid, &gradient, &tiles[second], finish);
        sums.push(correlate(stack.units, grid, &features[block], &between));
        // What passes through the ReLU of the entry is all that is left to do after the first block.
        let mask = (block == 0 && stack.rectifies()).then_some(&features[0]);
        let finish = Finish { addend: Some(gradient.values.as_ptr()), mask, ..PLAIN };
        convolve_into(stack.units, grid, &between, &tiles[first], finish, &mut gradient);
    }
    if stack.blocks == 0 && stack.rectifies() {
        for (value, &feature) in gradient.values.iter_mut().zip(features[0].values.iter()) {
            *value = if feature == 0 { 0 } else { *value };
        }
    }
    sums.push(correlate(stack.units, grid, input, &gradient));
    sums.reverse();
    (gradient, sums)
}

/// Writes sums as the gradient of a weight, `[outputs, inputs, 3, 3]`.
fn unpack(sums: &Gradient, [inputs, outputs]: [usize; 2], to: &mut [f32]) {
    const { assert!(BLOCK == 2 * TILE && BLOCK == CHANNELS) };
    let [wide, high] = [inputs, outputs].map(|channels| channels.div_ceil(BLOCK));
    for (output, weight) in to.chunks_exact_mut(inputs * TAPS).enumerate() {
        for (input, weight) in weight.chunks_mut(BLOCK * TAPS).enumerate() {
            for tap in 0..TAPS {
                let block = &sums.blocks[(tap * wide + input) * high + output / BLOCK];
                let row = &block.0[output % BLOCK];
                for (weight, &sum) in weight.chunks_exact_mut(TAPS).zip(row) {
                    weight[tap] = sum;
                }
            }
        }
    }
}
