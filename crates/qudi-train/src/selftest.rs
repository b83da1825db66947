//! What a device must get right: every operation of the network with its gradients, and three small
//! networks whole.

use crate::loss::reconstruction;
use burn::tensor::activation::softmax;
use burn::tensor::ops::PadMode;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::Result;
use qudi_kernels::conv::{Activation, Options, conv_2d, conv_3d};
use qudi_kernels::group_norm::{self, Norm, group_norm};
use qudi_kernels::{
    ComputePrecision, tv_flow, warp, warp_cubic, with_precision, with_stock_operations,
};
use qudi_layers::init_parameters;
use qudi_layers::tensor::read;
use qudi_model::aligned::Aligned;
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::schedule::NoiseSchedule;
use qudi_model::diffusion::state::DiffusionState;
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::diffusion::{Conditioning, Simulated};
use qudi_model::regression::{FirstFrames, RegressionConfig};
use qudi_model::sensor::{RESPONSE_LEVELS, SENSOR_NUMBERS};
use qudi_model::window::WindowConfig;

/// Largest error that is rounding: networks add up the errors of dozens of layers in f32.
pub const TOLERANCE: f32 = 2e-3;

/// Largest error that is rounding where the numbers that are multiplied have eight bits.
pub const BF16_TOLERANCE: f32 = 2e-2;

/// How much larger errors are where sums have no more bits than what is multiplied.
const SUMS: f32 = 10.0;

/// The verdict on an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Rounding.
    Right,
    /// Rounding, also of sums: kernels of Burn 0.22 that multiply numbers of 16 bits may sum in 16 bits, too.
    Rough,
    /// More than rounding.
    Wrong,
}

/// One check.
#[derive(Clone, Copy, Debug)]
pub struct Check {
    /// What is checked.
    pub name: &'static str,
    /// Numbers that convolutions multiply on the device; the reference's have 32 bits.
    precision: ComputePrecision,
    run: fn(&Device) -> Result<Vec<Vec<f32>>>,
}

impl Check {
    const fn exact(name: &'static str, run: fn(&Device) -> Result<Vec<Vec<f32>>>) -> Self {
        Self { name, precision: ComputePrecision::F32, run }
    }

    const fn reduced(
        name: &'static str,
        precision: ComputePrecision,
        run: fn(&Device) -> Result<Vec<Vec<f32>>>,
    ) -> Self {
        Self { name, precision, run }
    }

    /// Returns true if the device has such numbers at all.
    pub fn is_possible(&self, device: &Device) -> bool {
        self.precision.is_supported(device)
    }

    /// Returns the verdict on an error.
    pub fn verdict(&self, error: f32) -> Verdict {
        let (right, rough) = match self.precision {
            ComputePrecision::F32 => (TOLERANCE, TOLERANCE),
            ComputePrecision::Bf16 => (BF16_TOLERANCE, SUMS * BF16_TOLERANCE),
        };
        if error < right {
            Verdict::Right
        } else if error < rough {
            Verdict::Rough
        } else {
            Verdict::Wrong
        }
    }

    /// Computes the largest difference between the device's results and the results of Burn's stock
    /// operations on `reference`, in terms of the largest value.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if a device fails.
    pub fn error(&self, device: &Device, reference: &Device) -> Result<f32> {
        let got = with_precision(self.precision, || (self.run)(device))?;
        let expected = with_stock_operations(|| (self.run)(reference))?;
        let mut worst = 0f32;
        for (got, expected) in got.iter().zip(&expected) {
            let scale = expected.iter().fold(1e-6f32, |scale, value| scale.max(value.abs()));
            for (got, expected) in got.iter().zip(expected) {
                let error = (got - expected).abs() / scale;
                // NaN is an error, too.
                worst = if error <= worst { worst } else { error };
                if error.is_nan() {
                    return Ok(f32::INFINITY);
                }
            }
        }
        Ok(worst)
    }
}

/// All checks, cheap ones first.
pub const CHECKS: &[Check] = &[
    Check::exact("arithmetic", arithmetic),
    Check::exact("joining and slicing", joining),
    Check::exact("warp", warping),
    Check::exact("cubic warp", cubic_warping),
    Check::exact("TV-L1 flow", refining_flow),
    Check::exact("group norm", normalising),
    Check::exact("matrix product", products),
    Check::exact("softmax", attention),
    Check::exact("convolution 3x3", |device| convolution(device, 3, 1)),
    Check::exact("convolution 1x1", |device| convolution(device, 1, 1)),
    Check::exact("convolution 7x7", |device| convolution(device, 7, 1)),
    Check::exact("convolution, stride 2", |device| convolution(device, 3, 2)),
    Check::exact("convolution 5x5x5", |device| convolution_3d(device, 1)),
    Check::exact("convolution 5x5x5 / 2", |device| convolution_3d(device, 2)),
    Check::reduced("convolution 3x3, bf16", ComputePrecision::Bf16, linear),
    Check::reduced("convolution 5x5x5, bf16", ComputePrecision::Bf16, |device| {
        convolution_3d(device, 1)
    }),
    Check::exact("regression", regression),
    Check::exact("diffusion", diffusion),
    Check::exact("window", window),
];

/// Repeatable values in [-1, 1).
fn values<const D: usize>(seed: u32, shape: [usize; D], device: &Device) -> Tensor<D> {
    let mut state = seed.wrapping_mul(0x9E37_79B9) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state as f32 / 2f32.powi(31) - 1.0
    };
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| next()).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// Returns the result, and the gradients of a weighted sum of it.
fn with_gradients<const D: usize>(
    output: Tensor<D>,
    inputs: &[Tensor<D>],
) -> Result<Vec<Vec<f32>>> {
    let weights = values(99, output.dims(), &output.device());
    let grads = (output.clone() * weights).sum().backward();
    let mut results = vec![read(output.inner())?];
    for input in inputs {
        results.push(input.grad(&grads).map_or(Ok(vec![f32::NAN]), read)?);
    }
    Ok(results)
}

fn arithmetic(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let a = values(1, [2, 3, 5, 7], &device).require_grad();
    let b = values(2, [2, 3, 5, 7], &device).require_grad();
    let positive = b.clone() * b.clone() + 0.1;
    let output = (a.clone() * 2.0 - b.clone()) / positive.clone().sqrt()
        + a.clone().abs() * burn::tensor::activation::silu(b.clone())
        + burn::tensor::activation::relu(a.clone())
        + (b.clone().clamp_min(0.0) * -0.5).exp() * positive.recip() * a.clone().clamp(-0.5, 0.5);
    with_gradients(output, &[a, b])
}

fn joining(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let a = values(3, [2, 3, 4, 6], &device).require_grad();
    let b = values(4, [2, 2, 4, 6], &device).require_grad();
    let joined = Tensor::cat(vec![a.clone(), b.clone()], 1).narrow(1, 1, 3);
    let joined = joined.pad([(0, 0), (0, 0), (1, 1), (2, 4)], PadMode::Edge);
    let folded = joined.reshape([2, 3, 3, 2, 6, 2]).permute([0, 1, 3, 5, 2, 4]);
    with_gradients(folded.reshape([2, 12, 3, 6]), &[a, b])
}

fn warping(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let x = values(5, [2, 3, 12, 20], &device).require_grad();
    let flow = (values(6, [2, 2, 12, 20], &device) * 3.3).require_grad();
    with_gradients(warp(x.clone(), flow.clone()), &[x, flow])
}

fn cubic_warping(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let x = values(5, [2, 3, 12, 20], &device).require_grad();
    let flow = values(6, [2, 2, 12, 20], &device) * 3.3;
    with_gradients(warp_cubic(x.clone(), flow), &[x])
}

fn refining_flow(device: &Device) -> Result<Vec<Vec<f32>>> {
    let image = |seed| values(seed, [2, 1, 12, 20], device) * 0.2 + 0.5;
    let start = values(20, [2, 2, 12, 20], device) * 0.5;
    Ok(vec![read(tv_flow(image(18), image(19), start))?])
}

fn normalising(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let x = values(7, [4, 12, 6, 10], &device).require_grad();
    let weight = values(8, [2, 12], &device) + 1.5;
    let bias = values(9, [2, 12], &device);
    let norm = Norm { groups: 6, activation: group_norm::Activation::Silu };
    with_gradients(group_norm(x.clone(), weight, bias, norm), &[x])
}

fn products(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let a = values(10, [3, 17, 33], &device).require_grad();
    let b = values(11, [3, 33, 9], &device).require_grad();
    with_gradients(a.clone().matmul(b.clone()), &[a, b])
}

fn attention(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let x = (values(12, [3, 40, 40], &device) * 4.0).require_grad();
    with_gradients(softmax(x.clone(), 2), &[x])
}

fn convolution(device: &Device, kernel: usize, stride: usize) -> Result<Vec<Vec<f32>>> {
    let options = Options { stride, activation: Activation::Relu, ..Options::default() };
    convolution_with(device, kernel, options)
}

/// Without a ReLU: what is rounded may be on its other side.
fn linear(device: &Device) -> Result<Vec<Vec<f32>>> {
    convolution_with(device, 3, Options::default())
}

fn convolution_with(device: &Device, kernel: usize, options: Options) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let x = values(13, [2, 6, 24, 36], &device).require_grad();
    let weight = values(14, [8, 6, kernel, kernel], &device).require_grad();
    let bias = values(15, [8], &device);
    let output = conv_2d(std::slice::from_ref(&x), weight.clone(), bias, options);
    with_gradients(output, &[x, weight])
}

fn convolution_3d(device: &Device, stride: usize) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let x = values(16, [5, 4, 16, 24], &device).require_grad();
    let weight = values(17, [6, 4, 5, 5, 5], &device);
    let options = Options { stride, ..Options::default() };
    let output = conv_3d(std::slice::from_ref(&x), weight, values(18, [6], &device), 5, options);
    with_gradients(output, &[x])
}

/// Images in [0, 1) of a burst of four frames.
fn image(seed: u32, device: &Device) -> Tensor<4> {
    values(seed, [4, 1, 32, 48], device) * 0.5 + 0.5
}

/// Runs a small regression: frames, uncertainty, and the loss's gradient for the merged frames.
fn regression(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let config = RegressionConfig {
        fold: 2,
        width: 16,
        blocks: 2,
        growth: 8,
        neighbours: 4,
        weight_channels: 4,
        first: FirstFrames::default(),
    };
    let neighbours = config.second_neighbours().count() as u32;
    let planes = |first| (first..).map(|seed| image(seed, &device));
    let merged = image(30, &device).require_grad();
    let aligned = Aligned {
        reference: image(29, &device),
        merged: merged.clone(),
        noise_sigma: image(31, &device) * 0.5 + 0.2,
        counts: planes(32).take(1 + neighbours as usize).collect(),
        expected: planes(100).take(neighbours as usize).collect(),
    };
    // Initial weights change nothing.
    let network = init_parameters(config.uninitialized(&device), |_, shape| {
        (0..shape.iter().product()).map(|i: usize| 0.05 * (i as f32).sin()).collect()
    });
    let (frames, sigma) = network.predenoise(&aligned);
    let loss = reconstruction(frames.clone(), image(28, &device));
    let grads = loss.backward();
    Ok(vec![
        read(frames.inner())?,
        read(sigma.inner())?,
        merged.grad(&grads).map_or(Ok(vec![f32::NAN]), read)?,
    ])
}

/// Sizes of a small diffusion.
const DIFFUSION: &str = r#"
[network]
kind = "diffusion"
fold = 2
pre = { width = 16, blocks = 2, growth = 8 }
features = { low = [8, 8, 8], high = [4, 6, 8] }
flow = { scale = 2, levels = 3, networks = 3, widths = [8, 16, 8, 8], steps = [1, 3, 6] }
fusion = { level = 1, widths = [16, 16, 16], growth = 8 }
unet = { width = 16, multipliers = [1, 2, 2], blocks = 1, attention = [], embedding = 32, predicts = "correction" }
"#;

/// Runs a small diffusion on a burst of four frames: prediction, pre-denoised frames, flows,
/// and the loss's gradient for the noisy image.
fn diffusion(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let NetworkConfig::Diffusion(config) = NetworkConfig::parse(DIFFUSION, "self-test")? else {
        unreachable!("its kind is diffusion")
    };
    let network = config.init(1, &device);
    let image = |seed| image(seed, &device);
    let conditioning = Conditioning {
        counts: image(21) * 0.5,
        linear_estimate: image(22),
        sensor: values(23, [1, SENSOR_NUMBERS], &device),
        response: values(53, [1, RESPONSE_LEVELS], &device),
        frames: 4,
        motion: Vec::new(),
    };
    let simulated = Simulated { y: image(24), u: image(25), exists: vec![true] };
    let x_t = values(26, [4, 1, 32, 48], &device).require_grad();
    let x0_prev = values(27, [4, 1, 32, 48], &device);
    let (has_previous, timesteps) = (vec![true], vec![500]);
    let state = DiffusionState { x_t: x_t.clone(), x0_prev, has_previous, timesteps };
    let encoded = network.encode(&conditioning);
    let prediction = network.forward(&encoded, Some(&simulated), &state, None);
    let loss = reconstruction((prediction.x0.clone() + 1.0) * 0.5, image(28));
    let grads = loss.backward();
    Ok(vec![
        read(prediction.x0.inner())?,
        read(prediction.d.inner())?,
        read(prediction.flows.to_next.inner())?,
        x_t.grad(&grads).map_or(Ok(vec![f32::NAN]), read)?,
    ])
}

/// Runs a small window diffusion on a burst of four frames: prediction, learnt flow, and the loss's gradient
/// for the noisy image.
fn window(device: &Device) -> Result<Vec<Vec<f32>>> {
    let device = device.clone().autodiff();
    let config = WindowConfig {
        widths: [16; 3],
        flow: [8; 3],
        state: 16,
        cell_blocks: 1,
        linear_entries: true,
    };
    let network = config.init(1, &device);
    let image = |seed| image(seed, &device);
    let conditioning = Conditioning {
        counts: image(29) * 0.5,
        linear_estimate: image(30),
        sensor: values(31, [1, SENSOR_NUMBERS], &device),
        response: values(61, [1, RESPONSE_LEVELS], &device),
        frames: 4,
        motion: Vec::new(),
    };
    let encoded = network.encode(&conditioning, 1)?;
    let x_t = values(32, [4, 1, 32, 48], &device).require_grad();
    let x0_prev = values(33, [4, 1, 32, 48], &device);
    let (has_previous, timesteps) = (vec![true], vec![300]);
    let state = DiffusionState { x_t: x_t.clone(), x0_prev, has_previous, timesteps };
    let x0 = network.predict(&encoded, &state, &NoiseSchedule::cosine(NUM_TIMESTEPS)).x0;
    let loss = reconstruction((x0.clone() + 1.0) * 0.5, image(34));
    let grads = loss.backward();
    Ok(vec![
        read(x0.inner())?,
        read(encoded.flow[0].pairs.clone().inner())?,
        x_t.grad(&grads).map_or(Ok(vec![f32::NAN]), read)?,
    ])
}
