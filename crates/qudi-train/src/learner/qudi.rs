//! The diffusion network as it learns.

use super::{Batch, Context, Learner, Loss, Origin, provenance};
use crate::burst_cache::BurstSampler;
use crate::loss::{LoopOptions, LossWeights, NoiseOn, SelfConditioning, loss_terms};
use crate::recipe::{LearningPart, LossConfig, Recipe};
use burn::tensor::{Device, Tensor};
use qudi_core::atomic_file::Overwrite;
use qudi_core::restorer::Restorer;
use qudi_core::{Error, Result};
use qudi_layers::TILE;
use qudi_model::checkpoint::{Description, ModelKind, Precision, load, save};
use qudi_model::config::{NetworkConfig, PRESETS, Part};
use qudi_model::network::{Qudi, former_name};
use qudi_model::refinement::RefinementStage;
use qudi_model::restorer::{Model, QudiRestorer, SampleOptions};
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use std::path::Path;

impl Learner for Qudi {
    type Batch = Batch;

    fn uninitialized(recipe: &Recipe, device: &Device) -> Result<Self> {
        Ok(recipe.network.qudi()?.uninitialized(device))
    }

    fn init(recipe: &Recipe, device: &Device) -> Result<Self> {
        Ok(recipe.network.qudi()?.init(recipe.train.seed, device))
    }

    /// Of the same network, of one with one refinement stage less, without an uncertainty head, or that leaves other
    /// parts out.
    fn load(path: &Path, recipe: &Recipe, device: &Device) -> Result<Self> {
        let wanted = recipe.network.qudi()?;
        let (mut network, Description { network: mut sizes, .. }) = load(path, device)?;
        let before = sizes.pre.aligned_neighbours();
        // A pre-denoiser that sees more than a refinement stage does cannot become one.
        let is_stage = before == sizes.pre.stage().aligned_neighbours();
        if sizes.pre.stages + 1 == wanted.pre.stages && is_stage {
            sizes.pre.stages += 1;
            let more = sizes.pre.aligned_neighbours().count() - before.count();
            network = network.with_stage_added(more);
        }
        if wanted.pre.uncertainty && !sizes.pre.uncertainty {
            network = network.with_uncertainty_head_of(Self::init(recipe, device)?);
            sizes.pre.uncertainty = true;
        }
        if sizes.ablate != wanted.ablate {
            network = network.ablated(wanted);
            sizes.ablate.clone_from(&wanted.ablate);
        }
        if sizes != *wanted {
            return Err(Error::data(
                "these weights are for a network of other sizes than the recipe's",
                path,
                "choose the recipe that they were trained with, its [network] table, or that with one more refinement stage or with an uncertainty head",
            ));
        }
        Ok(network)
    }

    fn draw(recipe: &Recipe, bursts: &mut BurstSampler, number: u64) -> Result<Batch> {
        Batch::draw(recipe, bursts, number)
    }

    fn loss<'a>(&'a self, batch: &'a Batch, context: &Context<'a>) -> Result<Loss<'a>> {
        let conditioning = batch.conditioning(context.device);
        let mut random = ChaCha8Rng::seed_from_u64(context.recipe.train.seed);
        random.set_stream(batch.number);
        let (weights, loop_options) = options(self, context.recipe)?;
        // Half of all batches start from nothing, as sampling does; but for its second step.
        let from_nothing = random.next_u64() & 1 == 0 && loop_options.noise_on == NoiseOn::Truth;
        let self_conditioning = if from_nothing || loop_options.needs_no_estimate() {
            SelfConditioning::Off
        } else {
            SelfConditioning::On(random.next_u64())
        };
        let example = batch.example(&conditioning);
        let perceptual = context.perceptual;
        let terms =
            loss_terms(self, &example, self_conditioning, weights, loop_options, perceptual)?;
        let nothing = terms.pre.zeros_like();
        let optional = |term: &Option<Tensor<1>>| term.clone().unwrap_or_else(|| nothing.clone());
        let named = vec![
            ("prediction", terms.prediction.clone()),
            ("pre", terms.pre.clone()),
            ("perceptual", optional(&terms.perceptual)),
            ("flow", optional(&terms.flow)),
            // As metrics have called it from the start.
            ("error", optional(&terms.uncertainty)),
        ];
        Ok(Loss {
            total: terms.total.clone(),
            terms: named,
            gradients: Box::new(move || terms.gradients(self, &conditioning)),
            statistics: Vec::new(),
        })
    }

    fn restorer(&self, recipe: &Recipe, device: &Device) -> Result<Box<dyn Restorer>> {
        let (frames, steps, spacing) = recipe.validation.as_ref().map_or_else(
            || (recipe.data.frames.max(11), recipe.default_steps(), recipe.default_spacing()),
            |v| (v.frames, v.steps.unwrap_or(0), v.spacing),
        );
        let options = SampleOptions { steps, spacing, ..SampleOptions::default() };
        let model = Model {
            network: self.clone(),
            config: recipe.network.qudi()?.clone(),
            kind: ModelKind::of(self)?,
            window: frames,
        };
        Ok(Box::new(QudiRestorer::new(model, options, device)?))
    }

    fn save(&self, recipe: &Recipe, origin: &Origin, path: &Path) -> Result<()> {
        let network = recipe.network.qudi()?;
        let is_preset = |name: &str| NetworkConfig::preset(name).is_ok_and(|n| n == *network);
        let preset = PRESETS.iter().find(|(name, _)| is_preset(name));
        let description = Description {
            preset: preset.map(|(name, _)| (*name).to_owned()),
            network: network.clone(),
            window: recipe.data.frames.max(11),
            provenance: provenance(recipe, origin),
            default_steps: Some(recipe.default_steps()),
            spacing: Some(recipe.default_spacing()),
            kind: None,
        };
        save(self, &description, Precision::Single, path, Overwrite::Yes)
    }

    fn former_name(name: &str) -> String {
        former_name(name)
    }

    /// Refinement stages never do.
    fn learns(&self, recipe: &Recipe) -> Vec<bool> {
        let parts: &[LearningPart] = &recipe.train.learns;
        let learns = |name: &str| {
            let chosen = parts.is_empty() || parts.iter().any(|part| part.has(name));
            chosen && !name.starts_with("stages.")
        };
        self.named_shapes().iter().map(|(name, _)| learns(name)).collect()
    }

    fn refinement_stages(&self, recipe: &Recipe, device: &Device) -> Result<Vec<RefinementStage>> {
        Ok(RefinementStage::all(self, recipe.network.qudi()?, TILE, device))
    }
}

/// Whether pre-denoised frames are the same in all passes: neither they nor their uncertainty learn, and they depend on
/// no simulated measurement.
fn is_pre_fixed(network: &Qudi, parts: &[LearningPart]) -> Result<bool> {
    let learns = |part| parts.is_empty() || parts.contains(&part);
    if learns(LearningPart::Pre) || learns(LearningPart::Uncertainty) {
        return Ok(false);
    }
    Ok(ModelKind::of(network)? != ModelKind::Diffusion)
}

fn options(learner: &Qudi, recipe: &Recipe) -> Result<(LossWeights, LoopOptions)> {
    let LossConfig { form, prediction, pre, perceptual, flow, .. } = recipe.train.loss();
    let network = recipe.network.qudi()?;
    // Where nothing moves, there is nothing to learn of it.
    let flow = if network.ablates(Part::Flow) { 0.0 } else { flow };
    let loop_options = LoopOptions {
        forward_model: !network.ablates(Part::ForwardModel),
        self_conditioning: !network.ablates(Part::SelfConditioning),
        recomputes: recipe.train.gradient_checkpointing,
        pre_is_fixed: is_pre_fixed(learner, &recipe.train.learns)?,
        noise_on: recipe.train.noise_on,
    };
    Ok((LossWeights { form, prediction, pre, perceptual, flow }, loop_options))
}
