//! The folder of a run: which files a run writes there, whose they are, and one run at a time.

use super::environment::ENVIRONMENT;
use super::plan::{Action, Plan};
use super::watch::{REPORT, SAMPLES};
use crate::error::{CliError, Result};
use qudi_core::atomic_file::Overwrite;
use qudi_core::limits::RECORD_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_io::restore::{FolderLock, Share};
use qudi_train::{METRICS, RECIPE, WEIGHTS, remove_state, run_exists};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Files and folders of a run, and the state's folder.
const OWN: [&str; 7] = [RECIPE, METRICS, WEIGHTS, ENVIRONMENT, REPORT, SAMPLES, "state"];

/// Returns what a run writes in `folder`: files of fixed names, and the folders of stages that are there.
pub(crate) fn run_files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = OWN.iter().map(|name| folder.join(name)).collect();
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    files.extend(entries.map(|entry| entry.path()).filter(|path| is_stage(path)));
    files
}

/// Returns true for `2-NAME` with a run in it.
fn is_stage(folder: &Path) -> bool {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let number = name.split_once('-').is_some_and(|(number, _)| number.parse::<usize>().is_ok());
    number && OWN.iter().any(|name| folder.join(name).exists())
}

/// The folder of a run, locked until it is dropped. It is removed again if nothing was written into it.
#[derive(Debug)]
pub(super) struct RunFolder {
    /// Folders that were made, the innermost first.
    made: Vec<PathBuf>,
    _lock: FolderLock,
}

impl RunFolder {
    /// Makes the folder where there is none, and locks it.
    ///
    /// # Errors
    /// [`CliError`] if it cannot be made, or another run writes into it.
    pub(super) fn open(folder: &Path) -> Result<Self> {
        let missing = folder
            .ancestors()
            .take_while(|path| !path.as_os_str().is_empty() && path.symlink_metadata().is_err());
        let made = missing.map(Path::to_owned).collect();
        std::fs::create_dir_all(folder).map_err(|e| {
            let what = format!("cannot make the run's folder: {e}");
            CliError::new(what, folder.display(), "choose another with -o")
        })?;
        Ok(Self { made, _lock: FolderLock::take(folder, Share::Whole)? })
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        for folder in &self.made {
            // Fails where anything lies in it.
            if std::fs::remove_dir(folder).is_err() {
                break;
            }
        }
    }
}

/// Refuses a folder without a state to resume from, with a run that would be lost, or with files of others.
pub(super) fn check_folder(plan: &Plan) -> Result<()> {
    let folder = &plan.folder;
    let exists = run_exists(folder);
    if plan.action == Action::Resume {
        return if exists { Ok(()) } else { Err(no_state(folder)) };
    }
    let Some(taken) = OWN.iter().find(|name| folder.join(name).symlink_metadata().is_ok()) else {
        return Ok(());
    };
    if plan.overwrite == Overwrite::No {
        let help = if run_files(folder).iter().any(|stage| exists || run_exists(stage)) {
            "go on with --resume, choose another folder, or start anew with --force"
        } else {
            "choose another folder, or start anew with --force"
        };
        return Err(CliError::new("the folder holds a run already", folder.display(), help));
    }
    if is_ours(folder) {
        return Ok(());
    }
    Err(CliError::new(
        format!("`{taken}` lies there, and no {ENVIRONMENT} says that this program wrote it"),
        folder.display(),
        "choose another folder, or move the file away",
    ))
}

fn no_state(folder: &Path) -> CliError {
    CliError::new(
        "there is no state to go on from",
        folder.display(),
        "start without --resume, or name the run's folder with -o",
    )
}

/// Returns true if this program wrote the run in `folder`.
fn is_ours(folder: &Path) -> bool {
    let text = read_limited(&folder.join(ENVIRONMENT), RECORD_BYTES, "read the run");
    let environment: Option<Value> = text.ok().and_then(|text| serde_json::from_slice(&text).ok());
    let program = environment.as_ref().and_then(|document| document["program"].as_str());
    program.is_some_and(|program| program.starts_with("qudi "))
}

/// Removes the state and the metrics of an earlier run, for which a new one must not be taken.
///
/// # Errors
/// [`CliError`] if another program's file lies in the state's place.
pub(super) fn clear(folder: &Path) -> Result<()> {
    remove_state(folder)?;
    match std::fs::remove_file(folder.join(METRICS)) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
            Err(qudi_core::Error::io("remove the metrics", &folder.join(METRICS), e).into())
        }
        _ => Ok(()),
    }
}
