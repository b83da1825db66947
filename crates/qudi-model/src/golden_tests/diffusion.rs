//! The blocks of the diffusion.

use super::{check, devices, flex, normalized, weighted};
use crate::cases::{Case, File};
use crate::diffusion::network::attention::Attention;
use crate::diffusion::network::embedding::sinusoids;
use crate::diffusion::network::features::Pyramid;
use crate::diffusion::network::unet::ResidualBlock;
use crate::diffusion::precondition::Preconditioned;
use crate::diffusion::schedule::NoiseSchedule;
use crate::diffusion::state::{DiffusionState, per_image};
use crate::diffusion::timesteps::NUM_TIMESTEPS;
use crate::diffusion::{DiffusionConfig, Flows};
use burn::tensor::Tensor;
use burn::tensor::activation::silu;

/// Returns the sizes of a reference case, without the keys of what was removed.
pub(super) fn config(case: &Case<'_>) -> DiffusionConfig {
    let mut config = case.about["config"].clone();
    for (table, key) in [("pre", "neighbours"), ("flow", "registration"), ("unet", "temporal")] {
        config[table].as_object_mut().unwrap().remove(key);
    }
    config.as_object_mut().unwrap().remove("reference");
    if config["unet"]["predicts"].is_null() {
        config["unet"]["predicts"] = "correction".into();
    }
    serde_json::from_value::<DiffusionConfig>(config).unwrap().checked().unwrap()
}

#[test]
fn small_blocks_match_pytorch() {
    let file = File::open("network/blocks");
    for device in devices() {
        let input = |case: &Case<'_>| -> Tensor<4> { case.input("x", &device).require_grad() };
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
        check(&case, &[("y", block.forward(x.clone()))], &[("x", &x)], &block, "attention");
    }
    let case = file.case("sinusoids");
    let times: Vec<usize> = case.values("t").iter().map(|&t| t as usize).collect();
    case.close("output.y", &sinusoids(&times, case.number("size")), 1e-6);
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
            let flow = weighted(config(&case).flow.init(&device), "flow");
            let d: Tensor<4> = case.input("d", &device).require_grad();
            let flows = flow.forward(d.clone(), case.number("frames"));
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
            let fusion = sizes.fusion.init(&sizes.features, sizes.pre.width, sizes.fold, &device);
            let fusion = weighted(fusion, "fusion");
            let low = ["low_0", "low_1", "low_2"].map(input);
            let high = ["high_0", "high_1", "high_2"].map(input);
            let [g, to_next, to_prev] = ["g", "to_next", "to_prev"].map(input);
            let scale = sizes.flow.scale;
            let (to_next_, coarser) = (to_next.clone(), Vec::new());
            let flows = Flows { to_next: to_next_, to_prev: to_prev.clone(), scale, coarser };
            let frames = case.number("frames");
            let fused = fusion.forward(low.clone(), high.clone(), g.clone(), &flows, frames, false);
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

/// The other case of the file attends over time.
#[test]
fn u_net_matches_pytorch() {
    let device = flex();
    let file = File::open("network/unet");
    let case = file.case("tiny");
    let sizes = config(&case);
    let unet = weighted(sizes.unet.init(&sizes.fusion, sizes.fold, &device), "unet");
    let input = |name: &str| -> Tensor<4> { case.input(name, &device).require_grad() };
    let [x_t, x0_prev, d, guide] = ["x_t", "x0_prev", "d", "guide"].map(input);
    let fused = ["fused_0", "fused_1", "fused_2"].map(input);
    let timesteps: Vec<usize> = case.values("t").iter().map(|&t| t as usize).collect();
    let sensor: Tensor<2> = case.input("sensor", &device);
    let input = normalized(&guide);
    let has_previous = case.values("flag").iter().map(|&flag| flag > 0.0).collect();
    let state = DiffusionState {
        x_t: x_t.clone(),
        x0_prev: x0_prev.clone(),
        has_previous,
        timesteps: timesteps.clone(),
    };
    let sigma = input.sigma.clone() * 0.6;
    let noisy = Preconditioned::new(d.clone() * 2.0 - 1.0, sigma, &state);
    let sensor = unet.encode(sensor);
    let Preconditioned { mean, sigma, residual, previous, log_snr, c_out } = noisy;
    // The reference sees the planes of a regression, and has a skip connection for the noise.
    let signed = input.reference.clone() * 2.0 - 1.0;
    let difference = input.planes.narrow(1, 0, 1);
    let images = vec![mean.clone(), residual.clone(), previous, signed, difference, log_snr];
    let output = unet.forward(images, fused.clone(), &timesteps, sensor);
    let x0 = mean + residual * c_skip(&sigma, &timesteps) + output * c_out;
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

/// Returns the share of the residual in the reference's prediction (Karras et al. 2022, table 1).
fn c_skip(sigma: &Tensor<4>, timesteps: &[usize]) -> Tensor<4> {
    let schedule = NoiseSchedule::cosine(NUM_TIMESTEPS);
    let signal = timesteps.iter().map(|&t| schedule.alpha_bar(Some(t)) as f32).collect();
    let signal = per_image(signal, sigma.dims()[0], &sigma.device()).expand(sigma.dims());
    let noise = signal.clone() * -1.0 + 1.0;
    let variance = sigma.clone() * sigma.clone();
    let total = (variance.clone() * signal.clone() + noise).sqrt();
    variance * signal.sqrt() / total
}
