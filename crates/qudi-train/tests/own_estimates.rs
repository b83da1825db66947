//! Training on the network's own estimates sees what the second of two steps of sampling sees.
#![allow(clippy::unwrap_used)]

mod moving_disk;

use burn::tensor::{Device, Tensor};
use moving_disk::{Burst, burst, tiny};
use qudi_core::Size;
use qudi_core::restorer::{BurstView, Restorer};
use qudi_layers::tensor::to_tensor;
use qudi_model::checkpoint::ModelKind;
use qudi_model::diffusion::noise::Noise;
use qudi_model::network::{Qudi, init_parameters, parameter_shapes};
use qudi_model::restorer::{Model, QudiRestorer, SampleOptions};
use qudi_train::gradients;
use qudi_train::loss::{
    LoopOptions, LossForm, LossTerms, LossWeights, NoiseOn, SelfConditioning, loss_terms,
    reconstruction,
};

const SIZE: Size = Size { height: 32, width: 32 };
const FRAMES: usize = 4;
const SEED: u64 = 5;

/// Far enough from black and white that no prediction is clamped.
const LEVELS: [f32; 2] = [0.3, 0.8];

/// The timestep of the second of two steps, spaced by the law of training.
const TIMESTEP: usize = 44;

/// A network whose parameters are not zero, but for those that see simulated measurements, if it sees none.
fn network(sees_simulated: bool, device: &Device) -> Qudi {
    init_parameters(tiny().init(3, device), |name, shape| {
        let count: usize = shape.iter().product();
        if name.starts_with("pre.simulated_in") && !sees_simulated {
            return vec![0.0; count];
        }
        (0..count).map(|i| 0.05 * (i as f32).sin()).collect()
    })
}

/// The loss on the network's own estimates, and the gradients of all parameters.
fn terms(network: &Qudi, options: LoopOptions, device: &Device) -> (LossTerms, Vec<Tensor<1>>) {
    let burst = burst(LEVELS, SIZE, FRAMES, device);
    let streams = Noise::new(SEED, 0);
    let noise = (0..FRAMES as u64).flat_map(|frame| streams.frame(frame, 0, SIZE.pixels()));
    let example = burst.example(to_tensor(noise.collect(), SIZE, device), &[TIMESTEP]);
    let photons = SelfConditioning::On(streams.photon_seed(2));
    let weights = LossWeights { form: LossForm::L2Tv, ..LossWeights::default() };
    let terms = loss_terms(network, &example, photons, weights, options, None).unwrap();
    let gradients = gradients(network, &terms.total.backward());
    (terms, gradients)
}

fn value(term: Tensor<1>) -> f32 {
    term.into_scalar()
}

/// The second of two steps of sampling, from the same noise and photons, has the prediction that training judges.
#[test]
fn training_on_estimates_equals_sampling_in_two_steps() {
    let device = Device::flex();
    let Burst { counts, truth, acquisition, .. } = burst(LEVELS, SIZE, FRAMES, &device);
    let acquisition = acquisition.with_seed(SEED);
    let model = Model {
        network: network(true, &device),
        config: tiny(),
        kind: ModelKind::Diffusion,
        window: FRAMES,
    };
    let options = SampleOptions { steps: 2, ..SampleOptions::default() };
    let mut restorer = QudiRestorer::new(model, options, &device).unwrap();
    let restored = restorer.restore(BurstView { size: SIZE, frames: &counts }, &acquisition);
    let restored = restored.unwrap().frames.into_iter().flat_map(|frame| frame.data);
    let restored = to_tensor(restored.collect(), SIZE, &device);
    let expected = value(reconstruction(restored, truth));
    let device = device.autodiff();
    let with = |noise_on| {
        let options = LoopOptions { noise_on, ..LoopOptions::ALL };
        value(terms(&network(true, &device), options, &device).0.prediction)
    };
    let got = with(NoiseOn::Estimate);
    assert!((got / expected - 1.0).abs() < 1e-4, "{got} and {expected}");
    let other = with(NoiseOn::Truth);
    assert!((other / expected - 1.0).abs() > 1e-2, "{other} and {expected}");
}

/// Frames that are pre-denoised once give the same loss, and the same gradients to all that learns.
#[test]
fn pre_denoising_once_changes_nothing_but_the_time() {
    let device = Device::flex().autodiff();
    let network = network(false, &device);
    let with = |pre_is_fixed| {
        let noise_on = NoiseOn::Estimate;
        let options = LoopOptions { pre_is_fixed, noise_on, ..LoopOptions::ALL };
        let (terms, gradients) = terms(&network, options, &device);
        let names = parameter_shapes(&network).into_iter();
        let learning = names.zip(gradients).filter(|((name, _), _)| !name.starts_with("pre."));
        let lists = learning.map(|((name, _), list)| {
            (name, list.into_data().try_into_vec::<f32>().unwrap_or_default())
        });
        (value(terms.total), lists.collect::<Vec<_>>())
    };
    let ((once, gradients), (twice, others)) = (with(true), with(false));
    assert!((once / twice - 1.0).abs() < 1e-6, "{once} and {twice}");
    let moves = |list: &[f32]| list.iter().any(|value| *value != 0.0);
    assert!(gradients.iter().any(|(name, list)| name == "unet.out.weight" && moves(list)));
    for ((name, list), (_, other)) in gradients.iter().zip(&others) {
        let largest = other.iter().fold(1e-9f32, |most, v| most.max(v.abs()));
        let worst = list.iter().zip(other).fold(0.0f32, |most, (a, b)| most.max((a - b).abs()));
        assert!(worst <= 1e-4 * largest, "{name}: {worst} of {largest}");
    }
}
