//! What a command reads and writes: no output is an input, and no two outputs are one, whatever `--force`
//! says.

mod extensions;
mod identity;
mod inputs;
mod outputs;

use crate::args::{Command, Global};
use crate::error::{CliError, Result};
use crate::settings::Settings;
use identity::Identity;
use std::path::{Path, PathBuf};

pub(crate) use outputs::{calibration_maps, default_look};

/// Refuses a command whose outputs are, hold, or lie among its inputs, outputs that are one, and places where
/// no file can be.
///
/// # Errors
/// A [`CliError`] that names the output and what it would destroy.
pub(crate) fn check(command: &Command, settings: &Settings, global: &Global) -> Result<()> {
    let outputs = outputs::outputs_of(command, global);
    if outputs.is_empty() {
        return Ok(());
    }
    let inputs = inputs::inputs_of(command, settings, global);
    check_all(&inputs, &outputs)?;
    extensions::check(command)
}

fn check_all(inputs: &[PathBuf], outputs: &[PathBuf]) -> Result<()> {
    let inputs: Vec<_> = inputs.iter().filter(|path| is_path(path) && path.exists()).collect();
    let inputs: Vec<_> = inputs.into_iter().map(|path| (path, Identity::of(path))).collect();
    let outputs: Vec<_> = outputs.iter().filter(|path| is_path(path)).collect();
    for (n, output) in outputs.iter().enumerate() {
        refuse_impossible(output)?;
        let own = Identity::of(output);
        for (input, other) in &inputs {
            let exists = output.symlink_metadata().is_ok();
            let what = if own.is(other) {
                "the output is an input".to_owned()
            } else if own.holds(other) && exists {
                format!("the output holds the input {}", input.display())
            } else if other.holds(&own) && exists {
                format!("the output is part of the input {}", input.display())
            } else {
                continue;
            };
            return Err(CliError::new(what, output.display(), "choose another name"));
        }
        for other in &outputs[..n] {
            let second = Identity::of(other);
            let what = if own.is(&second) {
                "two outputs are one file"
            } else if own.holds(&second) || second.holds(&own) {
                "one output lies in another"
            } else {
                continue;
            };
            return Err(CliError::new(what, output.display(), "give them names of their own"));
        }
    }
    Ok(())
}

/// Refuses devices, pipes and folders that do not exist, before the work and not after it.
fn refuse_impossible(output: &Path) -> Result<()> {
    if std::fs::metadata(output).is_ok_and(|kind| !kind.is_file() && !kind.is_dir()) {
        return Err(CliError::new("not a regular file", output.display(), "name a file to write"));
    }
    let parent = output.parent().filter(|parent| !parent.as_os_str().is_empty());
    match parent {
        Some(parent) if !parent.is_dir() => Err(CliError::new(
            format!("cannot create the output: {} is not a folder", parent.display()),
            output.display(),
            "make the folder first, or choose another",
        )),
        _ => Ok(()),
    }
}

/// Returns false for `-` and names that are no path.
fn is_path(path: &Path) -> bool {
    !path.as_os_str().is_empty() && path.as_os_str() != "-"
}
