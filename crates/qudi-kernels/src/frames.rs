//! Single frames of bursts. The gradient of each is added to the gradient of all where it lies; Burn's slices
//! make an image of zeros for every frame, and add them all up.

#[allow(unreachable_pub)] // the macro wants public traits
mod extension;

use crate::backend::is_native;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use extension::FrameBackend;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A frame of every burst.
#[allow(unreachable_pub)] // a parameter of a public trait
#[derive(Clone, Debug)]
pub struct Frame {
    number: usize,
    /// Frames of a burst.
    count: usize,
    /// True as soon as a frame of the same images has given its gradient.
    begun: Arc<AtomicBool>,
}

/// Returns every frame of bursts of `count` frames. The gradients of all of them are computed in one backward
/// pass.
///
/// # Shapes
/// - x: `[bursts * frames, channels, height, width]`
/// - result: `[bursts, channels, height, width]` each
pub fn frames(x: &Tensor<4>, count: usize) -> Vec<Tensor<4>> {
    let [images, channels, height, width] = x.dims();
    let bursts = images / count;
    // Frames of a single burst are slices that need no copy.
    if !is_native(x) || bursts == 1 && !x.is_autodiff() {
        let whole = x.clone().reshape([bursts, count, channels, height, width]);
        let one = |number| whole.clone().narrow(1, number, 1);
        let shape = [bursts, channels, height, width];
        return (0..count).map(|number| one(number).reshape(shape)).collect();
    }
    let begun = Arc::new(AtomicBool::new(false));
    let one = |number| {
        let frame = Frame { number, count, begun: begun.clone() };
        Tensor::from_dispatch(Dispatch::frame(x.clone().into_dispatch(), frame))
    };
    (0..count).map(one).collect()
}

#[cfg(all(test, feature = "flex"))]
mod tests {
    use super::*;
    use burn::tensor::{Device, Int};

    /// Frames and their gradients equal slices and theirs, also where the images are used elsewhere.
    #[test]
    fn gradients_of_frames_add_up() {
        let device = Device::flex().autodiff();
        let shape = [6, 2, 3, 4];
        let values = || Tensor::<1, Int>::arange(0..144, &device).float();
        let run = || {
            let x = values().reshape(shape).require_grad();
            let images = x.clone() * 0.5;
            let parts = frames(&images, 3);
            let weighted = parts.iter().enumerate().map(|(k, part)| {
                let part = part.clone().powi_scalar(2) + part.clone();
                (part * (k + 1) as f32).sum()
            });
            let sum = weighted.reduce(Tensor::add).expect("frames") + images.sum() * 3.0;
            let gradient = x.grad(&sum.backward()).expect("a gradient");
            gradient.into_data().try_into_vec::<f32>().expect("numbers")
        };
        let composed = crate::with_stock_operations(run);
        let pairs = run().into_iter().zip(composed);
        pairs.for_each(|(fused, composed)| assert!((fused - composed).abs() < 1e-3));
        // Of leaves, too.
        let leaf = values().reshape(shape).require_grad();
        let [first, second, _] = frames(&leaf, 3).try_into().expect("three frames");
        let gradient = leaf.grad(&(first * 2.0 + second).sum().backward()).expect("a gradient");
        let [a, b, c] = frames(&gradient, 3).try_into().expect("three frames");
        let mean = |x: Tensor<4>| x.mean().into_scalar::<f32>();
        assert_eq!([mean(a), mean(b), mean(c)], [2.0, 1.0, 0.0]);
    }
}
