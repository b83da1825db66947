//! Recipes of several stages: one run after the other, each in a folder of its own.

use super::data::files;
use super::environment::{ENVIRONMENT, environment};
use super::plan::{Action, Plan};
use super::resume::check_recipe;
use super::run::{check_init, find_backbones, train};
use super::run_folder::{RunFolder, check_folder, clear};
use super::watch::write;
use crate::device;
use crate::error::{CliError, Result};
use crate::report::Report;
use qudi_core::atomic_file::Overwrite;
use qudi_train::dataset::{Dataset, Pack};
use qudi_train::{RECIPE, Recipe, Validator, WEIGHTS, run_exists, steps_taken};
use serde_json::json;

/// Trains all stages, or those that are left, and puts the last one's weights into the run's folder.
pub(super) fn train_stages(
    plan: &Plan,
    stages: Vec<(String, Recipe)>,
    report: &Report,
) -> Result<()> {
    let folder = &plan.folder;
    let stages: Vec<Plan> =
        stages.into_iter().enumerate().map(|stage| of_stage(plan, stage)).collect();
    if plan.action == Action::Start {
        // No stage of an earlier run may be taken for one of this.
        std::iter::once(plan).chain(&stages).try_for_each(check_folder)?;
    } else if !folder.join(RECIPE).exists() {
        return Err(CliError::new(
            "there is no run to go on with",
            folder.display(),
            "start without --resume, or name the run's folder with -o",
        ));
    }
    // Before anything is written: a recipe that is refused must not become the run's.
    for stage in stages.iter().filter(|stage| run_exists(&stage.folder)) {
        check_recipe(&stage.folder, &stage.recipe)?;
    }
    stages.iter().try_for_each(find_backbones)?;
    let devices = plan.devices.iter().map(|name| device::open(name)).collect::<Result<Vec<_>>>()?;
    let _folder = RunFolder::open(folder)?;
    // A run whose files are not there leaves nothing behind, and no stage is trained for one that cannot be.
    files(plan, report)?;
    for stage in &stages {
        let sources = stage.recipe.packed_sources();
        let pack = (!sources.is_empty()).then(|| Pack::open(&plan.pack, &sources)).transpose()?;
        Validator::new(&stage.recipe, pack.as_ref())?;
        Dataset::new(&stage.recipe.data, pack)?;
    }
    if plan.action == Action::Start {
        if let Some(first) = stages.first() {
            check_init(first, plan.init.as_deref(), &devices[0].device)?;
        }
        std::iter::once(plan).chain(&stages).try_for_each(|plan| clear(&plan.folder))?;
    }
    write(folder, ENVIRONMENT, environment(&devices, &plan.pack)?.as_bytes())?;
    write(folder, RECIPE, plan.recipe.text().as_bytes())?;
    let count = stages.len();
    let mut init = plan.init.clone();
    for (number, stage) in stages.into_iter().enumerate() {
        let weights = stage.folder.join(WEIGHTS);
        let from = init.replace(weights);
        let exists = run_exists(&stage.folder);
        if exists && steps_taken(&stage.folder)? >= stage.recipe.train.steps {
            continue;
        }
        report.remark(&format!("stage {} of {count}: {}", number + 1, stage.folder.display()));
        if exists {
            train(&Plan { action: Action::Resume, ..stage }, report)?;
        } else {
            // What was left without a state is of no use.
            train(
                &Plan { action: Action::Start, init: from, overwrite: Overwrite::Yes, ..stage },
                report,
            )?;
        }
    }
    let weights = init.unwrap_or_default();
    let bytes = std::fs::read(&weights)
        .map_err(|e| qudi_core::Error::io("read the last stage's weights", &weights, e))?;
    write(folder, WEIGHTS, &bytes)?;
    let weights = folder.join(WEIGHTS);
    let text = format!("{}: the last of {count} stages", weights.display());
    report.result(&text, || json!({"weights": weights, "stages": count}))
}

/// Returns the plan of stage `number`, in a folder of its own.
fn of_stage(plan: &Plan, (number, (name, recipe)): (usize, (String, Recipe))) -> Plan {
    let own = format!("{}-{name}", number + 1);
    Plan {
        folder: plan.folder.join(&own),
        bursts: plan.bursts.as_ref().map(|bursts| bursts.join(&own)),
        init: None,
        recipe,
        ..plan.clone()
    }
}
