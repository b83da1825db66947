//! The gradients of a stack, from its features back to its inputs.

use super::Stack;
use super::forward::{
    Activations, GroupActivations, convolutions, convolve, convolve_into, correlate, groups,
    of_group,
};
use super::grid::{BLOCK, TILE};
use super::layout::{CHANNELS, Line};
use super::unit::{Finish, Gradient};
use super::weights::{TAPS, Tiles};
use crate::uninitialised::written;
use rayon::prelude::*;

const PLAIN: Finish<'_> = Finish { bias: None, addend: None, relu: false, mask: None };

/// Computes the gradients for every input, `[images, channels, height, width]`, and for the flat parameters.
pub(super) fn backward(
    stack: &Stack,
    activations: &Activations,
    parameters: &[f32],
    gradient: &[f32],
) -> (Vec<Vec<f32>>, Vec<f32>) {
    let convolutions = convolutions(stack, parameters);
    let tiles: Vec<Tiles> =
        convolutions.par_iter().map(|conv| Tiles::backward(conv.weight, conv.sizes)).collect();
    let groups = groups(stack);
    let images = groups[0].images;
    let work = |(number, (group, activations)): (usize, (&Stack, &GroupActivations))| {
        let gradient = of_group(gradient, group, number * images, stack.features);
        let (inputs, sums) = backward_group(group, activations, &tiles, gradient);
        let mut first = 0;
        let planes = stack.inputs.iter().map(|&channels| {
            first += channels;
            let length = group.images * channels * stack.height * stack.width;
            written(length, |planes| {
                inputs.write_planes(&activations.grid, first - channels, channels, planes);
            })
        });
        (planes.collect::<Vec<_>>(), sums)
    };
    let parts: Vec<(Vec<Vec<f32>>, Vec<Gradient>)> =
        groups.par_iter().zip(&activations.0).enumerate().map(work).collect();
    let mut inputs: Vec<Vec<f32>> = vec![Vec::new(); stack.inputs.len()];
    let mut sums: Vec<Vec<Gradient>> = convolutions.iter().map(|_| Vec::new()).collect();
    for (planes, group_sums) in parts {
        for (input, planes) in inputs.iter_mut().zip(planes) {
            if input.is_empty() {
                *input = planes;
            } else {
                input.extend(planes);
            }
        }
        for (sums, sum) in sums.iter_mut().zip(group_sums) {
            sums.push(sum);
        }
    }
    // Summed in the order of the groups: the result does not depend on threads.
    let flat = sums.into_par_iter().zip(&convolutions).map(|(sums, conv)| {
        let all = sums.into_iter().reduce(Gradient::plus).expect("a group");
        let mut values = unpacked(&all, conv.sizes);
        values.extend_from_slice(&all.bias[..conv.sizes[1]]);
        values
    });
    let flat: Vec<Vec<f32>> = flat.collect();
    (inputs, flat.concat())
}

/// Computes the gradients for the joined inputs of a group and for every convolution.
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
        sums.push(correlate(grid, &hidden[block], &gradient));
        let finish = Finish { mask: Some(&hidden[block]), ..PLAIN };
        let between = convolve(grid, &gradient, &tiles[second], finish);
        sums.push(correlate(grid, &features[block], &between));
        // What passes through the ReLU of the entry is all that is left to do after the first block.
        let mask = (block == 0).then_some(&features[0]);
        let finish = Finish { addend: Some(gradient.values.as_ptr()), mask, ..PLAIN };
        convolve_into(grid, &between, &tiles[first], finish, &mut gradient);
    }
    if stack.blocks == 0 {
        for (value, &feature) in gradient.values.iter_mut().zip(&features[0].values) {
            *value = if feature == 0 { 0 } else { *value };
        }
    }
    sums.push(correlate(grid, input, &gradient));
    sums.reverse();
    (convolve(grid, &gradient, &tiles[0], PLAIN), sums)
}

/// Returns sums as the gradient of a weight, `[outputs, inputs, 3, 3]`.
fn unpacked(sums: &Gradient, [inputs, outputs]: [usize; 2]) -> Vec<f32> {
    const { assert!(BLOCK == 2 * TILE && BLOCK == CHANNELS) };
    let [wide, high] = [inputs, outputs].map(|channels| channels.div_ceil(BLOCK));
    let mut values = vec![0.0; inputs * outputs * TAPS];
    for (output, weight) in values.chunks_exact_mut(inputs * TAPS).enumerate() {
        for (input, weight) in weight.chunks_exact_mut(TAPS).enumerate() {
            for (tap, weight) in weight.iter_mut().enumerate() {
                let block = (tap * wide + input / BLOCK) * high + output / BLOCK;
                *weight = sums.blocks[block].0[input % BLOCK][output % BLOCK];
            }
        }
    }
    values
}
