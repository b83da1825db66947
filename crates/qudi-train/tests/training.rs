//! The loss of the diffusion and its gradients: they reach every parameter, one burst can be overfitted, and
//! backends agree.
#![allow(clippy::unwrap_used)]

mod moving_disk;

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::{AdamConfig, GradientsParams};
use burn::tensor::{Device, Gradients, Tensor};
use moving_disk::{Burst, tiny};
use qudi_core::Size;
use qudi_layers::tensor::to_tensor;
use qudi_model::diffusion::Diffusion;
use qudi_model::diffusion::noise::Noise;
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::{ComputePrecision, init_parameters, parameter_shapes, with_precision};
use qudi_train::diffusion::{LossTerms, SelfConditioning, TimestepLaw, loss_terms};
use qudi_train::loss::lpips::PerceptualKind;
use qudi_train::loss::{LossForm, gaussian_nll, reconstruction};
use qudi_train::{LossConfig, Optimizer, gradients, parameters, with_parameters};

const WEIGHTS: LossConfig = LossConfig {
    form: LossForm::Edm,
    prediction: 1.0,
    pre: 0.2,
    perceptual: 0.0,
    term: PerceptualKind::None,
    flow: 0.0,
};

fn burst(size: Size, frames: usize, device: &Device) -> Burst {
    moving_disk::burst([0.2, 0.9], size, frames, device)
}

/// Computes the loss of step `number`, at a time and with noise of its own.
fn loss(network: &Diffusion, burst: &Burst, number: u64) -> LossTerms {
    let frames = burst.conditioning.frames;
    let noise = Noise::new(number, 1);
    let values = (0..frames as u64).flat_map(|f| noise.frame(f, 0, burst.size.pixels())).collect();
    let place = (number as f64 * 0.618_034).fract();
    let at_start = (number as f64 * 0.414_214).fract() < 0.2;
    let timestep =
        if at_start { NUM_TIMESTEPS - 1 } else { TimestepLaw::LogLogistic.timestep(place) };
    let noise = to_tensor(values, burst.size, &burst.truth.device());
    let timesteps = [timestep];
    let example = burst.example(noise, &timesteps);
    let self_conditioning =
        if number.is_multiple_of(2) { SelfConditioning::Off } else { SelfConditioning::On(number) };
    loss_terms(network, &example, self_conditioning, WEIGHTS, false, None).unwrap()
}

/// Returns a term by name.
fn term(terms: &LossTerms, name: &str) -> f32 {
    let (_, term) = terms.terms().iter().find(|(term, _)| *term == name).unwrap();
    term.clone().into_scalar()
}

/// The paper's form: plain errors in [0, 1], in no unit of any burst.
#[test]
fn plain_loss_is_that_of_images() {
    let device = Device::flex().autodiff();
    let burst = burst(Size { height: 32, width: 32 }, 4, &device);
    let network = tiny().init(3, &device);
    let weights = LossConfig { form: LossForm::L2Tv, ..WEIGHTS };
    let example = burst.example(burst.truth.zeros_like(), &[500]);
    let terms =
        loss_terms(&network, &example, SelfConditioning::Off, weights, false, None).unwrap();
    let value = |term: Tensor<1>| term.into_scalar::<f32>();
    let d = network.predenoise(&burst.conditioning, None).d;
    let expected = value(reconstruction(d, burst.truth.clone()));
    assert!((term(&terms, "pre") - expected).abs() < 1e-6 * expected);
    let total = term(&terms, "prediction") + 0.2 * expected;
    assert!((value(terms.total()) - total).abs() < 1e-5 * total);
    assert!(term(&terms, "prediction") < 0.5, "squared errors of images");
}

/// Computing pre-denoiser and U-Net again, image by image, changes rounding alone.
#[test]
fn recomputed_gradients_equal_kept_ones() {
    let device = Device::flex().autodiff();
    let burst = burst(Size { height: 32, width: 32 }, 4, &device);
    let network = init_parameters(tiny().init(3, &device), |_, shape| {
        let count: usize = shape.iter().product();
        (0..count).map(|i| 0.05 * (i as f32).sin() + 0.01).collect()
    });
    let gradients_with = |recomputes: bool| -> Vec<Vec<f32>> {
        let weights = LossConfig { flow: 0.5, ..WEIGHTS };
        let example = burst.example(burst.truth.clone() * 0.3, &[400]);
        let on = SelfConditioning::On(7);
        let terms = loss_terms(&network, &example, on, weights, recomputes, None).unwrap();
        let list = terms.gradients(&network, &burst.conditioning);
        list.into_iter().map(|list| list.into_data().try_into_vec().unwrap()).collect()
    };
    let names: Vec<_> = parameter_shapes(&network).into_iter().map(|(name, _)| name).collect();
    let pairs = gradients_with(false).into_iter().zip(gradients_with(true));
    for (name, (kept, again)) in names.iter().zip(pairs) {
        let largest = kept.iter().fold(1e-6f32, |most, v| most.max(v.abs()));
        let worst = kept.iter().zip(&again).fold(0.0f32, |most, (a, b)| most.max((a - b).abs()));
        assert!(worst < 1e-3 * largest, "{name}: {worst} of {largest}");
        let again = ["pre.", "unet.inp", "unet.out"].iter().any(|part| name.starts_with(part));
        assert!(!again || largest > 1e-6, "{name} has no gradient");
    }
}

/// The minimum is 0.5 plus the logarithm of sigma.
#[test]
fn gaussian_nll_is_least_at_the_true_sigma() {
    let device = Device::flex();
    let noise: Vec<f32> = Noise::new(5, 1).frame(0, 0, 64 * 64).collect();
    let scale = (noise.iter().map(|n| n * n).sum::<f32>() / noise.len() as f32).sqrt();
    let of = |sigma: f32| {
        let errors = noise.iter().map(|n| 0.2 * n / scale).collect();
        let errors = to_tensor(errors, Size { height: 64, width: 64 }, &device);
        gaussian_nll(errors.clone(), errors.ones_like() * sigma).into_scalar::<f32>()
    };
    assert!((of(0.2) - (0.5 + 0.2f32.ln())).abs() < 1e-5, "{}", of(0.2));
    assert!(of(0.2) < of(0.19) && of(0.2) < of(0.21));
}

/// Names of parameters whose gradient is missing or zero.
struct MissingGradients<'a> {
    grads: &'a Gradients,
    path: Vec<String>,
    names: Vec<String>,
}

impl ModuleVisitor for MissingGradients<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let size = param.val().grad(self.grads).map(|g| g.abs().sum().into_scalar::<f32>());
        if !size.is_some_and(|size| size > 0.0 && size.is_finite()) {
            self.names.push(self.path.join("."));
        }
    }
}

#[test]
fn gradients_reach_every_parameter() {
    let device = Device::flex().autodiff();
    let burst = burst(Size { height: 32, width: 32 }, 4, &device);
    let mut config = tiny();
    config.unet.attention = vec![1];
    let mut network = config.init(3, &device);
    let mut optimizer = AdamConfig::new().with_epsilon(1e-8).init();
    for number in 0..10 {
        let grads = loss(&network, &burst, number).total().backward();
        let grads = GradientsParams::from_grads(grads, &network);
        network = optimizer.step(1e-3, network, grads);
    }
    // A step with a first pass: only then the simulated measurement matters. Its time is not the last one.
    let number = (1..).step_by(2).find(|&n| (f64::from(n) * 0.414_214).fract() > 0.2).unwrap();
    let grads = loss(&network, &burst, number as u64).total().backward();
    let mut missing = MissingGradients { grads: &grads, path: vec![], names: vec![] };
    network.visit(&mut missing);
    assert!(missing.names.is_empty(), "no gradient: {}", missing.names.join(", "));
}

#[test]
fn bf16_gradients_match_f32() {
    let device = Device::flex().autodiff();
    let burst = burst(Size { height: 64, width: 64 }, 5, &device);
    let mut network = tiny().init(3, &device);
    let mut optimizer = Optimizer::adam(&parameters(&network));
    let of = |network: &Diffusion, precision| {
        with_precision(precision, || {
            gradients(network, &loss(network, &burst, 10).total().backward())
        })
    };
    for _ in 0..10 {
        let gradients = of(&network, ComputePrecision::F32);
        let one = Tensor::ones([1], &Device::flex());
        let moved = optimizer.step(parameters(&network), &gradients, &one, 1e-3);
        network = with_parameters(network, moved);
    }
    let norm = |lists: &[Tensor<1>]| {
        let squares = lists.iter().map(|list| list.clone().powi_scalar(2).sum());
        squares.map(|square| square.into_scalar::<f32>()).sum::<f32>().sqrt()
    };
    let exact = of(&network, ComputePrecision::F32);
    let apart = of(&network, ComputePrecision::Bf16).into_iter().zip(&exact);
    let apart: Vec<_> = apart.map(|(a, b)| a - b.clone()).collect();
    let off = norm(&apart) / norm(&exact);
    assert!(off > 1e-3 && off < 0.05, "{off}");
}

#[test]
fn overfits_a_single_burst() {
    let device = Device::flex().autodiff();
    let burst = burst(Size { height: 16, width: 16 }, 5, &device);
    let mut network = tiny().init(3, &device);
    let mut optimizer = Optimizer::adam(&parameters(&network));
    let (mut totals, mut predictions) = (Vec::new(), Vec::new());
    for number in 0..200u32 {
        let terms = loss(&network, &burst, u64::from(number));
        totals.push(terms.total().into_scalar::<f32>());
        predictions.push(term(&terms, "prediction"));
        let gradients = gradients(&network, &terms.total().backward());
        let norm = gradients.iter().map(|g| g.clone().powi_scalar(2).sum().into_scalar::<f32>());
        let norm = f64::from(norm.sum::<f32>().sqrt());
        let rate = 4e-3 * (1.0 - f64::from(number) / 200.0);
        let scale = Tensor::full([1], (0.05 / norm).min(1.0), &Device::flex());
        let moved = optimizer.step(parameters(&network), &gradients, &scale, rate);
        network = with_parameters(network, moved);
    }
    let drop = |losses: &[f32]| losses[190..].iter().sum::<f32>() / 10.0 / losses[0];
    let (total, prediction) = (drop(&totals), drop(&predictions));
    assert!(prediction < 0.05, "the prediction's loss is still {prediction} of the first");
    assert!(total < 0.1, "the loss is still {total} of the first");
}

#[test]
fn step_on_ndarray_matches_flex() {
    #[allow(deprecated)] // asked for by name
    let devices = [Device::flex(), Device::ndarray()];
    let losses = devices.map(|device| {
        let device = device.autodiff();
        let burst = burst(Size { height: 16, width: 16 }, 3, &device);
        let mut network = tiny().init(3, &device);
        let mut optimizer = AdamConfig::new().with_epsilon(1e-8).init();
        let grads = loss(&network, &burst, 2).total().backward();
        let grads = GradientsParams::from_grads(grads, &network);
        network = optimizer.step(1e-3, network, grads);
        loss(&network, &burst, 4).total().into_scalar::<f32>()
    });
    assert!((losses[0] / losses[1] - 1.0).abs() < 1e-3, "{losses:?}");
}
