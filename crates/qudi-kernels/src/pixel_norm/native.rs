//! The scaling on slices of memory.

use crate::uninitialised::written;
use rayon::prelude::*;

/// Pixels that are scaled together: their sums stay in registers and the nearest cache.
const PIXELS: usize = 256;

/// Calls `work` for the pixels of every image, with ranges of at most [`PIXELS`] pixels of a plane.
fn for_pixels(
    [_, channels, height, width]: [usize; 4],
    result: &mut [f32],
    work: impl Fn(usize, std::ops::Range<usize>, &mut [f32]) + Sync,
) {
    let plane = height * width;
    let images = result.par_chunks_exact_mut(channels * plane).enumerate();
    images.for_each(|(image, result)| {
        for first in (0..plane).step_by(PIXELS) {
            work(image, first..(first + PIXELS).min(plane), result);
        }
    });
}

/// Computes [`pixel_norm`](super::pixel_norm).
pub(super) fn forward(x: &[f32], shape: [usize; 4], floor: f32) -> Vec<f32> {
    let [_, channels, height, width] = shape;
    let plane = height * width;
    written(x.len(), |result| {
        for_pixels(shape, result, |image, pixels, result| {
            let x = &x[image * channels * plane..][..channels * plane];
            let sizes = sizes(x, plane, pixels.clone(), floor);
            for (to, x) in result.chunks_exact_mut(plane).zip(x.chunks_exact(plane)) {
                let values = to[pixels.clone()].iter_mut().zip(&x[pixels.clone()]);
                values.zip(&sizes).for_each(|((to, x), size)| *to = x / size);
            }
        });
    })
}

/// Computes the gradient for `x`.
pub(super) fn gradient(x: &[f32], gradient: &[f32], shape: [usize; 4], floor: f32) -> Vec<f32> {
    let [_, channels, height, width] = shape;
    let plane = height * width;
    written(x.len(), |result| {
        for_pixels(shape, result, |image, pixels, result| {
            let image = image * channels * plane..(image + 1) * channels * plane;
            let (x, gradient) = (&x[image.clone()], &gradient[image]);
            let sizes = sizes(x, plane, pixels.clone(), floor);
            // The mean of x times gradient, over the third power of the size.
            let mut shares = [0.0; PIXELS];
            for (x, gradient) in x.chunks_exact(plane).zip(gradient.chunks_exact(plane)) {
                let products = x[pixels.clone()].iter().zip(&gradient[pixels.clone()]);
                shares.iter_mut().zip(products).for_each(|(sum, (x, g))| *sum += x * g);
            }
            for (share, size) in shares.iter_mut().zip(&sizes) {
                *share /= channels as f32 * size * size * size;
            }
            let planes = x.chunks_exact(plane).zip(gradient.chunks_exact(plane));
            for (to, (x, gradient)) in result.chunks_exact_mut(plane).zip(planes) {
                let values = x[pixels.clone()].iter().zip(&gradient[pixels.clone()]);
                let values = values.zip(sizes.iter().zip(&shares));
                for (to, ((x, g), (size, share))) in to[pixels.clone()].iter_mut().zip(values) {
                    *to = g / size - x * share;
                }
            }
        });
    })
}

/// Returns the root of the mean square of every pixel, with the floor; ones after the last pixel.
fn sizes(x: &[f32], plane: usize, pixels: std::ops::Range<usize>, floor: f32) -> [f32; PIXELS] {
    let channels = (x.len() / plane) as f32;
    let mut sizes = [0.0; PIXELS];
    for x in x.chunks_exact(plane) {
        sizes.iter_mut().zip(&x[pixels.clone()]).for_each(|(sum, x)| *sum += x * x);
    }
    sizes.map(|sum| (sum / channels + floor).sqrt())
}
