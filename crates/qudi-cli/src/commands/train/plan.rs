//! The plan of a training run: arguments and settings, checked once.

use super::args::Train;
use crate::args::Global;
use crate::error::{CliError, Result};
use crate::settings::Settings;
use qudi_core::atomic_file::Overwrite;
use qudi_train::{RECIPE, Recipe, default_workers, recipe_names};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Action of a training run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Action {
    /// Pack the recipe's files, and draw its bursts.
    Prepare,
    /// Train from initial weights.
    Start,
    /// Train from the last state.
    Resume,
}

/// Everything that a training run is asked for.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) action: Action,
    pub(super) recipe: Recipe,
    /// The folder of the run, or of the bursts that are drawn.
    pub(super) folder: PathBuf,
    /// The folder of the recipe's files.
    pub(super) data: Option<PathBuf>,
    /// The decoded files.
    pub(super) pack: PathBuf,
    /// The folder of cached bursts.
    pub(super) bursts: Option<PathBuf>,
    /// Weights to start from.
    pub(super) init: Option<PathBuf>,
    pub(super) devices: Vec<String>,
    /// The time to stop.
    pub(super) end: Option<Instant>,
    /// Threads that draw samples.
    pub(super) workers: usize,
    pub(super) backbones: Option<PathBuf>,
    /// True if clips that cannot be read are left out of the pack.
    pub(super) skip_bad: bool,
    pub(super) overwrite: Overwrite,
}

impl Plan {
    /// Checks arguments and settings.
    ///
    /// # Errors
    /// [`CliError`] if there is no recipe, or a key of it is wrong.
    pub(super) fn new(args: &Train, settings: &Settings, global: &Global) -> Result<Self> {
        let action = match (args.prepare, args.resume) {
            (true, _) => Action::Prepare,
            (_, true) => Action::Resume,
            _ => Action::Start,
        };
        if args.prepare && args.pack.is_none() && args.bursts.is_none() {
            let help =
                "name a pack with --pack or, for a recipe with train.crops, a folder with --bursts";
            return Err(CliError::new("there is nothing to prepare", "--prepare", help));
        }
        let folder = if args.prepare { &args.bursts } else { &args.output };
        let folder = folder.clone().unwrap_or_default();
        Ok(Self {
            action,
            recipe: recipe(args, settings)?,
            pack: args.pack.clone().unwrap_or_else(|| folder.join("pack.zip")),
            folder,
            data: args.data.clone(),
            bursts: args.bursts.clone(),
            init: args.init.clone(),
            devices: args.device.clone(),
            end: args.seconds.map(|seconds| Instant::now() + Duration::from_secs_f64(seconds)),
            workers: args.workers.unwrap_or_else(default_workers),
            backbones: args.backbones.clone(),
            skip_bad: args.skip_bad,
            overwrite: global.overwrite(),
        })
    }
}

fn recipe(args: &Train, settings: &Settings) -> Result<Recipe> {
    let own = args.output.as_ref().map(|folder| folder.join(RECIPE));
    let name = match (&args.recipe, own) {
        (Some(name), _) => name.clone(),
        (None, Some(own)) if args.resume => own.display().to_string(),
        _ => {
            let names: Vec<_> = recipe_names().collect();
            return Err(CliError::new(
                "no recipe",
                "RECIPE",
                format!("name one: {}, or a .toml file", names.join(", ")),
            ));
        }
    };
    settings.recipe(&name)
}
