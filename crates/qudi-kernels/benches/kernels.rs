//! Benchmarks of these operations against Burn's own, both on flex, at the sizes of the recipe `small` on 11
//! frames of 256 x 256 pixels.
//!
//!     cargo bench -p qudi-kernels
#![allow(missing_docs)]

use burn::tensor::activation::{relu, silu, softmax};
use burn::tensor::module::{conv2d, conv3d};
use burn::tensor::ops::{ConvOptions, GridSampleOptions, GridSamplePaddingMode, InterpolateMode};
use burn::tensor::{Device, Tensor};
use criterion::{Criterion, criterion_group, criterion_main};
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};
use qudi_kernels::group_norm::{self, Norm, group_norm};
use qudi_kernels::{attention, warp};

const FRAMES: usize = 11;

fn tensor<const D: usize>(shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::<D>::ones(shape, device) * 0.3
}

/// Benchmarks `ours` and `burns`: forward, then with the gradients of the result's sum.
fn pair<const D: usize>(
    c: &mut Criterion,
    name: &str,
    input: [usize; 4],
    weight: [usize; D],
    ours: impl Fn(Tensor<4>, Tensor<D>) -> Tensor<4>,
    burns: impl Fn(Tensor<4>, Tensor<D>) -> Tensor<4>,
) {
    let mut group = c.benchmark_group(name);
    group.sample_size(10);
    let plain = Device::flex();
    let autodiff = Device::flex().autodiff();
    let mut run = |who: &str, f: &dyn Fn(Tensor<4>, Tensor<D>) -> Tensor<4>| {
        let (x, w) = (tensor(input, &plain), tensor(weight, &plain));
        group.bench_function(format!("{who}, forward"), |b| {
            b.iter(|| f(x.clone(), w.clone()));
        });
        let (x, w) = (tensor(input, &autodiff), tensor(weight, &autodiff));
        let (x, w) = (x.require_grad(), w.require_grad());
        group.bench_function(format!("{who}, forward and backward"), |b| {
            b.iter(|| f(x.clone(), w.clone()).sum().backward());
        });
    };
    run("ours", &ours);
    run("Burn's", &burns);
    group.finish();
}

fn convolutions(c: &mut Criterion) {
    for (name, inputs, outputs, side, kernel) in [
        ("conv 3x3, 40 to 40, 128 x 128", 40, 40, 128, 3),
        ("conv 3x3, 120 to 120, 32 x 32", 120, 120, 32, 3),
        ("conv 7x7, 16 to 32, 64 x 64", 16, 32, 64, 7),
        ("conv 1x1, 120 to 48, 128 x 128", 120, 48, 128, 1),
    ] {
        let bias = |x: &Tensor<4>| Tensor::<1>::zeros([outputs], &x.device());
        pair(
            c,
            name,
            [FRAMES, inputs, side, side],
            [outputs, inputs, kernel, kernel],
            |x, w| {
                let options = Options { activation: Activation::Relu, ..Options::default() };
                let bias = bias(&x);
                conv_2d(&[x], w, bias, options)
            },
            |x, w| {
                let padding = [kernel / 2, kernel / 2];
                let bias = bias(&x);
                relu(conv2d(x, w, Some(bias), ConvOptions::new([1, 1], padding, [1, 1], 1)))
            },
        );
    }
    pair(
        c,
        "conv 5x5x5, 8 to 16, 128 x 128",
        [FRAMES, 8, 128, 128],
        [16, 8, 5, 5, 5],
        |x, w| {
            let bias = Tensor::zeros([16], &x.device());
            conv_3d(&[x], w, bias, FRAMES, Options::default())
        },
        |x, w| {
            let bias = Tensor::zeros([16], &x.device());
            let x = x.reshape([1, FRAMES, 8, 128, 128]).swap_dims(1, 2);
            let options = ConvOptions::new([1, 1, 1], [2, 2, 2], [1, 1, 1], 1);
            let y = conv3d(x, w, Some(bias), options);
            y.swap_dims(1, 2).reshape([FRAMES, 16, 128, 128])
        },
    );
}

fn others(c: &mut Criterion) {
    pair(
        c,
        "group norm and SiLU, 40 channels, 128 x 128",
        [FRAMES, 40, 128, 128],
        [1, 40],
        |x, w| {
            let norm = Norm { groups: 8, activation: group_norm::Activation::Silu };
            group_norm(x, w.clone(), w, norm)
        },
        |x, w| {
            let grouped = x.reshape([FRAMES * 8, 5 * 128 * 128]);
            let centred = grouped.clone() - grouped.mean_dim(1);
            let variance = centred.clone().powi_scalar(2).mean_dim(1);
            let normal = (centred / (variance + 1e-5).sqrt()).reshape([FRAMES, 40, 128, 128]);
            let w = w.reshape([1, 40, 1, 1]);
            silu(normal * w.clone() + w)
        },
    );
    pair(
        c,
        "warp, 64 channels, 64 x 64",
        [FRAMES, 64, 64, 64],
        [FRAMES, 2, 64, 64],
        warp,
        |x, flow| {
            let options = GridSampleOptions::new(InterpolateMode::Bilinear)
                .with_padding_mode(GridSamplePaddingMode::Border)
                .with_align_corners(true);
            x.grid_sample_2d(flow.permute([0, 2, 3, 1]), options)
        },
    );
    pair(
        c,
        "attention, 120 channels, 32 x 32",
        [FRAMES, 360, 32, 32],
        [1],
        |x, _| attention(x),
        |x, _| {
            let qkv = x.reshape([FRAMES, 360, 1024]);
            let part = |n: usize| qkv.clone().narrow(1, n * 120, 120).swap_dims(1, 2);
            let scores = (part(0) * 0.09).matmul(part(1).swap_dims(1, 2));
            let mixed = softmax(scores, 2).matmul(part(2));
            mixed.swap_dims(1, 2).reshape([FRAMES, 120, 32, 32])
        },
    );
}

criterion_group!(benches, convolutions, others);
criterion_main!(benches);
