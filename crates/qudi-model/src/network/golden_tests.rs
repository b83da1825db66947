//! Every block, and the whole network, against PyTorch, forward and backward, on both CPU backends.
#![allow(clippy::unwrap_used)]

mod whole;

use super::flow::Flows;
use super::layers::attention::Attention;
use super::layers::embedding;
use super::normalized_input::NormalizedInput;
use super::unet::ResidualBlock;
use super::{Pyramid, former_name, init_parameters};
use crate::cases::{Case, File, parameter};
use crate::conditioning::AlignedTensors;
use crate::config::{NetworkConfig, UNetPrediction};
use crate::diffusion::precondition::Preconditioned;
use crate::diffusion::state::DiffusionState;
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::activation::silu;
use burn::tensor::{Device, Gradients, Tensor};
use qudi_layers::DenseBlock;
use qudi_layers::resample;

fn devices() -> [Device; 2] {
    #[allow(deprecated)] // asked for by name
    let ndarray = Device::ndarray();
    [Device::flex().autodiff(), ndarray.autodiff()]
}

/// The large cases: minutes on ndarray.
fn flex() -> Device {
    Device::flex().autodiff()
}

fn config(case: &Case<'_>) -> NetworkConfig {
    let config: NetworkConfig = serde_json::from_value(case.about["config"].clone()).unwrap();
    config.checked().unwrap()
}

/// The module with the reference's weights.
fn weighted<M: Module>(module: M, prefix: &str) -> M {
    init_parameters(module, |name, shape| reference_parameter(&format!("{prefix}.{name}"), shape))
}

/// The reference knows parameters by their former names.
fn reference_parameter(name: &str, shape: &[usize]) -> Vec<f32> {
    parameter(&former_name(name), shape)
}

/// The planes of a reference case: three images, `K + 1` counts, `K` expectations.
fn aligned(planes: &Tensor<4>) -> AlignedTensors {
    let neighbours = (planes.dims()[1] - 4) / 2;
    let part = |first, count| planes.clone().narrow(1, first, count);
    AlignedTensors {
        reference: part(0, 1),
        merged: part(1, 1),
        noise_sigma: part(2, 1),
        counts: part(3, 1 + neighbours),
        expected: (neighbours > 0).then(|| part(4 + neighbours, neighbours)),
    }
}

fn normalized(planes: &Tensor<4>) -> NormalizedInput {
    NormalizedInput::aligned(&aligned(planes))
}

/// Compares the gradients of all parameters; none may be missing.
struct Compare<'a> {
    case: &'a Case<'a>,
    grads: &'a Gradients,
    path: Vec<String>,
}

impl ModuleVisitor for Compare<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let name = former_name(&self.path.join("."));
        let grad = param.val().grad(self.grads).unwrap_or_else(|| panic!("{name}: no gradient"));
        self.case.check_gradient(&name, grad);
    }
}

fn compare<M: Module>(case: &Case<'_>, grads: &Gradients, module: &M, prefix: &str) {
    let path = if prefix.is_empty() { vec![] } else { vec![prefix.to_string()] };
    module.visit(&mut Compare { case, grads, path });
}

/// Checks outputs, then gradients of the sum of outputs times cotangents.
fn check<M: Module>(
    case: &Case<'_>,
    outputs: &[(&str, Tensor<4>)],
    inputs: &[(&str, &Tensor<4>)],
    module: &M,
    prefix: &str,
) {
    let mut sum = None;
    for (name, output) in outputs {
        case.check_output(name, output.clone().inner());
        let part = (output.clone() * case.cotangent(name, &output.device())).sum();
        sum = Some(sum.map_or_else(|| part.clone(), |sum| sum + part.clone()));
    }
    let grads = sum.unwrap().backward();
    for (name, input) in inputs {
        case.check_gradient(name, input.grad(&grads).unwrap());
    }
    compare(case, &grads, module, prefix);
}

#[test]
fn resampling_matches_pytorch() {
    let file = File::open("network/resample");
    for device in devices() {
        for case in file.cases() {
            let x: Tensor<4> = case.input("x", &device).require_grad();
            let y = match case.name {
                "up2" => resample::upsample2(x.clone()),
                "pool2" => resample::avg_pool2(x.clone()),
                "repeat2" => resample::repeat(x.clone()),
                "fold" => resample::pixel_unshuffle(x.clone(), 2),
                "unfold" => resample::pixel_shuffle(x.clone(), 2),
                "flow_4_1" => resample::rescale_flow(x.clone(), 4, 1),
                "flow_2_8" => resample::rescale_flow(x.clone(), 2, 8),
                other => panic!("unknown case {other}"),
            };
            case.check_output("y", y.clone().inner());
            let grads = (y * case.cotangent("y", &device)).sum().backward();
            case.check_gradient("x", x.grad(&grads).unwrap());
        }
    }
}

#[test]
fn small_blocks_match_pytorch() {
    let file = File::open("network/blocks");
    for device in devices() {
        let input = |case: &Case<'_>| -> Tensor<4> { case.input("x", &device).require_grad() };
        let case = file.case("dense");
        let block = weighted(DenseBlock::zeros(6, 4, &device), "dense");
        let x = input(&case);
        check(&case, &[("y", block.forward(x.clone()))], &[("x", &x)], &block, "dense");
        for name in ["residual_12_12", "residual_12_20"] {
            let case = file.case(name);
            let sizes = [case.number("from"), case.number("to")];
            let block = ResidualBlock::zeros(sizes, case.number("embedding"), &device);
            let block = weighted(block, "residual");
            let x = input(&case);
            let embedding: Tensor<2> = case.input("emb", &device).require_grad();
            let y = block.forward(x.clone(), silu(embedding.clone()));
            let grads = (y.clone() * case.cotangent("y", &device)).sum().backward();
            case.check_gradient("emb", embedding.grad(&grads).unwrap());
            let y = block.forward(x.clone(), silu(embedding.clone()));
            check(&case, &[("y", y)], &[("x", &x)], &block, "residual");
        }
        let case = file.case("attention");
        let block = weighted(Attention::zeros(12, &device), "attention");
        let x = input(&case);
        check(&case, &[("y", block.spatial(x.clone()))], &[("x", &x)], &block, "attention");
        let case = file.case("temporal");
        let block = weighted(Attention::zeros(12, &device), "temporal");
        let x = input(&case);
        let y = block.temporal(x.clone(), case.number("frames"));
        check(&case, &[("y", y)], &[("x", &x)], &block, "temporal");
    }
    let case = file.case("sinusoids");
    let times: Vec<usize> = case.values("t").iter().map(|&t| t as usize).collect();
    case.close("output.y", &embedding::sinusoids(&times, case.number("size")), 1e-6);
}

#[test]
fn pre_denoiser_matches_pytorch() {
    check_pre_denoiser("network/pre");
}

#[test]
fn pre_denoiser_with_neighbour_weighting_matches_pytorch() {
    check_pre_denoiser("network/pre_trust");
}

fn check_pre_denoiser(file: &str) {
    let file = File::open(file);
    for device in devices() {
        for case in file.cases() {
            let config = config(&case);
            let pre = weighted(config.pre.init(config.reference, config.fold, &device), "pre");
            let [guide, y_sim, u_sim] = ["guide", "y_sim", "u_sim"]
                .map(|name| -> Tensor<4> { case.input(name, &device).require_grad() });
            let frames = guide.dims()[0] / 2;
            let flag: Tensor<1> = case.input("flag", &device);
            let flag = flag.reshape([2, 1, 1, 1]).repeat_dim(1, frames);
            let flag = flag.reshape([2 * frames, 1, 1, 1]);
            let both = Tensor::cat(vec![y_sim.clone(), u_sim.clone()], 1);
            let input = normalized(&guide);
            let (d, g) = pre.forward(pre.encode(&input), &input, both, flag);
            let mut inputs = vec![("guide", &guide)];
            if case.name == "with" {
                inputs.extend([("y_sim", &y_sim), ("u_sim", &u_sim)]);
            }
            check(&case, &[("d", d), ("g", g)], &inputs, &pre, "pre");
        }
    }
}

#[test]
fn uncertainty_head_matches_pytorch() {
    let file = File::open("network/error");
    for device in devices() {
        let case = file.case("error");
        let config = config(&case);
        let head = config.pre.init_uncertainty(config.fold, &device).unwrap();
        let head = weighted(head, "uncertainty");
        let guide: Tensor<4> = case.input("guide", &device);
        let g: Tensor<4> = case.input("g", &device).require_grad();
        let sigma = head.forward(g.clone(), &normalized(&guide));
        check(&case, &[("deviation", sigma)], &[("g", &g)], &head, "uncertainty");
    }
}

fn pyramid(name: &str, levels: Pyramid) -> Vec<(String, Tensor<4>)> {
    (0..).zip(levels).map(|(k, level)| (format!("{name}_{k}"), level)).collect()
}

fn named(list: &[(String, Tensor<4>)]) -> Vec<(&str, Tensor<4>)> {
    list.iter().map(|(name, tensor)| (name.as_str(), tensor.clone())).collect()
}

#[test]
fn features_match_pytorch() {
    let file = File::open("network/features");
    for device in devices() {
        let input =
            |case: &Case<'_>, name: &str| -> Tensor<4> { case.input(name, &device).require_grad() };
        let case = file.case("low");
        let (sizes, frames) = (config(&case), case.number("frames"));
        let low = weighted(sizes.features.init_low(sizes.fold, &device), "low");
        let [u, u_sim, d] = ["u", "u_sim", "d"].map(|name| input(&case, name));
        let encoded = low.encode(u.clone(), frames);
        let levels = pyramid("low", low.forward(encoded, u_sim.clone(), d.clone(), frames));
        let inputs = [("u", &u), ("u_sim", &u_sim), ("d", &d)];
        check(&case, &named(&levels), &inputs, &low, "low");
        let case = file.case("high");
        let high = weighted(sizes.features.init_high(sizes.fold, &device), "high");
        let names = ["residual", "earlier"];
        let [residual, previous] = names.map(|name| input(&case, name));
        let levels = pyramid("high", high.forward(residual.clone(), previous.clone(), frames));
        let inputs = [(names[0], &residual), (names[1], &previous)];
        check(&case, &named(&levels), &inputs, &high, "high");
    }
}

#[test]
fn flow_matches_pytorch() {
    let file = File::open("network/flow");
    for device in devices() {
        for case in file.cases() {
            let flow = weighted(config(&case).flow.init(false, &device), "flow");
            let d: Tensor<4> = case.input("d", &device).require_grad();
            let variance: Tensor<4> = case.input("variance", &device);
            let reference: Tensor<4> = case.input("clean", &device);
            let flows = flow.forward(d.clone(), reference, variance, case.number("frames"));
            let outputs = [("to_next", flows.to_next), ("to_prev", flows.to_prev)];
            check(&case, &outputs, &[("d", &d)], &flow, "flow");
        }
    }
}

#[test]
fn fusion_matches_pytorch() {
    let file = File::open("network/fusion");
    for device in devices() {
        for case in file.cases() {
            let sizes = config(&case);
            let input = |name: &str| -> Tensor<4> { case.input(name, &device).require_grad() };
            let fusion =
                sizes.fusion.init(&sizes.features, sizes.pre.width, sizes.fold, false, &device);
            let fusion = weighted(fusion, "fusion");
            let low = ["low_0", "low_1", "low_2"].map(input);
            let high = ["high_0", "high_1", "high_2"].map(input);
            let [g, to_next, to_prev] = ["g", "to_next", "to_prev"].map(input);
            let scale = sizes.flow.scale;
            let (to_next_, coarser) = (to_next.clone(), Vec::new());
            let flows = Flows { to_next: to_next_, to_prev: to_prev.clone(), scale, coarser };
            let frames = case.number("frames");
            let fused = fusion.forward(low.clone(), high.clone(), g.clone(), &flows, frames);
            let outputs = pyramid("fused", fused);
            let inputs = [
                ("low_0", &low[0]),
                ("low_1", &low[1]),
                ("low_2", &low[2]),
                ("high_0", &high[0]),
                ("high_1", &high[1]),
                ("high_2", &high[2]),
                ("g", &g),
                ("to_next", &to_next),
                ("to_prev", &to_prev),
            ];
            check(&case, &named(&outputs), &inputs, &fusion, "fusion");
        }
    }
}

#[test]
fn u_net_matches_pytorch() {
    let file = File::open("network/unet");
    for device in [flex()] {
        for case in file.cases() {
            let sizes = config(&case);
            let unet = weighted(sizes.unet.init(&sizes.fusion, sizes.fold, &device), "unet");
            let input = |name: &str| -> Tensor<4> { case.input(name, &device).require_grad() };
            let [x_t, x0_prev, d, guide] = ["x_t", "x0_prev", "d", "guide"].map(input);
            let fused = ["fused_0", "fused_1", "fused_2"].map(input);
            let timesteps: Vec<usize> = case.values("t").iter().map(|&t| t as usize).collect();
            let sensor: Tensor<2> = case.input("sensor", &device);
            let (normalized, frames) = (normalized(&guide), case.number("frames"));
            let has_previous = case.values("flag").iter().map(|&flag| flag > 0.0).collect();
            let state = DiffusionState {
                x_t: x_t.clone(),
                x0_prev: x0_prev.clone(),
                has_previous,
                timesteps: timesteps.clone(),
            };
            let sigma = normalized.sigma.clone() * 0.6;
            let noisy = Preconditioned::new(d.clone() * 2.0 - 1.0, sigma, &state);
            let sensor = unet.encode(sensor);
            let images = UNetPrediction::Edm.images(&noisy, &state, &normalized);
            let output = unet.forward(images, fused.clone(), &timesteps, sensor, frames);
            let x0 = noisy.prediction(output);
            let inputs = [
                ("x_t", &x_t),
                ("x0_prev", &x0_prev),
                ("d", &d),
                ("guide", &guide),
                ("fused_0", &fused[0]),
                ("fused_1", &fused[1]),
                ("fused_2", &fused[2]),
            ];
            check(&case, &[("x0", x0)], &inputs, &unet, "unet");
        }
    }
}
