//! A training run in a folder: recipe, metrics, weights, state, pictures.

use super::burst_cache::{BurstSampler, Files};
use super::learner::{Learner, Origin};
use super::prefetch::Prefetcher;
use super::recipe::Recipe;
use super::trainer::{StepReport, Trainer};
use super::validate::{Validation, Validator};
use crate::dataset::Dataset;
use burn::tensor::Device;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Error, Result};
use serde::Serialize;
use std::fs::OpenOptions;
use std::io::Write;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Name of the recipe in a run's folder.
pub const RECIPE: &str = "recipe.toml";
/// Name of the metrics.
pub const METRICS: &str = "metrics.jsonl";
/// Name of the weights for use.
pub const WEIGHTS: &str = "weights.safetensors";

/// An event of a run.
#[derive(Debug)]
pub enum Event<'a> {
    /// A step is done.
    Step(&'a StepReport),
    /// The network was measured.
    Validation(&'a Validation),
    /// The state has been written after this step.
    Saved(u64),
    /// No gradient reaches these layers, so that they learn no more. Told where the state is written,
    /// whenever there are others than before.
    Dead(&'a [String]),
}

/// A run.
#[derive(Debug)]
pub struct Run<L> {
    folder: PathBuf,
    recipe: Recipe,
    trainer: Trainer<L>,
    bursts: BurstSampler,
    validator: Option<Validator>,
    device: Device,
    /// Where the weights come from; its steps are not the run's.
    origin: Origin,
}

/// Start of a run.
#[derive(Debug)]
pub enum From<L> {
    /// From initial weights, or those given.
    Start(Option<Box<L>>),
    /// From the state in its folder.
    State,
}

/// One line of the metrics.
#[derive(Serialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
enum Line<'a> {
    Step(&'a StepReport),
    Validation(&'a Validation),
}

impl<L: Learner> Run<L> {
    /// Opens a run in `folder`, which exists. Nothing is written before [`Self::learn`].
    ///
    /// # Errors
    /// [`Error`] if the data, the state or the folder cannot be used.
    pub fn open(
        folder: &Path,
        recipe: &Recipe,
        from: From<L>,
        files: Files,
        devices: &[Device],
        backbones: Option<&Path>,
        origin: Origin,
    ) -> Result<Self> {
        let validator = Validator::new(recipe, files.pack.as_ref())?;
        let trainer = match from {
            From::Start(network) => {
                Trainer::new(recipe, network.map(|network| *network), devices, backbones)?
            }
            From::State => Trainer::resume(folder, recipe, devices, backbones)?,
        };
        let dataset = Dataset::new(&recipe.data, files.pack)?;
        let aligner = trainer.averaged().aligner(recipe, &devices[0])?;
        let mut bursts = BurstSampler::new(recipe, dataset, aligner);
        if let Some(folder) = &files.bursts {
            bursts = bursts.with_cache(folder, recipe)?;
        }
        Ok(Self {
            folder: folder.to_owned(),
            recipe: recipe.clone(),
            device: devices[0].clone(),
            trainer,
            bursts,
            validator,
            origin,
        })
    }

    /// Returns the steps taken, and all steps.
    pub fn progress(&self) -> [u64; 2] {
        [self.trainer.step_number(), self.recipe.train.steps]
    }

    /// Learns to the end of the recipe, with data drawn on `workers` threads. `on` receives every event;
    /// if it returns `Break`, the state is written and the run stops.
    ///
    /// # Errors
    /// [`Error`] if data, device or disk fail, or the loss is not finite; [`Error::Interrupted`] if asked
    /// to stop.
    pub fn learn(
        &mut self,
        workers: usize,
        on: &mut dyn FnMut(Event<'_>) -> ControlFlow<()>,
    ) -> Result<()> {
        let train = self.recipe.train.clone();
        self.write(RECIPE, self.recipe.text().as_bytes())?;
        self.trim_metrics()?;
        let mut prefetcher =
            Prefetcher::<L>::new(&self.recipe, &self.bursts, self.trainer.batches(), workers)?;
        let card = self.trainer.card();
        if let Some(card) = &card {
            prefetcher = prefetcher.uploading(card.clone())?;
        }
        let mut metrics = self.metrics()?;
        if self.trainer.step_number() == 0
            && let Some(validation) = self.validate(0)?
        {
            self.log(&mut metrics, &Line::Validation(&validation))?;
            if on(Event::Validation(&validation)).is_break() {
                self.save()?;
                return Err(Error::Interrupted);
            }
        }
        let mut dead = Vec::new();
        while self.trainer.step_number() < train.steps {
            let mut go_on = ControlFlow::Continue(());
            let report = match &card {
                Some(_) => self.trainer.begin_step(&mut prefetcher)?,
                None => Some(self.trainer.step(&mut prefetcher)?),
            };
            if let Some(report) = report {
                self.log(&mut metrics, &Line::Step(&report))?;
                go_on = on(Event::Step(&report));
            }
            let step = self.trainer.step_number();
            let last = step == train.steps;
            let every = self.validator.as_ref().map(Validator::every);
            let validates = every.is_some_and(|every| step.is_multiple_of(every) || last);
            let saves = step.is_multiple_of(train.checkpoint) || last || go_on.is_break();
            if (validates || saves)
                && let Some(report) = self.trainer.finish()?
            {
                self.log(&mut metrics, &Line::Step(&report))?;
                if on(Event::Step(&report)).is_break() {
                    go_on = ControlFlow::Break(());
                }
            }
            if validates && let Some(validation) = self.validate(step)? {
                self.log(&mut metrics, &Line::Validation(&validation))?;
                if on(Event::Validation(&validation)).is_break() {
                    go_on = ControlFlow::Break(());
                }
            }
            if saves || go_on.is_break() {
                metrics.sync_data().map_err(|e| self.failed(METRICS, e))?;
                self.save()?;
                if on(Event::Saved(step)).is_break() {
                    go_on = ControlFlow::Break(());
                }
                let known = std::mem::replace(&mut dead, self.trainer.dead_layers()?);
                let mut new = dead.clone();
                new.retain(|name| !known.contains(name));
                if !new.is_empty() && on(Event::Dead(&new)).is_break() {
                    go_on = ControlFlow::Break(());
                }
            }
            if go_on.is_break() && !last {
                return Err(Error::Interrupted);
            }
        }
        Ok(())
    }

    /// Measures the averaged weights after `step` steps, if the recipe measures anything.
    fn validate(&self, step: u64) -> Result<Option<Validation>> {
        let Some(validator) = &self.validator else { return Ok(None) };
        let mut restorer = self.trainer.averaged().restorer(&self.recipe, &self.device)?;
        validator.measure(restorer.as_mut(), step).map(Some)
    }

    /// Writes weights and state: weights first, since a run whose state is at its end is taken as finished.
    fn save(&mut self) -> Result<()> {
        self.save_weights()?;
        self.trainer.save_state(&self.folder)
    }

    fn save_weights(&self) -> Result<()> {
        let origin = Origin { steps: self.trainer.step_number(), ..self.origin.clone() };
        self.trainer.averaged().save(&self.recipe, &origin, &self.folder.join(WEIGHTS))
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        PendingFile::write_whole(&self.folder.join(name), bytes, Overwrite::Yes)
    }

    fn metrics(&self) -> Result<std::fs::File> {
        let path = self.folder.join(METRICS);
        let file = OpenOptions::new().create(true).append(true).open(path);
        file.map_err(|e| self.failed(METRICS, e))
    }

    fn log(&self, file: &mut std::fs::File, line: &Line<'_>) -> Result<()> {
        let mut text = serde_json::to_vec(line).expect("plain data");
        text.push(b'\n');
        file.write_all(&text).map_err(|e| self.failed(METRICS, e))
    }

    /// Drops the lines of steps that a killed run took after its last state: they are taken again.
    fn trim_metrics(&self) -> Result<()> {
        let text = match std::fs::read_to_string(self.folder.join(METRICS)) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
            Err(e) => return Err(self.failed(METRICS, e)),
        };
        let taken = self.trainer.step_number();
        let kept = text.lines().filter(|line| {
            let line: Option<serde_json::Value> = serde_json::from_str(line).ok();
            let step = line.and_then(|line| line["step"].as_u64());
            taken > 0 && step.is_some_and(|step| step <= taken)
        });
        let kept: String = kept.flat_map(|line| [line, "\n"]).collect();
        self.write(METRICS, kept.as_bytes())
    }

    fn failed(&self, name: &str, e: std::io::Error) -> Error {
        Error::io("write the run", &self.folder.join(name), e)
    }
}
