//! The loss that training minimises, as a weighted sum of terms.
//!
//! The prediction's squared error counts in units of what is unknown of every pixel (Karras et al. 2022,
//! table 1, "EDM": their weight `1 / c_out^2`), that of the pre-denoised frames relative to the error of the
//! reference estimate. docs/network.md has the formulas.

mod gaussian_nll;
pub mod lpips;
mod recomputation;
mod reconstruction;
mod self_conditioning;
mod timesteps;

use crate::parameters::gradients;
use burn::module::Module;
use burn::tensor::Tensor;
use gaussian_nll::uncertainty_loss;
use lpips::Lpips;
use qudi_core::Result;
use qudi_core::restorer::Acquisition;
use qudi_model::conditioning::Conditioning;
use qudi_model::diffusion::timesteps::NUM_TIMESTEPS;
use qudi_model::network::Qudi;
use recomputation::{PreDenoised, Predicted, Recomputation};
use reconstruction::{relative_reconstruction, root_mean_square};
use schemars::JsonSchema;
use self_conditioning::network_inputs;
use serde::{Deserialize, Serialize};

pub use gaussian_nll::gaussian_nll;
pub use reconstruction::reconstruction;
pub use self_conditioning::{LoopOptions, SelfConditioning};
pub(crate) use timesteps::second_of_two;
pub use timesteps::{NoiseOn, TimestepLaw};

/// The least unit that a pixel's error is counted in, in [-1, 1]: half a step of 8 bits.
const LEAST_UNIT: f32 = 0.004;

/// The error that pre-denoised frames usually have, in units of the linear estimate's noise.
const USUAL_ERROR: f32 = 0.3;

/// How the errors of images count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LossForm {
    /// Squared error and total variation of the error, in [0, 1], as in the paper.
    L2Tv,
    /// Squared errors in units of what is unknown of every pixel, and relative to the reference estimate.
    #[default]
    Edm,
}

/// The form of the loss, and the weight of each term. That of the predicted uncertainty is 1, for nothing else
/// learns from it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// How the errors of images count.
    pub form: LossForm,
    /// The weight of the prediction.
    pub prediction: f32,
    /// The weight of the pre-denoised frames.
    pub pre: f32,
    /// The weight of the perceptual term, if there is one.
    pub perceptual: f32,
    /// The weight of the flows' misfit.
    pub flow: f32,
}

impl Default for LossWeights {
    fn default() -> Self {
        Self { form: LossForm::default(), prediction: 1.0, pre: 0.2, perceptual: 0.0, flow: 0.0 }
    }
}

/// Bursts to learn from.
///
/// # Shapes
/// - truth, noise: `[bursts * frames, 1, height, width]`
#[derive(Clone, Debug)]
pub struct Example<'a> {
    /// The network's inputs.
    pub conditioning: &'a Conditioning,
    /// The true frames in [0, 1].
    pub truth: Tensor<4>,
    /// Sensor and light of every burst.
    pub acquisitions: &'a [Acquisition],
    /// Standard normal noise.
    pub noise: Tensor<4>,
    /// The timestep of every burst.
    pub timesteps: &'a [usize],
}

/// The terms of the loss, `[1]` each; all but the total are unweighted.
#[derive(Clone, Debug)]
pub struct LossTerms {
    /// The weighted sum.
    pub total: Tensor<1>,
    /// The error of the prediction; with [`LossForm::Edm`] about 1 where it knows no more than the predicted
    /// uncertainty of every pixel.
    pub prediction: Tensor<1>,
    /// The error of the pre-denoised frames; with [`LossForm::Edm`] 1 where it is that of the reference
    /// estimate, or, without one, some tenths of the noise.
    pub pre: Tensor<1>,
    /// The perceptual distance of the predictions, but for those from noise alone.
    pub perceptual: Option<Tensor<1>>,
    /// The misfit of neighbours, warped along the flows, and the truth; computed only where it has a weight.
    pub flow: Option<Tensor<1>>,
    /// The negative log-likelihood of the pre-denoised frames' errors, if their uncertainty is predicted.
    pub uncertainty: Option<Tensor<1>>,
    /// What is left to do for the gradients, if parts are computed again for them.
    recomputation: Option<Recomputation>,
}

impl LossTerms {
    /// Adds the terms up.
    fn weighted(mut self, weights: LossWeights) -> Self {
        let optional = [
            (&self.perceptual, weights.perceptual),
            (&self.flow, weights.flow),
            (&self.uncertainty, 1.0),
        ];
        for (term, weight) in optional {
            if let Some(term) = term {
                self.total = self.total + term.clone() * weight;
            }
        }
        self
    }

    /// The gradients of the total for all parameters of `network`, in their order, `[values]` each. `conditioning` is
    /// that of the example.
    pub fn gradients(&self, network: &Qudi, conditioning: &Conditioning) -> Vec<Tensor<1>> {
        match &self.recomputation {
            Some(recomputation) => recomputation.gradients(network, conditioning),
            None => gradients(network, &self.total.backward()),
        }
    }
}

/// Computes the loss of `network`, which is on an autodiff device, on an example on the same device.
///
/// # Errors
/// [`Error`](qudi_core::Error) if the device fails or a sensor is impossible.
pub fn loss_terms(
    network: &Qudi,
    example: &Example<'_>,
    self_conditioning: SelfConditioning,
    weights: LossWeights,
    options: LoopOptions,
    perceptual: Option<&Lpips>,
) -> Result<LossTerms> {
    if weights.prediction == 0.0 && perceptual.is_none() {
        return Ok(first_stage_terms(network, example, weights));
    }
    let Example { conditioning, truth, .. } = example;
    let fixed = options.pre_is_fixed.then(|| {
        let valid = network.valid();
        valid.predenoise_simulated(&conditioning.inner(), None)
    });
    let (state, simulated) =
        network_inputs(network, example, fixed.as_ref(), self_conditioning, options)?;
    let predenoised =
        options.recomputes.then(|| PreDenoised::new(network, conditioning, simulated.as_ref()));
    let fixed = fixed.map(|(d, features)| (Tensor::from_inner(d), Tensor::from_inner(features)));
    let encoded = match predenoised.as_ref().map(PreDenoised::results).or(fixed) {
        Some(frames) => network.encode_predenoised(conditioning, frames),
        None => network.encode(conditioning),
    };
    let (fused, flows) = network.fuse(&encoded, simulated.as_ref(), &state, None, &mut |_| ());
    let d = fused.d().clone();
    let predicted =
        predenoised.is_some().then(|| Predicted::new(network, fused.clone(), conditioning.frames));
    let (x0, unit) = match &predicted {
        Some(predicted) => predicted.results(),
        None => network.predict(&fused),
    };
    let image = (x0.clone() + 1.0) * 0.5;
    let prediction = match weights.form {
        LossForm::L2Tv => reconstruction(image.clone(), truth.clone()),
        LossForm::Edm => {
            let error = x0 - (truth.clone() * 2.0 - 1.0);
            (error / unit.clamp_min(LEAST_UNIT)).powi_scalar(2).mean()
        }
    };
    let perceptual = perceptual.map(|lpips| perceptual_loss(lpips, &image, example));
    let pre = pre_denoiser_loss(example, d, weights.form);
    let flow = (weights.flow > 0.0).then(|| flows.warping_error(truth, conditioning.frames));
    // The uncertainty is that of the frames before any simulated measurement.
    let learns = network.predicts_uncertainty() && !options.pre_is_fixed;
    let uncertainty = learns.then(|| network.predenoise(conditioning));
    let uncertainty = uncertainty.and_then(|(d, sigma)| uncertainty_loss(&d, truth, sigma));
    let total = prediction.clone() * weights.prediction + pre.clone() * weights.pre;
    let terms =
        LossTerms { total, prediction, pre, perceptual, flow, uncertainty, recomputation: None };
    let recomputation = predenoised.zip(predicted).map(|(predenoised, predicted)| {
        let of_images = LossTerms { flow: None, ..terms.clone() }.weighted(weights).total;
        let of_flows = terms.flow.clone().map(|flow| flow * weights.flow);
        Recomputation { predenoised, predicted, of_images, of_flows }
    });
    Ok(LossTerms { recomputation, ..terms.weighted(weights) })
}

/// The perceptual distance of predictions, but for those from noise alone: that step gives the mean of all images
/// that fit, the later ones draw one of them. Zero if there are no others.
fn perceptual_loss(lpips: &Lpips, images: &Tensor<4>, example: &Example<'_>) -> Tensor<1> {
    let frames = example.conditioning.frames;
    let timesteps = example.timesteps;
    let later: Vec<_> =
        (0..timesteps.len()).filter(|&n| timesteps[n] < NUM_TIMESTEPS - 1).collect();
    if later.is_empty() {
        return images.clone().mean() * 0.0;
    }
    let only = |images: &Tensor<4>| {
        let burst = |&number: &usize| images.clone().narrow(0, number * frames, frames);
        Tensor::cat(later.iter().map(burst).collect(), 0)
    };
    lpips.loss(only(images), only(&example.truth))
}

/// Computes the terms of pre-denoiser and flow alone, or of the pre-denoiser alone where the flow has no
/// weight: a first stage, at a fifth of the cost or less, for what must work before the rest can learn from
/// it.
fn first_stage_terms(network: &Qudi, example: &Example<'_>, weights: LossWeights) -> LossTerms {
    let Example { conditioning, truth, .. } = example;
    let (d, sigma, flows) = if weights.flow > 0.0 {
        let (d, flows) = network.predenoise_and_align(&network.encode(conditioning));
        let sigma = network.predicts_uncertainty().then(|| network.predenoise(conditioning).1);
        (d, sigma.flatten(), Some(flows))
    } else {
        let (d, sigma) = network.predenoise(conditioning);
        (d, sigma, None)
    };
    let uncertainty = uncertainty_loss(&d, truth, sigma);
    let pre = pre_denoiser_loss(example, d, weights.form);
    let flow = flows.map(|flows| flows.warping_error(truth, conditioning.frames));
    let (total, prediction) = (pre.clone() * weights.pre, pre.zeros_like());
    let (perceptual, recomputation) = (None, None);
    let terms = LossTerms { total, prediction, pre, perceptual, flow, uncertainty, recomputation };
    terms.weighted(weights)
}

/// The error of pre-denoised frames.
fn pre_denoiser_loss(example: &Example<'_>, frames: Tensor<4>, form: LossForm) -> Tensor<1> {
    let Example { conditioning, truth, .. } = example;
    if form == LossForm::L2Tv {
        return reconstruction(frames, truth.clone());
    }
    let unit = match &conditioning.aligned {
        Some(aligned) => {
            root_mean_square(aligned.reference.clone() - truth.clone(), conditioning.frames)
        }
        None => conditioning.noise_variance().sqrt() * USUAL_ERROR,
    };
    relative_reconstruction(frames, truth.clone(), unit)
}
