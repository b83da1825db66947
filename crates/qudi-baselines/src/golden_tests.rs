//! Every network against PyTorch, forward and backward.
#![allow(clippy::unwrap_used)]

use crate::cases::{Case, File, parameter};
use crate::emvd::{self, Emvd};
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Device, Gradients, Tensor};
use qudi_layers::{init_parameters, parameter_shapes};

fn devices() -> [Device; 2] {
    #[allow(deprecated)] // asked for by name
    let ndarray = Device::ndarray();
    [Device::flex().autodiff(), ndarray.autodiff()]
}

/// The module with the reference's weights. Both have the same parameters.
fn weighted<M: Module>(module: M, case: &Case<'_>) -> M {
    let mut ours: Vec<_> = parameter_shapes(&module).into_iter().map(|(name, _)| name).collect();
    let mut theirs = case.parameters();
    ours.sort();
    theirs.sort_unstable();
    assert_eq!(ours, theirs);
    init_parameters(module, parameter)
}

/// Checks the gradients of all parameters.
struct Gradient<'a> {
    case: &'a Case<'a>,
    gradients: &'a Gradients,
    path: Vec<String>,
}

impl ModuleVisitor for Gradient<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let value = param.val();
        let gradient = value.grad(self.gradients).unwrap_or_else(|| value.inner().zeros_like());
        self.case.check_gradient(&self.path.join("."), gradient);
    }
}

fn check_gradients<M: Module>(
    case: &Case<'_>,
    loss: Tensor<1>,
    module: &M,
    inputs: &[(&str, &Tensor<4>)],
) {
    let gradients = loss.backward();
    for (name, input) in inputs {
        case.check_gradient(name, input.grad(&gradients).unwrap());
    }
    module.visit(&mut Gradient { case, gradients: &gradients, path: Vec::new() });
}

fn frame(x: &Tensor<5>, number: usize) -> Tensor<4> {
    let [images, _, channels, height, width] = x.dims();
    x.clone().narrow(1, number, 1).reshape([images, channels, height, width])
}

#[test]
fn emvd_matches_pytorch() {
    let file = File::open("learned/emvd");
    for device in devices() {
        let network = |case: &Case<'_>| {
            let width = case.about["config"]["width"].as_u64().unwrap() as usize;
            weighted(Emvd::zeros(width, &device), case)
        };
        let case = file.case("step");
        let emvd = network(&case);
        let [previous, current] = ["previous", "current"]
            .map(|name| -> Tensor<4> { case.input(name, &device).require_grad() });
        let step = emvd.step(previous.clone(), current.clone());
        let outputs = [
            ("gamma", step.gamma),
            ("fusion", step.fusion),
            ("denoise", step.denoise),
            ("omega", step.omega),
            ("refine", step.refine),
        ];
        let loss = sum(&case, &outputs);
        check_gradients(&case, loss, &emvd, &[("previous", &previous), ("current", &current)]);

        for name in ["sequence", "loss"] {
            let case = file.case(name);
            let emvd = network(&case);
            let x: Tensor<5> = case.input("x", &device).require_grad();
            let mut steps: Vec<emvd::Step> = Vec::new();
            for number in 0..x.dims()[1] {
                let current = frame(&x, number);
                let previous = steps.last().map_or(current.clone(), |step| step.fusion.clone());
                steps.push(emvd.step(previous, current));
            }
            let refined = Tensor::stack::<5>(steps.iter().map(|s| s.refine.clone()).collect(), 1);
            let loss = if name == "loss" {
                let truth: Tensor<5> = case.input("truth", &device);
                let loss = (refined - truth).abs().mean() + emvd.transform_loss();
                case.check_output("loss", loss.clone());
                loss
            } else {
                let fusion = steps.pop().unwrap().fusion;
                case.check_output("refine", refined.clone());
                case.check_output("fusion", fusion.clone());
                (refined * case.cotangent("refine", &device)).sum()
                    + (fusion * case.cotangent("fusion", &device)).sum()
            };
            let gradients = loss.backward();
            case.check_gradient("x", x.grad(&gradients).unwrap());
            emvd.visit(&mut Gradient { case: &case, gradients: &gradients, path: Vec::new() });
        }
    }
}

/// Checks outputs, and gives the sum whose gradients the file holds.
fn sum(case: &Case<'_>, outputs: &[(&str, Tensor<4>)]) -> Tensor<1> {
    let parts = outputs.iter().map(|(name, output)| {
        case.check_output(name, output.clone());
        (output.clone() * case.cotangent(name, &output.device())).sum()
    });
    parts.reduce(Tensor::add).unwrap()
}
