//! Every block, and both networks, against PyTorch, forward and backward, on both CPU backends.
#![allow(clippy::unwrap_used)]

mod diffusion;
mod whole;

use crate::aligned::{Aligned, AlignedNeighbours};
use crate::cases::{Case, File, parameter};
use crate::init_parameters;
use crate::regression::input::NormalizedInput;
use crate::regression::{FirstFrames, RegressionConfig};
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Device, Gradients, Tensor};
use qudi_burst::Alignments;
use qudi_layers::DenseBlock;
use qudi_layers::resample;
use serde_json::Value;

fn devices() -> [Device; 2] {
    #[allow(deprecated)] // asked for by name
    let ndarray = Device::ndarray();
    [Device::flex().autodiff(), ndarray.autodiff()]
}

/// Returns the device of the large cases, which take minutes on ndarray.
fn flex() -> Device {
    Device::flex().autodiff()
}

/// Gives a module the reference's weights.
fn weighted<M: Module>(module: M, prefix: &str) -> M {
    init_parameters(module, |name, shape| reference_parameter(&format!("{prefix}.{name}"), shape))
}

/// The names that the reference has for parts of parameters.
const REFERENCE_NAMES: [(&str, &str); 3] =
    [("uncertainty", "error"), ("weighting", "trust"), ("weighted_in", "trusted_in")];

/// Returns the name that the reference has for a parameter.
fn reference_name(name: &str) -> String {
    let part = |part: &str| {
        let found = REFERENCE_NAMES.iter().find(|(now, _)| *now == part);
        found.map_or(part, |(_, name)| *name).to_owned()
    };
    name.split('.').map(part).collect::<Vec<_>>().join(".")
}

fn reference_parameter(name: &str, shape: &[usize]) -> Vec<f32> {
    parameter(&reference_name(name), shape)
}

/// Splits the planes of a reference case: three images, `K + 1` counts, `K` expectations.
fn aligned(planes: &Tensor<4>) -> Aligned<Tensor<4>> {
    let neighbours = (planes.dims()[1] - 4) / 2;
    let plane = |at| planes.clone().narrow(1, at, 1);
    Aligned {
        reference: plane(0),
        merged: plane(1),
        noise_sigma: plane(2),
        counts: (3..4 + neighbours).map(plane).collect(),
        expected: (4 + neighbours..4 + 2 * neighbours).map(plane).collect(),
    }
}

fn normalized(planes: &Tensor<4>) -> NormalizedInput {
    NormalizedInput::new(&aligned(planes))
}

/// Returns the sizes of a reference case.
fn regression_config(case: &Case<'_>) -> RegressionConfig {
    let config = &case.about["config"];
    let number = |value: &Value| usize::try_from(value.as_u64().unwrap()).unwrap();
    let pre = &config["pre"];
    let [width, blocks, growth, neighbours] =
        ["width", "blocks", "growth", "neighbours"].map(|key| number(&pre[key]));
    let weight_channels = pre["trust"].as_u64().map_or(1, |_| number(&pre["trust"]));
    let fold = number(&config["fold"]);
    let first = FirstFrames::default();
    RegressionConfig { fold, width, blocks, growth, neighbours, weight_channels, first }
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
        let name = reference_name(&self.path.join("."));
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
fn dense_block_matches_pytorch() {
    let file = File::open("network/blocks");
    for device in devices() {
        let case = file.case("dense");
        let block = weighted(DenseBlock::zeros(6, 4, &device), "dense");
        let x: Tensor<4> = case.input("x", &device).require_grad();
        check(&case, &[("y", block.forward(x.clone()))], &[("x", &x)], &block, "dense");
    }
}

/// The reference also has a simulated measurement, which is zero here.
#[test]
fn pre_denoiser_of_the_regression_matches_pytorch() {
    let file = File::open("network/pre_trust");
    let case = file.case("without");
    for device in devices() {
        let config = regression_config(&case);
        let alignments = Alignments::WithMatched;
        let neighbours = AlignedNeighbours { neighbours: config.neighbours, alignments };
        let pre = weighted(config.init_predenoiser(neighbours, &device), "pre");
        let guide: Tensor<4> = case.input("guide", &device).require_grad();
        let (d, g) = pre.forward(&normalized(&guide));
        check(&case, &[("d", d), ("g", g)], &[("guide", &guide)], &pre, "pre");
    }
}

#[test]
fn uncertainty_head_matches_pytorch() {
    let file = File::open("network/error");
    for device in devices() {
        let case = file.case("error");
        let head = weighted(regression_config(&case).init_uncertainty(&device), "uncertainty");
        let guide: Tensor<4> = case.input("guide", &device);
        let g: Tensor<4> = case.input("g", &device).require_grad();
        let sigma = head.forward(g.clone(), &normalized(&guide));
        check(&case, &[("deviation", sigma)], &[("g", &g)], &head, "uncertainty");
    }
}
