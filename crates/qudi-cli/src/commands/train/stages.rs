//! Recipes of several stages: one run after the other, each in a folder of its own.

use super::data::{files, make_folder};
use super::plan::{Action, Plan};
use super::run::{check_folder, train};
use super::watch::write;
use crate::error::{CliError, Result};
use crate::report::Report;
use qudi_core::atomic_file::Overwrite;
use qudi_train::{RECIPE, Recipe, Run, WEIGHTS};
use serde_json::json;

/// Trains all stages, or those that are left, and puts the last one's weights into the run's folder.
pub(super) fn train_stages(
    plan: &Plan,
    stages: Vec<(String, Recipe)>,
    report: &Report,
) -> Result<()> {
    let folder = &plan.folder;
    let resumes = plan.action == Action::Resume;
    if !resumes {
        check_folder(plan)?;
    } else if !folder.join(RECIPE).exists() {
        return Err(CliError::new(
            "there is no run to go on with",
            folder.display(),
            "start without --resume, or name the run's folder with -o",
        ));
    }
    make_folder(folder, "the run's folder", "choose another with -o")?;
    // A run whose files are not there leaves nothing behind.
    files(plan, report)?;
    write(folder, RECIPE, plan.recipe.text().as_bytes())?;
    let count = stages.len();
    let mut init = plan.init.clone();
    let mut weights = folder.join(WEIGHTS);
    for (number, (name, recipe)) in stages.into_iter().enumerate() {
        let own = format!("{}-{name}", number + 1);
        let stage = Plan {
            folder: folder.join(&own),
            bursts: plan.bursts.as_ref().map(|bursts| bursts.join(&own)),
            init: init.take(),
            recipe,
            action: Action::Start,
            ..plan.clone()
        };
        weights = stage.folder.join(WEIGHTS);
        init = Some(weights.clone());
        let exists = Run::exists(&stage.folder);
        if resumes && exists && Run::steps_taken(&stage.folder)? >= stage.recipe.train.steps {
            continue;
        }
        report.remark(&format!("stage {} of {count}: {name}", number + 1));
        if resumes && exists {
            train(&Plan { action: Action::Resume, init: None, ..stage }, report)?;
        } else {
            // What an interrupted run left before its first state is of no use.
            let overwrite = if resumes { Overwrite::Yes } else { stage.overwrite };
            train(&Plan { overwrite, ..stage }, report)?;
        }
    }
    let bytes = std::fs::read(&weights)
        .map_err(|e| qudi_core::Error::io("read the last stage's weights", &weights, e))?;
    write(folder, WEIGHTS, &bytes)?;
    let weights = folder.join(WEIGHTS);
    let text = format!("{}: the last of {count} stages", weights.display());
    report.result(&text, || json!({"weights": weights, "stages": count}))
}
