//! Options of `qudi train`.

use crate::args::number;
use clap::{Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// Learn a network from videos, stills and procedural scenes
///
/// A recipe says everything that decides the result; --set KEY=VALUE changes it, as in --set
/// train.steps=1000. The run's folder gets the recipe, metrics, pictures, weights.safetensors for `qudi
/// restore --weights`, and the state that --resume goes on from, exactly.
#[derive(Debug, ClapArgs)]
pub(crate) struct Train {
    /// The recipe: tiny, small, window, correction, paper-mini, paper, a learned baseline (quiver, emvd,
    /// flornn, spk2imgnet, memdeblur, rvrt, student-teacher), or a .toml file [default with --resume: the
    /// run's own]
    pub(crate) recipe: Option<String>,
    /// Folder of the run
    #[arg(short, long, value_name = "FOLDER", value_hint = ValueHint::DirPath, required_unless_present = "prepare")]
    pub(crate) output: Option<PathBuf>,
    /// Folder that the recipe's files lie in
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::DirPath)]
    pub(crate) data: Option<PathBuf>,
    /// Decoded data in one file; made from --data if it is not there [default: pack.zip in the run's folder]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) pack: Option<PathBuf>,
    /// Leave out clips that cannot be read, each with a warning, when the pack is made
    #[arg(long)]
    pub(crate) skip_bad: bool,
    /// Folder for the bursts of recipes with train.crops, with their reference estimates: those there are not
    /// drawn again
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::DirPath)]
    pub(crate) bursts: Option<PathBuf>,
    /// Make the pack, draw the bursts if --bursts is given, and train nothing
    #[arg(long, conflicts_with = "output")]
    pub(crate) prepare: bool,
    /// Go on from the run's last state
    #[arg(long, conflicts_with_all = ["prepare", "init"])]
    pub(crate) resume: bool,
    /// Start from these weights of the same network instead of random ones
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) init: Option<PathBuf>,
    /// Where it runs, as for restore; several share the batches, as in cuda:0,cuda:1
    #[arg(long, value_name = "NAME,...", value_delimiter = ',', default_value = "auto")]
    pub(crate) device: Vec<String>,
    /// Stop after this time, with the state written, as Ctrl-C does: --resume goes on
    #[arg(long, value_name = "S", allow_negative_numbers = true, value_parser = number::real(number::SECONDS), conflicts_with = "prepare")]
    pub(crate) seconds: Option<f64>,
    /// Threads that draw samples; results do not depend on it [default: one less than the cores, at most 15]
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=number::MAX_THREADS))]
    pub(crate) workers: Option<usize>,
    /// Folder with the weights of LPIPS, made by scripts/convert/lpips.py [default: where Burn keeps them]
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::DirPath)]
    pub(crate) backbones: Option<PathBuf>,
}
