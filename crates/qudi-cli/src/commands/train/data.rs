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
    let sources = plan.recipe.packed_sources();
    if sources.is_empty() {
        return Ok(None);
    }
    if !plan.pack.exists() {
        make_pack(plan, Overwrite::No, report)?;
    }
    Ok(Some(Pack::open(&plan.pack, &sources)?))
}

/// Decodes the recipe's files into a pack, and returns the mean PSNR of its frames for training.
pub(super) fn make_pack(plan: &Plan, overwrite: Overwrite, report: &Report) -> Result<Option<f64>> {
    let Some(data) = &plan.data else {
        return Err(CliError::new(
            "the recipe reads files",
            "--data",
            "name the folder that they lie in, or a pack with --pack",
        ));
    };
    let mut bar = report.bar();
    let sources = plan.recipe.packed_sources();
    let mut skipped = Vec::new();
    let list = plan.skip_bad.then_some(&mut skipped);
    let psnr = write_pack(&sources, data, &plan.pack, overwrite, list, &mut |progress| {
        let [done, total] = progress.done;
        bar.update("decoding", done as u64, Some(total as u64));
        interrupt::check()
    })?;
    drop(bar);
    for clip in skipped {
        report.warning(&format!("left out of the pack, since it cannot be read: {clip}"));
    }
    Ok(psnr)
}
