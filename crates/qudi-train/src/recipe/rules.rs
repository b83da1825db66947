//! Rules of recipes.

use super::{
    LearningPart, LossConfig, NetworkRecipe, Recipe, TrainConfig, ValidationConfig, is_default,
    stage,
};
use crate::loss::lpips::PerceptualKind;
use qudi_baselines::method::Sizes;
use qudi_core::{Error, Result};
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::DiffusionConfig;
use qudi_model::regression::FirstFrames;

/// A key, true if it keeps the rule, and the rule.
type Rule<'a> = (&'a str, bool, &'a str);

impl Recipe {
    /// Returns the recipe, if it can be trained.
    pub(super) fn checked(self) -> Result<Self> {
        let network = match self.network.clone() {
            NetworkRecipe::Qudi(config) => NetworkRecipe::Qudi(config.checked()?),
            baseline @ NetworkRecipe::Baseline(_) => baseline,
        };
        let data = self.data.clone().checked()?;
        match &network {
            NetworkRecipe::Qudi(NetworkConfig::Regression(config)) => {
                self.check_foreign()?;
                check(&self.sample_rules(1, config.fold))?;
                check(&self.regression_rules(config.first))?;
            }
            NetworkRecipe::Qudi(NetworkConfig::Diffusion(config)) => {
                self.check_diffusion(config)?;
            }
            NetworkRecipe::Qudi(NetworkConfig::Window(config)) => {
                self.check_sampling()?;
                check(&self.sample_rules(3, config.multiple()))?;
                check(&[
                    ("train.passes", (1..=8).contains(&self.train.passes), "must be from 1 to 8"),
                    ("train.ablate", is_default(&self.train.ablate), "is for the other diffusion"),
                    (
                        "train.learns",
                        !self.train.learns.contains(&LearningPart::Features),
                        "names a part that only the other diffusion has",
                    ),
                    (
                        "train.learns",
                        self.train.learns.is_empty()
                            || self.train.learns.iter().any(|&part| part != LearningPart::Flow)
                            || (self.train.loss().flow > 0.0 && self.train.matched == 0.0),
                        "must have more than flow, unless train.loss.flow has a weight and train.matched is 0: it learns from nothing else",
                    ),
                    (
                        "train.gradient_checkpointing",
                        !self.train.gradient_checkpointing,
                        "is for the other diffusion",
                    ),
                ])?;
                check(&self.loss_rules())?;
            }
            NetworkRecipe::Baseline(sizes) => self.check_baseline(*sizes)?,
        }
        check(&self.common_rules())?;
        check(&[(
            "stage",
            stage::have_good_names(&self.stage),
            "must have names of a-z, 0-9 and -, each its own",
        )])?;
        if let Some(validation) = &self.validation {
            check_validation(validation)?;
        }
        self.stages()?;
        Ok(Self { network, data, ..self })
    }

    /// Returns the rules of every network.
    fn common_rules(&self) -> [Rule<'static>; 12] {
        let train = &self.train;
        let is_regression =
            matches!(&self.network, NetworkRecipe::Qudi(NetworkConfig::Regression(_)));
        let is_window = matches!(&self.network, NetworkRecipe::Qudi(NetworkConfig::Window(_)));
        [
            ("train.first", is_regression || train.first.is_none(), "is for the regression"),
            ("train.passes", is_window || train.passes == 1, "is for the network `window`"),
            ("train.matched", (0.0..=1.0).contains(&train.matched), "must be from 0 to 1"),
            ("train.matched", is_window || train.matched == 0.0, "is for the network `window`"),
            ("train.steps", (1..=1 << 40).contains(&train.steps), "must be at least 1"),
            ("train.batch", (1..=4096).contains(&train.batch), "must be from 1 to 4096"),
            ("train.accumulate", (1..=4096).contains(&train.accumulate), "must be from 1 to 4096"),
            ("train.lr", train.lr > 0.0 && train.lr <= 1.0, "must be above 0, at most 1"),
            (
                "train.min_lr",
                train.min_lr >= 0.0 && train.min_lr <= train.lr,
                "must be from 0 to train.lr",
            ),
            ("train.clip", train.clip > 0.0, "must be above 0"),
            ("train.ema", (0.0..1.0).contains(&train.ema), "must be from 0 to below 1"),
            ("train.checkpoint", train.checkpoint > 0, "must be at least 1"),
        ]
    }

    /// Returns the rules of samples, which have `fewest` frames and sides of multiples of a number.
    fn sample_rules(&self, fewest: usize, multiple: usize) -> [Rule<'static>; 2] {
        let train = &self.train;
        let (frames, side) = self.sample_size();
        [
            (
                if train.crops.is_some() { "train.crops.side" } else { "data.crop" },
                side.is_multiple_of(multiple) && side > 0,
                "must be a multiple of the network's coarsest cell",
            ),
            (
                "train.crops",
                (fewest..=self.data.frames).contains(&frames)
                    && train.crops.is_none_or(|crops| {
                        (frames..=self.data.frames).contains(&crops.cached_frames)
                    })
                    && side <= self.data.crop
                    && train.crops.is_none_or(|crops| (1..=1 << 20).contains(&crops.bursts)),
                "must be of at least one burst, fit into it, and have 3 frames for the diffusion",
            ),
        ]
    }

    /// Returns the rules of the regression: of the parts that learn, and of the frames that they see.
    fn regression_rules(&self, first: FirstFrames) -> [Rule<'static>; 3] {
        let learns = &self.train.learns;
        let second = [LearningPart::Pre, LearningPart::Uncertainty];
        let is_second = !learns.is_empty() && learns.iter().all(|part| second.contains(part));
        let has_refinement = first == FirstFrames::Refinement;
        [
            (
                "train.learns",
                self.trains_refinement() || is_second,
                "must be [\"refinement\"], or of \"pre\" and \"uncertainty\", which learn from what the refinement restores",
            ),
            (
                "train.learns",
                has_refinement || is_second,
                "must be of \"pre\" and \"uncertainty\" with network.first = \"diffusion\"",
            ),
            (
                "train.first",
                has_refinement == self.train.first.is_none(),
                "belongs to network.first = \"diffusion\": it names weights of `window`, as `--set train.first=FILE`",
            ),
        ]
    }

    /// Checks the keys that every diffusion needs.
    fn check_sampling(&self) -> Result<()> {
        let train = &self.train;
        let steps = self.validation.as_ref().map(|validation| validation.steps);
        check(&[
            ("train.loss", train.loss.is_some(), "is missing"),
            ("train.noise_start_fraction", train.noise_start_fraction.is_some(), "is missing"),
            (
                "train.noise_start_fraction",
                (0.0..=1.0).contains(&train.noise_start_fraction()),
                "must be from 0 to 1",
            ),
            ("validation.steps", steps.is_none_or(|steps| steps.is_some()), "is missing"),
            ("validation.steps", steps != Some(Some(0)), "must be at least 1"),
        ])
    }

    fn check_diffusion(&self, network: &DiffusionConfig) -> Result<()> {
        let train = &self.train;
        self.check_sampling()?;
        check(&self.sample_rules(3, network.multiple()))?;
        check(&self.loss_rules())?;
        check(&[(
            "train.gradient_checkpointing",
            train.learns(LearningPart::Pre) || !train.gradient_checkpointing,
            "must be false where pre does not learn",
        )])
    }

    /// Returns the rules of the loss of both diffusions, and of the parts that learn from it.
    fn loss_rules(&self) -> [Rule<'static>; 6] {
        let train = &self.train;
        let weight = |v: f32| v.is_finite() && v >= 0.0;
        let loss = train.loss();
        let others = [LearningPart::Refinement, LearningPart::Uncertainty];
        [
            (
                "train.loss",
                [loss.prediction, loss.flow, loss.pre, loss.perceptual].into_iter().all(weight),
                "must have weights of 0 or more",
            ),
            ("train.loss.prediction", loss.prediction > 0.0, "must be above 0"),
            perceptual_rule(loss),
            (
                "train.learns",
                !others.iter().any(|part| train.learns.contains(part)),
                "names a part that only the regression has",
            ),
            (
                "train.learns",
                train.learns(LearningPart::Pre) || loss.pre == 0.0,
                "must have pre where train.loss.pre has a weight",
            ),
            (
                "train.learns",
                train.learns(LearningPart::Flow) || loss.flow == 0.0,
                "must have flow where train.loss.flow has a weight",
            ),
        ]
    }

    /// Refuses keys of the diffusion for another network.
    fn check_foreign(&self) -> Result<()> {
        let TrainConfig { timesteps, noise_start_fraction, ablate, loss, .. } = &self.train;
        let validation = self.validation.as_ref();
        let foreign = [
            ("train.loss", loss.is_some()),
            ("train.timesteps", !is_default(timesteps)),
            ("train.ablate", !is_default(ablate)),
            ("train.noise_start_fraction", noise_start_fraction.is_some()),
            ("train.gradient_checkpointing", self.train.gradient_checkpointing),
            ("validation.steps", validation.is_some_and(|v| v.steps.is_some())),
            ("validation.spacing", validation.is_some_and(|v| !is_default(&v.spacing))),
        ];
        let Some((key, _)) = foreign.iter().find(|(_, given)| *given) else { return Ok(()) };
        let what =
            format!("{key} is for the diffusion, and the recipe for {}", self.network.name());
        Err(Error::request(what, *key, "correct the recipe: see docs/training.md"))
    }

    fn check_baseline(&self, sizes: Sizes) -> Result<()> {
        let refused = |what: String, key: &str| {
            Err(Error::request(what, key, "correct the recipe: see docs/training.md"))
        };
        if let Some(problem) = sizes.problem_in_recipe() {
            return refused(format!("{problem}; the recipe has {sizes}"), "network");
        }
        let (frames, _) = self.sample_size();
        let key = if self.train.crops.is_some() { "train.crops.frames" } else { "data.frames" };
        if let Some(problem) = sizes.problem_of_bursts(frames) {
            return refused(problem, key);
        }
        self.check_foreign()?;
        if !self.train.learns.is_empty() {
            let what = format!("train.learns is not for {}", sizes.method().name());
            return refused(what, "train.learns");
        }
        check(&self.sample_rules(1, sizes.multiple()))
    }
}

/// Returns the rule of the perceptual term and its weight.
fn perceptual_rule(loss: LossConfig) -> Rule<'static> {
    (
        "train.loss.term",
        (loss.term == PerceptualKind::None) == (loss.perceptual == 0.0),
        "and train.loss.perceptual belong together: a term and its weight, or \"none\" and 0",
    )
}

fn check(rules: &[Rule<'_>]) -> Result<()> {
    match rules.iter().find(|(_, good, _)| !good) {
        Some((key, _, problem)) => {
            Err(Error::request(format!("{key} {problem}"), key, "correct the recipe"))
        }
        None => Ok(()),
    }
}

fn check_validation(validation: &ValidationConfig) -> Result<()> {
    let good = (3..=1000).contains(&validation.frames)
        && (16..=4096).contains(&validation.crop)
        && !validation.ppp.is_empty()
        && validation.ppp.iter().all(|&ppp| ppp > 0.0 && ppp < 1e6)
        && validation.every > 0
        && !validation.from.is_empty();
    if good {
        return Ok(());
    }
    Err(Error::request(
        "the validation cannot be done: it wants clips, 3 frames, 16 pixels, light",
        "validation",
        "correct the recipe",
    ))
}
