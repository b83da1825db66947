//! What a run learns from: decoded files, cached bursts.

use super::plan::Plan;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::Report;
use qudi_core::atomic_file::Overwrite;
use qudi_train::Files;
use qudi_train::dataset::{Pack, write_pack};
use std::path::Path;

/// Returns the files that the recipe learns from, made first if they do not exist.
pub(super) fn files(plan: &Plan, report: &Report) -> Result<Files> {
    if let Some(folder) = &plan.bursts {
        make_folder(folder, "the folder of bursts", "choose another with --bursts")?;
    }
    let pack = pack(plan, report)?;
    Ok(Files { pack, bursts: plan.bursts.clone() })
}

pub(super) fn make_folder(folder: &Path, what: &str, help: &str) -> Result<()> {
    std::fs::create_dir_all(folder)
        .map_err(|e| CliError::new(format!("cannot make {what}: {e}"), folder.display(), help))
}

/// Opens the recipe's decoded files, made first if they do not exist.
fn pack(plan: &Plan, report: &Report) -> Result<Option<Pack>> {
    if !plan.recipe.data.needs_files() && plan.recipe.validation_data().is_none() {
        return Ok(None);
    }
    if !plan.pack.exists() {
        make_pack(plan, Overwrite::No, report)?;
    }
    Ok(Some(Pack::open(&plan.pack)?))
}

/// Decodes the recipe's files into a pack.
pub(super) fn make_pack(plan: &Plan, overwrite: Overwrite, report: &Report) -> Result<()> {
    let Some(data) = &plan.data else {
        return Err(CliError::new(
            "the recipe reads files",
            "--data",
            "name the folder that they lie in, or a pack with --pack",
        ));
    };
    let validation = plan.recipe.validation_data();
    let mut configs = vec![&plan.recipe.data];
    configs.extend(&validation);
    let mut bar = report.bar();
    write_pack(&configs, data, &plan.pack, overwrite, &mut |progress| {
        let [done, total] = progress.done;
        bar.update("decoding", done as u64, Some(total as u64));
        interrupt::check()
    })?;
    Ok(())
}
