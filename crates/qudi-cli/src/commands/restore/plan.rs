//! The plan of a restoration: its arguments, checked once.

use super::args::{Restore, Tonemap};
use crate::args::tiff_samples::tiff_samples;
use crate::args::{Global, Shard, Sum};
use crate::capture::{Input, LightOverrides, Source, is_pipe, refuse_terminal};
use crate::colour::Gains;
use crate::error::{CliError, Result};
use crate::methods::Method;
use crate::methods::options::NetworkOptions;
use qudi_core::atomic_file::{Overwrite, refuse_taken};
use qudi_io::description::{MaskChoice, ReadOptions};
use qudi_io::writer::TiffSamples;
use std::path::{Path, PathBuf};

/// Default frames per second of played outputs: at the capture's rate, thousands of frames would be over at
/// once.
const PLAYED_FPS: f64 = 25.0;

/// The checked options of a restoration.
#[derive(Debug)]
pub(super) struct Plan {
    /// Path of the capture; `-` for a pipe.
    pub(super) capture: PathBuf,
    /// Path of the output; `-` for standard output.
    pub(super) output: String,
    /// Name of the sensor, unless record or format give it.
    pub(super) sensor: Option<String>,
    pub(super) read: ReadOptions,
    /// Number of frames summed, if given.
    pub(super) sum: Option<Sum>,
    /// Native frames from one picture to the next, if not every frame becomes one.
    pub(super) every: Option<u64>,
    /// The tone curve, if one is named.
    pub(super) tonemap: Option<Tonemap>,
    /// True if luma alone is asked for.
    pub(super) gray: bool,
    /// True if luma alone is restored of a capture behind a colour filter.
    pub(super) luma_alone: bool,
    pub(super) white_balance: Option<Gains>,
    /// Frames per second of played outputs.
    pub(super) played_fps: f64,
    pub(super) light: LightOverrides,
    /// The method, unless the capture decides.
    pub(super) method: Option<&'static Method>,
    pub(super) network: NetworkOptions,
    /// Frames that neighbouring windows share.
    pub(super) overlap: u64,
    pub(super) shard: Option<Shard>,
    pub(super) tiff: TiffSamples,
    pub(super) chi_square_map: Option<PathBuf>,
    pub(super) side_by_side: Option<PathBuf>,
    pub(super) html: Option<PathBuf>,
    pub(super) uncertainty: Option<PathBuf>,
    pub(super) overwrite: Overwrite,
}

impl Plan {
    /// Checks the arguments; `json` is true if a document goes to standard output.
    ///
    /// # Errors
    /// [`CliError`] for arguments that do not go together, outputs that are inputs, and outputs that exist.
    pub(super) fn new(args: &Restore, global: &Global, json: bool) -> Result<Self> {
        if args.output == "-" && json {
            return Err(CliError::new(
                "--json and -o - both write to standard output",
                "--json",
                "write the frames to a file",
            ));
        }
        let overwrite = global.overwrite();
        let beside = [&args.chi_map, &args.side_by_side, &args.html, &args.uncertainty];
        for path in beside.into_iter().flatten() {
            refuse_taken(path, overwrite)?;
        }
        let shows = [(&args.side_by_side, "--side-by-side"), (&args.html, "--html")];
        let shows = shows.into_iter().find(|(path, _)| path.is_some());
        if let (Some(_), Some((_, flag))) = (args.shard, shows) {
            return Err(CliError::new(
                "a part of the work has not all the frames to show",
                flag,
                "ask for it when all parts are done: the same command without --shard",
            ));
        }
        let network = args.network.options(args.steps.steps, &args.given);
        if let Some(method) = args.method {
            network.check_methods(&[method])?;
        }
        let mut read = args.reading.options(MaskChoice::Auto);
        read.full_colour = read.channel.is_none();
        let plan = Self {
            capture: args.capture.clone(),
            output: args.output.clone(),
            sensor: args.sensor.clone(),
            read,
            sum: args.reading.sum(),
            every: args.every,
            tonemap: args.tonemap,
            gray: args.gray,
            luma_alone: args.gray,
            white_balance: args.wb,
            played_fps: args.fps.unwrap_or(PLAYED_FPS),
            light: LightOverrides {
                ppp: args.ppp,
                gain: args.gain,
                mean_level: args.mean_level,
                seed: args.seed.unwrap_or(0),
                white: None,
            },
            method: args.method,
            network,
            overlap: args.overlap,
            shard: args.shard,
            tiff: tiff_samples(args.float, Path::new(&args.output))?,
            chi_square_map: args.chi_map.clone(),
            side_by_side: args.side_by_side.clone(),
            html: args.html.clone(),
            uncertainty: args.uncertainty.clone(),
            overwrite,
        };
        plan.check_output()?;
        if args.fps.is_some() && !plan.plays() {
            return Err(CliError::new(
                format!("{} does not play: it holds frames without a rate", plan.output),
                "--fps",
                "leave it out, or write .gif, .mp4 or - (Y4M)",
            ));
        }
        if plan.reads_pipe() {
            plan.check_pipe()?;
        }
        Ok(plan)
    }

    /// Returns true if the output has a frame rate of its own.
    fn plays(&self) -> bool {
        let extension = Path::new(&self.output).extension();
        let extension = extension.map(|e| e.to_string_lossy().to_lowercase());
        self.output == "-" || matches!(extension.as_deref(), Some("gif" | "mp4"))
    }

    /// Returns the tone curve of gray frames.
    pub(super) fn tonemap(&self) -> Tonemap {
        self.tonemap.unwrap_or(Tonemap::None)
    }

    /// Returns the capture as the plan names it.
    pub(super) fn source(&self) -> Source<'_> {
        Source {
            input: Input::at((!self.reads_pipe()).then_some(self.capture.as_path())),
            options: &self.read,
            sum: self.sum,
            sensor: self.sensor.as_deref(),
            judged: u64::MAX,
        }
    }

    /// Returns true if the capture comes through standard input.
    pub(super) fn reads_pipe(&self) -> bool {
        is_pipe(&self.capture)
    }

    /// Refuses an existing output before any work is done. Folders may be resumed.
    fn check_output(&self) -> Result<()> {
        let folder = Path::new(&self.output).extension().is_none() && self.output != "-";
        if self.shard.is_some() && !folder {
            return Err(CliError::new(
                "parts of the work can only meet in a folder",
                "--shard",
                "give a name without extension",
            ));
        }
        if !folder && self.output != "-" {
            refuse_taken(Path::new(&self.output), self.overwrite)?;
        }
        Ok(())
    }

    /// Refuses options that need a capture which can be read again.
    fn check_pipe(&self) -> Result<()> {
        refuse_terminal("cat burst.npy | qudi restore - -o out")?;
        if self.shard.is_some() {
            return Err(CliError::new(
                "a pipe comes once and whole",
                "--shard",
                "store the capture in a file to share the work",
            ));
        }
        if self.output != "-" {
            // The same frames may not come again, so that a folder is not resumed.
            refuse_taken(Path::new(&self.output), self.overwrite)?;
        }
        Ok(())
    }
}
