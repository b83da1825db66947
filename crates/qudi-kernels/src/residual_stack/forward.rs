//! The stack from its inputs to its features.
#![allow(unsafe_code)]

use super::Stack;
use super::grid::Grid;
use super::layout::{Line, Shared};
use super::unit::{self, Finish, Gradient};
use super::weights::{TAPS, Tiles};
use crate::matrix_units::MatrixUnits;
use crate::uninitialised::written;
use rayon::prelude::*;
use std::sync::Arc;

/// Pixels of the images that go through the whole stack together: their activations stay near the processor.
const GROUP_PIXELS: usize = 2048;

/// Activations that the gradient needs, of every group of images.
#[derive(Debug)]
#[allow(unreachable_pub)] // an associated type of a public trait
pub struct Activations(pub(super) Vec<GroupActivations>);

/// Activations of a group of images.
#[derive(Debug)]
pub(super) struct GroupActivations {
    pub(super) grid: Grid,
    pub(super) input: Line,
    /// Features before every block and after the last one.
    pub(super) features: Vec<Line>,
    /// What every block has between its convolutions.
    pub(super) hidden: Vec<Line>,
}

/// A convolution of the flat parameters.
#[derive(Clone, Copy, Debug)]
pub(super) struct Parameters<'a> {
    pub(super) weight: &'a [f32],
    pub(super) bias: &'a [f32],
    /// Inputs and outputs.
    pub(super) sizes: [usize; 2],
}

/// Splits flat parameters by convolution.
pub(super) fn convolutions<'a>(stack: &Stack, parameters: &'a [f32]) -> Vec<Parameters<'a>> {
    let mut rest = parameters;
    let mut split = |sizes: [usize; 2]| {
        let (weight, after) = rest.split_at(sizes[0] * sizes[1] * TAPS);
        let (bias, after) = after.split_at(sizes[1]);
        rest = after;
        Parameters { weight, bias, sizes }
    };
    stack.convolutions().map(&mut split).collect()
}

/// Splits a stack into groups of whole images; the same on any number of threads.
pub(super) fn groups(stack: &Stack) -> Vec<Stack> {
    let images = (GROUP_PIXELS / (stack.height * stack.width)).clamp(1, stack.images);
    let group = |first: usize| Stack { images: images.min(stack.images - first), ..stack.clone() };
    (0..stack.images).step_by(images).map(group).collect()
}

/// Returns the values of a group's images, `channels` planes each.
pub(super) fn of_group<'a>(
    values: &'a [f32],
    stack: &Stack,
    first: usize,
    channels: usize,
) -> &'a [f32] {
    let image = channels * stack.height * stack.width;
    &values[first * image..(first + stack.images) * image]
}

/// Convolves a line on one of this machine's units.
pub(super) fn convolve(
    units: MatrixUnits,
    grid: &Grid,
    from: &Line,
    tiles: &Tiles,
    finish: Finish<'_>,
) -> Line {
    // SAFETY: the convolution writes every block.
    let mut to = unsafe { Line::unwritten(grid, tiles.outputs) };
    convolve_into(units, grid, from, tiles, finish, &mut to);
    to
}

/// Convolves a line into another one, which may be the addend.
pub(super) fn convolve_into(
    units: MatrixUnits,
    grid: &Grid,
    from: &Line,
    tiles: &Tiles,
    finish: Finish<'_>,
    to: &mut Line,
) {
    assert_eq!((from.channels, to.channels), (tiles.inputs, tiles.outputs), "channels of lines");
    let to = Shared(to.values.as_mut_ptr());
    // SAFETY: stacks are fused only where the unit is available; lines have the grid's length.
    unsafe {
        match units {
            #[cfg(all(not(test), target_arch = "x86_64"))]
            MatrixUnits::Amx => {
                unit::convolve(grid, from, tiles, finish, to, super::amx::band);
            }
            #[cfg(all(not(test), target_arch = "x86_64"))]
            MatrixUnits::Avx512Bf16 => {
                unit::convolve(grid, from, tiles, finish, to, super::vectors::band);
            }
            _ => {
                unit::convolve(grid, from, tiles, finish, to, unit::convolve_band::<unit::Model>);
            }
        }
    }
}

/// Correlates inputs with a gradient on one of this machine's units.
pub(super) fn correlate(
    units: MatrixUnits,
    grid: &Grid,
    inputs: &Line,
    gradient: &Line,
) -> Gradient {
    // SAFETY: as in `convolve_into`.
    unsafe {
        match units {
            #[cfg(all(not(test), target_arch = "x86_64"))]
            MatrixUnits::Amx => unit::correlate(grid, inputs, gradient, super::amx::chunk),
            #[cfg(all(not(test), target_arch = "x86_64"))]
            MatrixUnits::Avx512Bf16 => {
                unit::correlate(grid, inputs, gradient, super::vectors::chunk)
            }
            _ => unit::correlate(grid, inputs, gradient, unit::add_chunk::<unit::Model>),
        }
    }
}

/// Computes the features, `[images, features, height, width]`, and the activations that the gradient needs,
/// if `keeps` says so.
pub(super) fn forward(
    stack: &Stack,
    inputs: &[&[f32]],
    parameters: &[f32],
    keeps: bool,
) -> (Vec<f32>, Arc<Activations>) {
    let convolutions = convolutions(stack, parameters);
    let tiles = stack.packed.forward(&convolutions);
    let groups = groups(stack);
    let images = groups[0].images;
    let group_size = images * stack.features * stack.height * stack.width;
    let mut results = Vec::new();
    let length = stack.images * stack.features * stack.height * stack.width;
    let output = written(length, |output| {
        let work = |(number, (output, group)): (usize, (&mut [f32], &Stack))| {
            let inputs = inputs.iter().zip(&stack.inputs).map(|(values, &channels)| {
                (of_group(values, group, number * images, channels), channels)
            });
            let inputs: Vec<_> = inputs.collect();
            let activations = forward_group(group, &inputs, &convolutions, tiles);
            let last = &activations.features[stack.blocks];
            last.write_planes(&activations.grid, 0, stack.features, output);
            keeps.then_some(activations)
        };
        let parts = output.par_chunks_mut(group_size).zip(&groups).enumerate();
        results = parts.filter_map(work).collect();
    });
    (output, Arc::new(Activations(results)))
}

fn forward_group(
    stack: &Stack,
    inputs: &[(&[f32], usize)],
    convolutions: &[Parameters<'_>],
    tiles: &[Tiles],
) -> GroupActivations {
    let grid = Grid::new(stack);
    let input = Line::from_planes(&grid, inputs);
    let apply = |from: &Line, number: usize, relu: bool, addend: Option<&Line>| {
        let bias = Some(convolutions[number].bias);
        let addend = addend.map(|line| line.values.as_ptr());
        convolve(
            stack.units,
            &grid,
            from,
            &tiles[number],
            Finish { bias, addend, relu, mask: None },
        )
    };
    let mut features = vec![apply(&input, 0, stack.rectifies(), None)];
    let mut hidden = Vec::with_capacity(stack.blocks);
    for block in 0..stack.blocks {
        let x = &features[block];
        let between = apply(x, 1 + 2 * block, true, None);
        let next = apply(&between, 2 + 2 * block, false, Some(x));
        hidden.push(between);
        features.push(next);
    }
    GroupActivations { grid, input, features, hidden }
}
