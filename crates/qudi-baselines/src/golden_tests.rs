//! Every network against PyTorch, forward and backward.
#![allow(clippy::unwrap_used)]

mod pieces;

use crate::cases::{Case, File, parameter, uniform};
use crate::emvd::{self, Emvd};
use crate::flornn::{self, FloRnn};
use crate::memdeblur::{self, BatchStatistics, MemDeblur};
use crate::parts::{bursts_of, charbonnier, frame as frame_of};
use crate::quiver::{self, Quiver};
use crate::rvrt::{self, Rvrt};
use crate::spk2imgnet::{self, Spk2ImgNet};
use crate::student_teacher::{self, KernelPrediction};
use burn::module::{Module, ModuleVisitor, Param, list_param_ids};
use burn::tensor::{Device, Gradients, Tensor};
use qudi_layers::{init_parameters, parameter_shapes};

fn devices() -> [Device; 2] {
    #[allow(deprecated)] // asked for by name
    let ndarray = Device::ndarray();
    [Device::flex().autodiff(), ndarray.autodiff()]
}

/// Gives a module the reference's weights, whose names follow from ours. Both have the same parameters.
fn weighted<M: Module>(module: M, case: &Case<'_>, prefix: &str, name: Name) -> M {
    let full = |ours: &str| format!("{prefix}{}", name(ours));
    let shapes = parameter_shapes(&module).into_iter();
    let mut ours: Vec<_> = shapes.map(|(ours, shape)| (full(&ours), shape)).collect();
    let theirs = case.parameters().into_iter().filter(|name| name.starts_with(prefix));
    let squeezed = |mut shape: Vec<usize>| {
        // Convolutions of one frame each.
        if shape.len() == 5 && shape[2] == 1 {
            shape.remove(2);
        }
        shape
    };
    let theirs = theirs.map(|name| (name.to_owned(), squeezed(case.parameter_shape(name))));
    let mut theirs: Vec<_> = theirs.chain(buffers(case)).collect();
    ours.sort();
    theirs.sort();
    assert_eq!(ours, theirs);
    init_parameters(module, |name, shape| reference_parameter(&full(name), shape))
}

/// Returns names and shapes of the statistics that layers keep.
fn buffers(case: &Case<'_>) -> Vec<(String, Vec<usize>)> {
    let all = case.about["buffers"].as_object().into_iter().flatten();
    let shape = |shape: &serde_json::Value| {
        shape.as_array().unwrap().iter().map(|side| side.as_u64().unwrap() as usize).collect()
    };
    all.map(|(name, about)| (name.clone(), shape(about))).collect()
}

/// Returns a parameter of the reference: flows of some tenths of a pixel to some pixels need larger weights,
/// and smaller ones.
fn reference_parameter(name: &str, shape: &[usize]) -> Vec<f32> {
    if name.ends_with(".running_mean") || name.ends_with(".running_var") {
        let (offset, scale) = if name.ends_with("mean") { (0.0, 0.1) } else { (1.0, 0.5) };
        let values = uniform(name, shape.iter().product());
        return values.into_iter().map(|value| (offset + scale * value) as f32).collect();
    }
    let is_flow = name.starts_with("pwcnet.") && shape.len() > 1;
    let last_of_flow = !name.starts_with("pwcnet.netExtractor.")
        && (name.ends_with("netSix.0.weight") || name.ends_with("netMain.12.weight"));
    let factors = [
        (name.ends_with("basic_module.8.weight"), 2.0),
        (name.ends_with("conv_offset.6.weight") || name.ends_with("conv_offset.10.weight"), 0.125),
        (is_flow, 1.5),
        (last_of_flow, 0.125),
    ];
    let factor: f32 =
        factors.iter().filter(|(holds, _)| *holds).map(|(_, factor)| factor).product();
    parameter(name, shape).into_iter().map(|value| value * factor).collect()
}

/// From our name of a parameter to the reference's.
type Name = fn(&str) -> String;

/// Checks the gradients of all parameters.
struct Gradient<'a> {
    case: &'a Case<'a>,
    gradients: &'a Gradients,
    path: Vec<String>,
    name: &'a dyn Fn(&str) -> String,
    /// Parameters of which the file has no gradient.
    without: Vec<String>,
}

impl ModuleVisitor for Gradient<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let name = (self.name)(&self.path.join("."));
        if !self.case.has_gradient(&name) {
            self.without.push(name);
            return;
        }
        let value = param.val();
        let gradient = value.grad(self.gradients).unwrap_or_else(|| value.inner().zeros_like());
        self.case.check_gradient(&name, gradient);
    }
}

/// Checks the gradients that the file has; `without` says which parameters have none.
fn check_parameters<M: Module>(
    case: &Case<'_>,
    gradients: &Gradients,
    module: &M,
    name: &dyn Fn(&str) -> String,
    without: fn(&str) -> bool,
) {
    let mut checked = Gradient { case, gradients, path: Vec::new(), name, without: Vec::new() };
    module.visit(&mut checked);
    let unexpected: Vec<_> = checked.without.iter().filter(|name| !without(name)).collect();
    assert!(unexpected.is_empty(), "no gradients of {unexpected:?}");
}

/// Returns false: all parameters have gradients.
fn none(_: &str) -> bool {
    false
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
            weighted(Emvd::zeros(width, &device), case, "", str::to_owned)
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
        let gradients = sum(&case, &outputs).backward();
        for (name, input) in [("previous", &previous), ("current", &current)] {
            case.check_gradient(name, input.grad(&gradients).unwrap());
        }
        check_parameters(&case, &gradients, &emvd, &str::to_owned, none);

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
            check_parameters(&case, &gradients, &emvd, &str::to_owned, none);
        }
    }
}

/// Checks outputs, and returns the sum whose gradients the file holds.
fn sum(case: &Case<'_>, outputs: &[(&str, Tensor<4>)]) -> Tensor<1> {
    let parts = outputs.iter().map(|(name, output)| {
        let flat: Tensor<1> = output.clone().flatten(0, 3);
        case.check_output(name, flat.clone());
        (flat * case.flat_cotangent(name, &output.device())).sum()
    });
    parts.reduce(Tensor::add).unwrap()
}

fn size(case: &Case<'_>, key: &str) -> usize {
    case.about["config"][key].as_u64().unwrap() as usize
}

#[test]
fn spk2imgnet_matches_pytorch() {
    let file = File::open("learned/spk2imgnet");
    for device in devices() {
        for name in ["forward", "loss"] {
            let case = file.case(name);
            let sizes = spk2imgnet::Sizes {
                features: size(&case, "features"),
                stem: size(&case, "stem"),
                blocks: size(&case, "blocks"),
                groups: 8,
            };
            let network = Spk2ImgNet::zeros(sizes, &device);
            let network = weighted(network, &case, "", Spk2ImgNet::authors_name);
            let x: Tensor<4> = case.input("x", &device).require_grad();
            let (image, estimates) = network.forward(&x);
            let loss = if name == "loss" {
                let [main, each] =
                    spk2imgnet::losses(image, estimates, case.input("truth", &device));
                let loss = main + each;
                case.check_output("loss", loss.clone());
                loss
            } else {
                let names: Vec<_> = (0..5).map(|block| format!("estimate_{block}")).collect();
                let each = names.iter().enumerate();
                let each = each.map(|(n, name)| (name.as_str(), frame(&estimates, n)));
                let outputs: Vec<_> = each.chain([("y", image)]).collect();
                sum(&case, &outputs)
            };
            let gradients = loss.backward();
            case.check_gradient("x", x.grad(&gradients).unwrap());
            check_parameters(&case, &gradients, &network, &Spk2ImgNet::authors_name, none);
        }
    }
}

#[test]
fn student_teacher_matches_pytorch() {
    let file = File::open("learned/student_teacher");
    for device in devices() {
        let network = |case: &Case<'_>, prefix: &str| {
            let sizes = student_teacher::Sizes {
                frames: size(case, "frames"),
                features: size(case, "features"),
                kernel: size(case, "kernel"),
            };
            let network = KernelPrediction::zeros(sizes, &device);
            weighted(network, case, prefix, KernelPrediction::file_name)
        };
        let case = file.case("student");
        let student = network(&case, "");
        let x: Tensor<4> = case.input("x", &device).require_grad();
        let restored = student.forward(x.clone());
        let outputs = [
            ("image", restored.image),
            ("frames", restored.frames),
            ("extracted", restored.extracted),
            ("bottom", restored.bottom),
        ];
        let gradients = sum(&case, &outputs).backward();
        case.check_gradient("x", x.grad(&gradients).unwrap());
        check_parameters(&case, &gradients, &student, &KernelPrediction::file_name, none);

        let case = file.case("loss");
        let [student, motion, denoising] =
            ["student.", "motion.", "denoising."].map(|prefix| network(&case, prefix));
        let input = |name: &str| -> Tensor<4> { case.input(name, &device) };
        let noisy = input("noisy").require_grad();
        let teachers = [motion.forward(input("clean")), denoising.forward(input("still"))];
        let restored = student.forward(noisy.clone());
        let step = case.number("iteration") as u64;
        let [image, frames] =
            student_teacher::reconstruction_losses(&restored, &input("truth"), step);
        let loss = image + frames + student_teacher::matching_loss(&restored, teachers.each_ref());
        case.check_output("loss", loss.clone());
        let gradients = loss.backward();
        case.check_gradient("noisy", noisy.grad(&gradients).unwrap());
        let name = |ours: &str| format!("student.{}", KernelPrediction::file_name(ours));
        check_parameters(&case, &gradients, &student, &name, none);
    }
}

#[test]
fn quiver_matches_pytorch() {
    for name in ["quiver", "quiver_long", "quiver_loss"] {
        let file = File::open(&format!("learned/{name}"));
        for case in file.cases() {
            // Half a minute on ndarray.
            let device = Device::flex().autodiff();
            let sizes = quiver::Sizes {
                features: size(&case, "features"),
                blocks: size(&case, "blocks"),
                past: size(&case, "past"),
                future: size(&case, "future"),
            };
            let network = Quiver::zeros(sizes, &device);
            let network = weighted(network, &case, "", Quiver::authors_name);
            let x: Tensor<5> = case.input("x", &device).require_grad();
            let frames = x.dims()[1];
            let restored = network.forward(folded(&x), frames);
            let loss = if name == "quiver_loss" {
                let truth: Tensor<5> = case.input("truth", &device);
                let [full, half, quarter, pre] = network.losses(restored, &folded(&truth), frames);
                let loss = full + half + quarter + pre;
                case.check_output("loss", loss.clone());
                loss
            } else {
                let quiver::Restored { predenoised, full, half, quarter } = restored;
                let outputs =
                    [("clean", predenoised), ("full", full), ("half", half), ("quarter", quarter)];
                sum(&case, &outputs)
            };
            let gradients = loss.backward();
            case.check_gradient("x", x.grad(&gradients).unwrap());
            check_parameters(&case, &gradients, &network, &Quiver::authors_name, none);
        }
    }
}

#[test]
fn rvrt_matches_pytorch() {
    for name in ["rvrt", "rvrt_loss"] {
        let file = File::open(&format!("learned/{name}"));
        for case in file.cases() {
            // Minutes on ndarray.
            let device = Device::flex().autodiff();
            let sizes = rvrt::Sizes {
                channels: size(&case, "channels"),
                features: size(&case, "features"),
                blocks: size(&case, "blocks"),
            };
            let network = weighted(Rvrt::zeros(sizes, &device), &case, "", Rvrt::authors_name);
            let x: Tensor<5> = case.input("x", &device).require_grad();
            let frames = x.dims()[1];
            let image = network.forward(folded(&x), frames);
            let loss = if name == "rvrt_loss" {
                let truth: Tensor<5> = case.input("truth", &device);
                let loss = charbonnier(image, folded(&truth));
                case.check_output("loss", loss.clone());
                loss
            } else {
                sum(&case, &[("y", image)])
            };
            let gradients = loss.backward();
            case.check_gradient("x", x.grad(&gradients).unwrap());
            check_parameters(&case, &gradients, &network, &Rvrt::authors_name, none);
        }
    }
}

#[test]
fn flornn_matches_pytorch() {
    let file = File::open("learned/flornn");
    let device = Device::flex().autodiff();
    let is_flow = |name: &str| name.starts_with("pwcnet.");
    for case in file.cases() {
        let sizes = flornn::Sizes {
            channels: size(&case, "channels"),
            features: size(&case, "features"),
            blocks: size(&case, "blocks"),
            ahead: size(&case, "forward_count"),
            border: case.about["config"]["border_ratio"].as_f64().unwrap(),
            flow: true,
        };
        let network = FloRnn::zeros(sizes, &device);
        if case.name == "flow" {
            let network = init_parameters(network, |name, shape| {
                reference_parameter(&FloRnn::authors_name(name), shape)
            });
            let [a, b] = ["a", "b"].map(|name| case.input::<4>(name, &device));
            case.check_output("flow", network.flow(&a, &b).unwrap());
            continue;
        }
        let network = weighted(network, &case, "", FloRnn::authors_name);
        let x: Tensor<5> = case.input("x", &device).require_grad();
        let frames = x.dims()[1];
        let window: Vec<_> = (0..frames).map(|t| frame_of(&folded(&x), frames, t)).collect();
        let image = network.forward(&window, &network.flows(&window));
        let loss = if case.name == "loss" {
            let truth: Tensor<5> = case.input("truth", &device);
            let loss = flornn::loss(image, frame_of(&folded(&truth), frames, 1));
            case.check_output("loss", loss.clone());
            loss
        } else {
            sum(&case, &[("y", image)])
        };
        let gradients = loss.backward();
        case.check_gradient("x", x.grad(&gradients).unwrap());
        check_parameters(&case, &gradients, &network, &FloRnn::authors_name, is_flow);
    }
}

#[test]
fn memdeblur_matches_pytorch() {
    // Of these there is no gradient: nothing depends on them.
    fn without(name: &str) -> bool {
        let unused = ["conv_hr.", "conv_last.", "memory.key_proj.key_proj.bias"];
        unused.iter().any(|unused| name.starts_with(unused)) || name.contains(".running_")
    }
    // Of those before normalisations by statistics of batches, none but rounding.
    fn without_of_batch(name: &str) -> bool {
        let before = [".conv1.bias", ".conv2.bias", ".conv3.bias", ".downsample.0.bias"];
        let encoder = name.contains("_encoder") && !name.contains("_resblocks");
        without(name) || encoder && before.iter().any(|bias| name.ends_with(bias))
    }
    let device = Device::flex().autodiff();
    for (name, case) in [
        ("memdeblur", "evaluation"),
        ("memdeblur_training", "training"),
        ("memdeblur_training", "training_batch"),
    ] {
        let file = File::open(&format!("learned/{name}"));
        let case = file.case(case);
        let sizes = memdeblur::Sizes {
            channels: size(&case, "channels"),
            features: size(&case, "features"),
            forward_blocks: size(&case, "forward_blocks"),
            backward_blocks: size(&case, "backward_blocks"),
            memory_blocks: size(&case, "memory_blocks"),
            bottlenecks: size(&case, "bottlenecks"),
            top: size(&case, "top"),
        };
        let network = MemDeblur::zeros(sizes, &device);
        let network = weighted(network, &case, "", MemDeblur::authors_name);
        let x: Tensor<5> = case.input("x", &device).require_grad();
        let frames = x.dims()[1];
        let loss = if name == "memdeblur" {
            let outputs = network.forward(&folded(&x), frames, memdeblur::Mode::Use);
            let shown = outputs.map(|images| {
                let [a, b] = [5, 10].map(|number| frame_of(&images, frames, number));
                bursts_of(vec![a, b])
            });
            let [quarter, half, full] = shown;
            sum(&case, &[("quarter", quarter), ("half", half), ("full", full)])
        } else {
            let truth: Tensor<5> = case.input("truth", &device);
            let statistics = BatchStatistics::default();
            let of_batch = (case.name == "training_batch").then_some(&statistics);
            let mode = memdeblur::Mode::Training(of_batch);
            let outputs = network.forward(&folded(&x), frames, mode);
            let [quarter, half, full] = memdeblur::losses(outputs, &folded(&truth));
            let loss = quarter + half + full;
            case.check_output("loss", loss.clone());
            if of_batch.is_some() {
                let moved = statistics.into_moved();
                let names = parameter_shapes(&network).into_iter().map(|(name, _)| name);
                let ids: Vec<_> = names.zip(list_param_ids(&network)).collect();
                for (output, name) in [("mean", "running_mean"), ("variance", "running_var")] {
                    let name = format!("memory.key_encoder.bn1.{name}");
                    let (_, id) = ids.iter().find(|(ours, _)| *ours == name).unwrap();
                    case.check_output(output, moved[id].clone());
                }
            }
            loss
        };
        let gradients = loss.backward();
        case.check_gradient("x", x.grad(&gradients).unwrap());
        let without = if case.name == "training_batch" { without_of_batch } else { without };
        check_parameters(&case, &gradients, &network, &MemDeblur::authors_name, without);
    }
}

/// Returns frames in the order of bursts.
fn folded(x: &Tensor<5>) -> Tensor<4> {
    let [bursts, frames, channels, height, width] = x.dims();
    x.clone().reshape([bursts * frames, channels, height, width])
}
