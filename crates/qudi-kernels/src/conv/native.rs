//! Convolution and its gradients on slices of memory.
#![allow(unsafe_code)]

use super::geometry::Geometry;
use super::pass::Pass;
use super::run::{Finish, Packed, Target, run};
use super::scratch::Format;
use super::source::Source;
use super::weight_gradient::{WeightGradient, weight_gradient};
use super::winograd;

/// Computes the output `[images, outputs, rows, columns]`. Inputs are `[images, channels, height, width]`,
/// followed by the addend if there is one; weights are `[outputs, channels, frames, rows, columns]`.
pub(crate) fn forward(
    geometry: &Geometry,
    inputs: &[&[f32]],
    weight: &[f32],
    bias: &[f32],
) -> Vec<f32> {
    let addend = geometry.addend.then(|| inputs[inputs.len() - 1]);
    let geometry = &geometry.flattened();
    let pass = Pass::forward(geometry);
    let planes = geometry.all_channels() * geometry.kernel[0];
    let taps = pass.taps.len();
    let weight = |output, plane, tap| weight[(output * planes + plane) * taps + tap];
    let inputs = with_channels(inputs, geometry);
    let source = Source { inputs: &inputs, ..source(geometry) };
    let [rows, columns] = pass.grid;
    let mut parts = [(Vec::new(), geometry.outputs)];
    let target = Target::new(&mut parts, geometry.images, rows, columns);
    let finish = Finish { bias: Some(bias), addend, relu: geometry.relu };
    correlate(source, geometry, &pass, [geometry.outputs, planes], weight, finish, &target);
    // SAFETY: the pass covers the whole grid.
    let [(output, _)] = unsafe { written(parts, geometry.images * rows * columns) };
    output
}

/// Computes the gradient of each input, without the addend's; `output` is the result of [`forward`], given
/// where it has a ReLU.
pub(crate) fn input_gradients(
    geometry: &Geometry,
    weight: &[f32],
    gradient: &[f32],
    output: Option<&[f32]>,
) -> Vec<Vec<f32>> {
    let geometry = &geometry.flattened();
    let [depth, kernel_rows, kernel_columns] = geometry.kernel;
    let channels = geometry.all_channels();
    let inputs = [(gradient, geometry.outputs)];
    let [height, width] = geometry.output_grid();
    let source = Source { inputs: &inputs, mask: output, height, width, ..source(geometry) };
    let mut parts: Vec<_> = geometry.channels.iter().map(|&c| (Vec::new(), c)).collect();
    let target = Target::new(&mut parts, geometry.images, geometry.height, geometry.width);
    for parity in 0..geometry.stride * geometry.stride {
        let parity = [parity / geometry.stride, parity % geometry.stride];
        let Some((pass, kernel)) = Pass::backward(geometry, parity) else { continue };
        let planes = geometry.outputs * depth;
        let weight = |channel, plane, tap: usize| {
            let (output, frame) = (plane / depth, depth - 1 - plane % depth);
            let [y, x] = kernel[tap];
            let plane = (output * channels + channel) * depth + frame;
            weight[(plane * kernel_rows + y) * kernel_columns + x]
        };
        let finish = Finish { bias: None, addend: None, relu: false };
        correlate(source, geometry, &pass, [channels, planes], weight, finish, &target);
    }
    // SAFETY: the passes of all parities cover the whole grid.
    let parts = unsafe { written(parts, geometry.images * geometry.height * geometry.width) };
    parts.into_iter().map(|(part, _)| part).collect()
}

/// Correlates `source` with `weight(output, plane, tap)` in the way that takes fewest instructions.
fn correlate(
    source: Source<'_>,
    geometry: &Geometry,
    pass: &Pass,
    [outputs, planes]: [usize; 2],
    weight: impl Fn(usize, usize, usize) -> f32 + Sync,
    finish: Finish<'_>,
    target: &Target,
) {
    if winograd::serves(pass, Format::new(geometry.bf16, planes), planes, outputs) {
        let packed = winograd::Packed::new(pass, outputs, planes, weight);
        winograd::run(source, geometry.images, &packed, finish, target);
    } else {
        let packed = Packed::new(pass, geometry.bf16, outputs, planes, weight);
        run(source, geometry.images, pass, &packed, finish, target);
    }
}

/// Computes the gradient of the addend.
pub(super) fn addend_gradient(gradient: &[f32], output: &[f32]) -> Vec<f32> {
    let pairs = gradient.iter().zip(output);
    pairs.map(|(&gradient, &output)| if output > 0.0 { gradient } else { 0.0 }).collect()
}

/// Computes the gradients of weights and bias.
pub(crate) fn weight_gradients(
    geometry: &Geometry,
    inputs: &[&[f32]],
    gradient: &[f32],
    output: Option<&[f32]>,
) -> WeightGradient {
    let geometry = &geometry.flattened();
    let pass = Pass::forward(geometry);
    let planes = geometry.all_channels() * geometry.kernel[0];
    let inputs = with_channels(inputs, geometry);
    let values = Source { inputs: &inputs, ..source(geometry) };
    let [height, width] = pass.grid;
    let gradient = [(gradient, geometry.outputs)];
    let gradient =
        Source { inputs: &gradient, mask: output, height, width, depth: 1, ..source(geometry) };
    let sizes = [planes, geometry.images, geometry.outputs];
    weight_gradient(values, sizes, &pass, gradient, geometry.bf16)
}

fn with_channels<'a>(inputs: &[&'a [f32]], geometry: &Geometry) -> Vec<(&'a [f32], usize)> {
    inputs.iter().copied().zip(geometry.channels.iter().copied()).collect()
}

/// Creates a source of the geometry's size without inputs.
fn source(geometry: &Geometry) -> Source<'_> {
    Source {
        inputs: &[],
        mask: None,
        frames: geometry.frames,
        height: geometry.height,
        width: geometry.width,
        depth: geometry.kernel[0],
    }
}

/// Converts the parts to initialised vectors.
///
/// # Safety
/// All values of all parts must have been written; `plane` is the number of values per channel.
unsafe fn written<P: AsMut<[(Vec<f32>, usize)]>>(mut parts: P, plane: usize) -> P {
    for (part, channels) in parts.as_mut() {
        // SAFETY: the caller's promise; the capacity was reserved by `Target::new`.
        unsafe { part.set_len(plane * *channels) };
    }
    parts
}

impl Geometry {
    /// Converts the convolution to one with a single row, if its taps do not reach past their own pixel.
    fn flattened(&self) -> Self {
        let mut flat = self.clone();
        if self.kernel[1..] == [1, 1] && self.stride == 1 {
            (flat.height, flat.width) = (1, self.height * self.width);
        }
        flat
    }
}
