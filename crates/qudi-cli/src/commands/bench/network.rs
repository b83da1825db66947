//! `qudi bench --preset`: speed, memory and size of networks with random weights, by block.

use super::args::Bench;
use super::burst::{burst, median};
use crate::device::{self, Opened};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::memory::PeakMemory;
use crate::methods::network::sample_options;
use crate::report::{Bar, Report};
use burn::tensor::{Device, Tensor};
use qudi_core::Size;
use qudi_core::restorer::{BurstView, Restorer};
use qudi_model::checkpoint::ModelKind;
use qudi_model::conditioning::{AlignedTensors, Conditioning, SENSOR_NUMBERS};
use qudi_model::config::{NetworkConfig, ReferenceKind};
use qudi_model::diffusion::state::DiffusionState;
use qudi_model::network::{Qudi, Simulated};
use qudi_model::restorer::{Model, QudiRestorer, SampleOptions};
use qudi_model::{ComputePrecision, with_precision};
use qudi_train::loss::reconstruction;
use serde::Serialize;
use serde_json::json;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::time::Instant;

/// Frame size of the training step that is timed.
const CROP: Size = Size { height: 128, width: 128 };

/// Figures of one network.
#[derive(Debug, Serialize)]
struct Figures {
    preset: String,
    parameters: usize,
    /// Floating-point operations of all convolutions, for one frame and one step that estimates the flow.
    gflop_per_frame_step: f64,
    /// Median seconds of one reverse step over all frames, flow included.
    step: f64,
    /// The fastest.
    step_fastest: f64,
    /// Median seconds of every block in such a step.
    blocks: BTreeMap<&'static str, f64>,
    /// Median seconds of what is computed once for all steps.
    prepare: f64,
    /// Seconds of the whole restoration, sampling and simulated measurements included.
    restore: f64,
    /// Its peak memory above what the process held before, in MiB.
    peak_mib: Option<f64>,
    /// Median seconds of a forward and backward pass on frames of 128 x 128.
    forward_backward: f64,
}

pub(crate) fn run(args: &Bench, report: &Report) -> Result<()> {
    if args.rounds == 0 || args.frames < 3 {
        let help = "ask for at least 1 round of 3 frames";
        return Err(CliError::new("nothing to measure", "--rounds, --frames", help));
    }
    let options = args.network.options(args.steps.steps, &args.given);
    options.check_weights(&[])?;
    let device = device::open(&options.device)?;
    let (steps, sampling) = (options.steps()?, sample_options(&options, &device)?);
    let precision = sampling.precision;
    let mut bar = report.bar();
    let mut all = Vec::new();
    for preset in &args.preset {
        let config = NetworkConfig::preset(preset)?;
        let figures = with_precision(precision, || {
            measure(preset, config, args, sampling, &device, &mut bar)
        })?;
        all.push(figures);
    }
    drop(bar);
    report.result(&describe(&all, args, steps, precision, &device), || {
        json!({
            "program": format!("qudi {}", env!("CARGO_PKG_VERSION")),
            "device": device.name,
            "precision": precision,
            "threads": rayon::current_num_threads(),
            "height": args.size.height,
            "width": args.size.width,
            "frames": args.frames,
            "rounds": args.rounds,
            "steps": steps,
            "networks": all,
        })
    })
}

fn measure(
    preset: &str,
    config: NetworkConfig,
    args: &Bench,
    sampling: SampleOptions,
    device: &Opened,
    bar: &mut Bar,
) -> Result<Figures> {
    let network = config.init(1, &device.device);
    let of_step = inputs(&config, args.size, args.frames, &device.device);
    let (mut steps, mut prepares) = (Vec::new(), Vec::new());
    let mut blocks: BTreeMap<&'static str, Vec<f64>> = BTreeMap::new();
    // The first round warms up and is not counted.
    for round in 0..=args.rounds {
        bar.update("measuring", round as u64, Some(2 * args.rounds as u64 + 3));
        if interrupt::check().is_break() {
            return Err(CliError::Interrupted);
        }
        let times = step(&network, &of_step, &device.device);
        if round > 0 {
            prepares.push(times[0].1);
            steps.push(times[1..].iter().map(|(_, seconds)| seconds).sum());
            for &(block, seconds) in &times[1..] {
                blocks.entry(block).or_default().push(seconds);
            }
        }
    }
    let mut training = Vec::new();
    let autodiff = device.device.clone().autodiff();
    let differentiable = config.init(1, &autodiff);
    let of_pass = inputs(&config, CROP, args.frames, &autodiff);
    for round in 0..=args.rounds {
        bar.update("measuring", (args.rounds + 1 + round) as u64, Some(2 * args.rounds as u64 + 3));
        if interrupt::check().is_break() {
            return Err(CliError::Interrupted);
        }
        let seconds = forward_backward(&differentiable, &of_pass, &autodiff);
        if round > 0 {
            training.push(seconds);
        }
    }
    drop((differentiable, of_step));
    let (counts, acquisition) = burst(args)?;
    // Initial weights change nothing in the U-Net; its time is measured all the same.
    let kind = ModelKind::Diffusion;
    let model = Model { network, config: config.clone(), kind, window: args.frames };
    let mut restorer = QudiRestorer::new(model, sampling, &device.device)?;
    let peak = PeakMemory::start();
    let start = Instant::now();
    restorer.restore(BurstView { size: args.size, frames: &counts }, &acquisition)?;
    let restore = start.elapsed().as_secs_f64();
    let fastest = steps.iter().copied().fold(f64::MAX, f64::min);
    Ok(Figures {
        preset: preset.to_owned(),
        parameters: config.parameters(&device.device),
        gflop_per_frame_step: 2e-9
            * config.multiplications(args.size, args.frames, &device.device) as f64
            / args.frames as f64,
        step: median(steps),
        step_fastest: fastest,
        blocks: blocks.into_iter().map(|(block, times)| (block, median(times))).collect(),
        prepare: median(prepares),
        restore,
        peak_mib: peak.grown_mib(),
        forward_backward: median(training),
    })
}

type Inputs = (Conditioning, Simulated, DiffusionState);

/// Makes inputs of a step; values do not matter for speed.
fn inputs(config: &NetworkConfig, size: Size, frames: usize, device: &Device) -> Inputs {
    let image = || Tensor::<4>::ones([frames, 1, size.height, size.width], device) * 0.5;
    let sensor = Tensor::ones([1, SENSOR_NUMBERS], device);
    let neighbours = config.pre.aligned_neighbours().count();
    let aligned = (config.reference != ReferenceKind::None).then(|| AlignedTensors {
        reference: image(),
        merged: image(),
        noise_sigma: image(),
        counts: image().repeat_dim(1, 1 + neighbours),
        expected: (neighbours > 0).then(|| image().repeat_dim(1, neighbours)),
    });
    let (counts, linear_estimate) = (image(), image());
    let conditioning = Conditioning { counts, linear_estimate, aligned, sensor, frames };
    let simulated = Simulated { y: image(), u: image(), exists: vec![true] };
    let (has_previous, timesteps) = (vec![true], vec![500]);
    let state = DiffusionState { x_t: image(), x0_prev: image(), has_previous, timesteps };
    (conditioning, simulated, state)
}

/// Measures the preparation and every block of one step, in seconds.
fn step(network: &Qudi, inputs: &Inputs, device: &Device) -> Vec<(&'static str, f64)> {
    let (conditioning, simulated, state) = inputs;
    let mut last = Instant::now();
    let mut times = Vec::new();
    let mut mark = |block: &'static str| {
        // A device that fails here fails at the next read, with words.
        let _ = device.sync();
        times.push((block, last.elapsed().as_secs_f64()));
        last = Instant::now();
    };
    let encoded = network.encode(conditioning);
    mark("prepare");
    let (fused, _) = network.fuse(&encoded, Some(simulated), state, None, &mut mark);
    network.predict(&fused);
    mark("unet");
    times
}

fn forward_backward(network: &Qudi, inputs: &Inputs, device: &Device) -> f64 {
    let (conditioning, simulated, state) = inputs;
    let frames = conditioning.frames;
    let truth = Tensor::<4>::zeros([frames, 1, CROP.height, CROP.width], device);
    let start = Instant::now();
    let encoded = network.encode(conditioning);
    let prediction = network.forward(&encoded, Some(simulated), state, None);
    let loss = reconstruction((prediction.x0 + 1.0) * 0.5, truth.clone())
        + reconstruction(prediction.d, truth) * 0.2;
    let _grads = loss.backward();
    let _ = device.sync();
    start.elapsed().as_secs_f64()
}

fn describe(
    all: &[Figures],
    args: &Bench,
    steps: usize,
    precision: ComputePrecision,
    device: &Opened,
) -> String {
    let mut text = format!(
        "{:<12}{:>12}{:>13}{:>9}{:>10}{:>10}{:>10}{:>11}\n",
        "preset",
        "parameters",
        "GFLOP/frame",
        "s/step",
        "GFLOP/s",
        "s/burst",
        "peak MiB",
        "fwd+bwd s"
    );
    for f in all {
        let rate = f.gflop_per_frame_step * args.frames as f64 / f.step;
        let peak = f.peak_mib.map_or("-".to_owned(), |mib| format!("{mib:.0}"));
        let _ = writeln!(
            text,
            "{:<12}{:>12}{:>13.2}{:>9.3}{rate:>10.1}{:>10.2}{peak:>10}{:>11.3}",
            f.preset, f.parameters, f.gflop_per_frame_step, f.step, f.restore, f.forward_backward
        );
    }
    text.push('\n');
    for f in all {
        let _ = write!(text, "{:<12}ms: prepare {:.1}", f.preset, 1e3 * f.prepare);
        for (block, seconds) in &f.blocks {
            let _ = write!(text, ", {block} {:.1}", 1e3 * seconds);
        }
        text.push('\n');
    }
    let _ = writeln!(
        text,
        "\n{} frames of {}, {} steps, on {}, {} threads, {}; medians of {} rounds after one of warm-up; \
         forward and backward on {CROP}",
        args.frames,
        args.size,
        steps,
        device.name,
        rayon::current_num_threads(),
        precision,
        args.rounds
    );
    text
}
