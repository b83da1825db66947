//! The speed of training.

use crate::burst_cache::{BurstSampler, Files};
use crate::dataset::Dataset;
use crate::learner::Learner;
use crate::prefetch::Prefetcher;
use crate::recipe::Recipe;
use crate::trainer::{StepReport, Trainer};
use burn::tensor::Device;
use qudi_core::{Error, Result};
use qudi_kernels::count_operations;
use serde::Serialize;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

/// Steps before the first timed one: caches fill, and kernels are compiled and chosen.
const WARM_UP: usize = 5;

/// Steps whose parts are timed one by one.
const TIMED_BY_PARTS: usize = 5;

/// The speed of whole training steps.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrainingSpeed {
    /// Samples of a step.
    pub batch: usize,
    /// Steps that were timed.
    pub steps: usize,
    /// Samples a second.
    pub samples_per_second: f64,
    /// Floating-point operations of convolutions a second, in 1e12.
    pub tflops: f64,
    /// Seconds of one step.
    pub step_s: f64,
    /// Seconds of a step that pass until the device has been asked for all of it.
    pub host_s: f64,
    /// Seconds of a step that it waits for data.
    pub data_s: f64,
    /// Seconds of the parts of a step, each waited for: medians.
    pub forward_s: f64,
    /// See `forward_s`.
    pub backward_s: f64,
    /// See `forward_s`.
    pub optimizer_s: f64,
}

impl TrainingSpeed {
    /// Trains `recipe` on `device` for about `seconds`, with samples that `workers` threads draw, and forgets
    /// what it has learnt. `on` is asked after every step whether to go on.
    ///
    /// # Errors
    /// As training; [`Error::Interrupted`] if asked to stop.
    pub fn measure<L: Learner>(
        recipe: &Recipe,
        files: Files,
        device: &Device,
        backbones: Option<&Path>,
        workers: usize,
        seconds: f64,
        on: &mut dyn FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let mut trainer = Trainer::<L>::new(recipe, None, std::slice::from_ref(device), backbones)?;
        let dataset = Dataset::new(&recipe.data, files.pack)?;
        let aligner = trainer.averaged().aligner(recipe, device)?;
        let bursts = BurstSampler::new(recipe, dataset, aligner);
        let mut prefetcher = Prefetcher::<L>::new(recipe, &bursts, 0, workers)?;
        if let Some(card) = trainer.card() {
            prefetcher = prefetcher.uploading(card)?;
        }
        for _ in 0..WARM_UP {
            trainer.begin_step(&mut prefetcher)?;
        }
        let (counted, operations) = count_operations(|| trainer.begin_step(&mut prefetcher));
        counted?;
        trainer.finish()?;
        let start = Instant::now();
        let mut reports: Vec<StepReport> = Vec::new();
        let mut steps = 0;
        while start.elapsed().as_secs_f64() < seconds {
            reports.extend(trainer.begin_step(&mut prefetcher)?);
            steps += 1;
            if on(start.elapsed().as_secs_f64()).is_break() {
                return Err(Error::Interrupted);
            }
        }
        reports.extend(trainer.finish()?);
        let step_s = start.elapsed().as_secs_f64() / f64::from(steps);
        trainer.waits = true;
        let parts = (0..TIMED_BY_PARTS).map(|_| trainer.step(&mut prefetcher));
        let parts = parts.collect::<Result<Vec<_>>>()?;
        let batch = recipe.train.batch * recipe.train.accumulate;
        let mean = |part: fn(&StepReport) -> f64| {
            reports.iter().map(part).sum::<f64>() / reports.len() as f64
        };
        let median = |part: fn(&StepReport) -> f64| {
            let mut times: Vec<f64> = parts.iter().map(part).collect();
            times.sort_by(f64::total_cmp);
            times[times.len() / 2]
        };
        Ok(Self {
            batch,
            steps: reports.len(),
            samples_per_second: batch as f64 / step_s,
            tflops: operations as f64 / step_s * 1e-12,
            step_s,
            host_s: mean(|report| report.forward_s + report.backward_s + report.optimizer_s),
            data_s: mean(|report| report.data_s),
            forward_s: median(|report| report.forward_s),
            backward_s: median(|report| report.backward_s),
            optimizer_s: median(|report| report.optimizer_s),
        })
    }
}
