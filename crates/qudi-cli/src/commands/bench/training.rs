//! `qudi bench --train`: speed of whole training steps.

use super::args::Bench;
use crate::device;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::Report;
use crate::settings::Settings;
use qudi_baselines::learning::Baseline;
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::Diffusion;
use qudi_model::regression::Regression;
use qudi_model::window::Window;
use qudi_train::dataset::Pack;
use qudi_train::{Files, Learner, NetworkRecipe, Recipe, TrainingSpeed, default_workers};
use serde_json::json;

/// Trains the recipe for a while and reports its speed.
pub(super) fn run(recipe: &str, args: &Bench, settings: &Settings, report: &Report) -> Result<()> {
    let recipe = settings.recipe(recipe)?;
    let measure = match recipe.network {
        NetworkRecipe::Qudi(NetworkConfig::Regression(_)) => measure::<Regression>,
        NetworkRecipe::Qudi(NetworkConfig::Diffusion(_)) => measure::<Diffusion>,
        NetworkRecipe::Qudi(NetworkConfig::Window(_)) => measure::<Window>,
        NetworkRecipe::Baseline(_) => measure::<Baseline>,
    };
    measure(&recipe, args, report)
}

fn measure<L: Learner>(recipe: &Recipe, args: &Bench, report: &Report) -> Result<()> {
    let opened = device::open(args.network.device().unwrap_or("auto"))?;
    let sources = recipe.packed_sources();
    let pack = args.pack.as_deref().map(|path| Pack::open(path, &sources)).transpose()?;
    let files = Files { pack, bursts: None };
    let mut bar = report.bar();
    let measured = device::guarded(&opened.name, || {
        TrainingSpeed::measure::<L>(
            recipe,
            files,
            &opened.device,
            args.backbones.as_deref(),
            args.workers.unwrap_or_else(default_workers),
            args.seconds,
            &mut |seconds| {
                bar.update("training", seconds as u64, Some(args.seconds as u64));
                interrupt::check()
            },
        )
    });
    drop(bar);
    let speed = match measured {
        Ok(Err(qudi_core::Error::Interrupted)) => return Err(CliError::Interrupted),
        Ok(measured) => measured?,
        Err(problem) => {
            let what = format!("the device failed: {problem}");
            return Err(CliError::new(what, "--device", "lower train.batch or data.crop"));
        }
    };
    let share = |seconds: f64| 100.0 * seconds / speed.step_s;
    let text = format!(
        "{:.2} samples/s on {}: {} steps of {} samples, {:.1} ms each, {:.3} TFLOP/s\n\
         of a step: {:.0} % until the device has been asked for it, {:.0} % waiting for data\n\
         parts, each waited for: forward {:.1} ms, backward {:.1} ms, optimizer {:.1} ms",
        speed.samples_per_second,
        opened.name,
        speed.steps,
        speed.batch,
        1e3 * speed.step_s,
        speed.tflops,
        share(speed.host_s),
        share(speed.data_s),
        1e3 * speed.forward_s,
        1e3 * speed.backward_s,
        1e3 * speed.optimizer_s,
    );
    report.result(&text, || json!({"device": opened.name, "speed": speed}))
}
