//! The plan of a simulation: arguments and settings, checked once.

use super::args::Simulate;
use crate::args::Global;
use crate::args::number::COUNT;
use crate::args::tiff_samples::tiff_samples;
use crate::error::{CliError, Result};
use crate::settings::Settings;
use qudi_core::atomic_file::{Overwrite, refuse_taken};
use qudi_core::colour::FilterChoice;
use qudi_core::{Error, Transfer};
use qudi_io::sidecar::Record;
use qudi_io::writer::{BurstFormat, Planes, TiffSamples};
use qudi_sim::Simulation;
use qudi_sim::clip::{Input, Sampling};
use std::hash::{BuildHasher, RandomState};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

/// Everything that a simulation is asked for.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) simulation: Simulation,
    /// The checksum of the clip in the record that is simulated again, and that record.
    pub(super) recorded: Option<(u32, PathBuf)>,
    pub(super) outputs: OutputPlan,
}

/// The files that a simulation writes.
#[derive(Debug)]
pub(super) struct OutputPlan {
    /// Place of the burst; `-` for standard output.
    pub(super) output: String,
    pub(super) format: BurstFormat,
    /// Full scale of the counts.
    pub(super) max_count: u16,
    pub(super) truth: Option<PathBuf>,
    /// Planes of the truth.
    pub(super) planes: Planes,
    /// Samples of the truth's `.tif`.
    pub(super) tiff: TiffSamples,
    pub(super) flow: Option<PathBuf>,
    pub(super) preview: Option<PathBuf>,
    /// The file next to the burst that visionsim looks for.
    pub(super) transforms: Option<PathBuf>,
    pub(super) overwrite: Overwrite,
}

impl Plan {
    /// Checks arguments and settings; `json` says that a document goes to standard output.
    ///
    /// # Errors
    /// [`CliError`] for arguments that do not go together, outputs that are inputs, and outputs that exist.
    pub(super) fn new(
        args: &Simulate,
        settings: Settings,
        global: &Global,
        json: bool,
    ) -> Result<Self> {
        if args.output == "-" && json {
            return Err(CliError::new(
                "--json and -o - both write to standard output",
                "--json",
                "write the burst to a file",
            ));
        }
        let (simulation, recorded) = match &args.from {
            Some(path) => {
                reject_settings_beside_record(args, global)?;
                let record = Record::load(path)?;
                (record.simulation, Some((record.clip.crc32, path.clone())))
            }
            None => (simulation(args, &settings.with_flags(&args.keys)?)?, None),
        };
        if matches!(simulation.input, Input::Pipe { .. }) && std::io::stdin().is_terminal() {
            return Err(CliError::new(
                "nothing is piped in",
                "standard input",
                "pipe a clip in, as in `ffmpeg -i VIDEO -f yuv4mpegpipe - | qudi simulate - -o OUT`",
            ));
        }
        let overwrite = global.overwrite();
        if args.flow.is_some() && !simulation.input.is_synthetic() {
            return Err(CliError::new(
                "a recorded clip has no known flow",
                "--flow",
                "leave it out, or use a still in motion or a procedural scene",
            ));
        }
        let transforms = Path::new(&args.output).with_file_name("transforms.json");
        let transforms = args.visionsim.then_some(transforms);
        let max_count = simulation.sensor.max_count();
        let outputs = OutputPlan {
            output: args.output.clone(),
            format: format(args, max_count)?,
            max_count,
            truth: args.truth.clone(),
            planes: match &simulation.sensor.colour {
                Some(colour) if colour.cfa.is_some() => Planes::Rgb,
                _ => Planes::Gray,
            },
            tiff: match &args.truth {
                Some(path) => tiff_samples(args.float, path)?,
                None => TiffSamples::U16,
            },
            flow: args.flow.clone(),
            preview: args.preview.clone(),
            transforms,
            overwrite,
        };
        outputs.check()?;
        Ok(Self { simulation, recorded, outputs })
    }
}

impl OutputPlan {
    /// Refuses names that are taken, before the clip is read.
    fn check(&self) -> Result<()> {
        let path = PathBuf::from(&self.output);
        let burst = (!self.to_stdout()).then(|| [path.clone(), self.format.record_path(&path)]);
        let beside = [&self.truth, &self.flow, &self.preview, &self.transforms];
        for path in burst.iter().flatten().chain(beside.into_iter().flatten()) {
            refuse_taken(path, self.overwrite)?;
        }
        Ok(())
    }

    /// Returns true if the burst goes to standard output.
    pub(super) fn to_stdout(&self) -> bool {
        self.output == "-"
    }
}

/// Returns the format of the burst.
fn format(args: &Simulate, max_count: u16) -> Result<BurstFormat> {
    let packed = !args.unpacked;
    let format = if args.output == "-" {
        BurstFormat::npy(max_count, packed)
    } else {
        BurstFormat::for_path(Path::new(&args.output), max_count, packed)?
    };
    if args.unpacked && !(format == BurstFormat::NpyU8 && max_count == 1) {
        return Err(CliError::new(
            format!("this burst is not packed: counts up to {max_count}, in {}", args.output),
            "--unpacked",
            "leave it out: only binary .npy bursts are packed",
        ));
    }
    if args.visionsim && (format != BurstFormat::NpyPacked || args.output == "-") {
        return Err(CliError::new(
            "visionsim opens packed binary .npy files only",
            "--visionsim",
            "use a binary sensor (--sensor swissspad2), no --sum, and -o NAME.npy",
        ));
    }
    Ok(format)
}

fn reject_settings_beside_record(args: &Simulate, global: &Global) -> Result<()> {
    let given = args.keys.first();
    let given = given.or((!global.set.is_empty()).then(|| "--set".to_owned()));
    let given = given.or(global.config.is_some().then(|| "--config".to_owned()));
    let Some(given) = given else { return Ok(()) };
    Err(CliError::new(
        format!("{given} with --from: a record says everything about its burst"),
        &given,
        "leave it out, or give the input instead of the record",
    ))
}

/// Refuses settings that this input has no use for.
fn refuse_unused(input: &Input, settings: &Settings) -> Result<()> {
    match input {
        Input::Procedural(_) => {
            settings.refuse(&["simulate.motion"], "by procedural scenes, which move by themselves")
        }
        Input::Still { .. } => settings.refuse(&["simulate.speed"], "by stills: motion moves them"),
        _ => settings.refuse(
            &["simulate.speed", "simulate.scene_seed"],
            "by recorded clips, which are as they are",
        ),
    }
}

fn simulation(args: &Simulate, settings: &Settings) -> Result<Simulation> {
    let input = Input::parse(
        args.input.as_deref().unwrap_or_default(),
        settings.parse("simulate.motion")?,
        settings.parse("simulate.size")?,
        settings.get("simulate.scene_seed")?,
        settings.get("simulate.speed")?,
    )?;
    refuse_unused(&input, settings)?;
    let frames: Option<u64> = settings.get("simulate.frames")?;
    if let Some(frames) = frames.filter(|frames| frames > COUNT.end()) {
        let help = format!("give a number up to {}", COUNT.end());
        return Err(CliError::new(format!("{frames} frames"), "--frames", help));
    }
    let mut sensor = settings.sensor(&settings.get::<String>("simulate.sensor")?)?;
    if let Some(FilterChoice::Picture(path)) =
        sensor.colour.as_mut().and_then(|colour| colour.cfa.as_mut())
    {
        // Absolute, so that a record works from any folder.
        *path = std::path::absolute(&*path)
            .map_err(|e| Error::io("find the filter", Path::new(path), e))?;
    }
    let mut transfer = settings.get("simulate.transfer")?;
    let has_filter = sensor.colour.as_ref().is_some_and(|colour| colour.cfa.is_some());
    let is_light = matches!(input, Input::Npy { .. } | Input::Procedural(_));
    if has_filter && !is_light && transfer == Transfer::AsIs {
        let reason = "by colours of images and videos, which are decoded from sRGB";
        settings.refuse(&["simulate.transfer"], reason)?;
        transfer = Transfer::Srgb;
    }
    // Drawn seeds stay short enough to be read out and typed.
    let drawn = || RandomState::new().hash_one(0) % 1_000_000;
    Ok(Simulation {
        input,
        sampling: Sampling {
            frames,
            instants: settings.get("simulate.instants")?,
            frames_per_image: settings.get("simulate.frames_per_image")?,
            transfer,
            white: settings.get("simulate.white")?,
        },
        sensor,
        ppp: settings.get("simulate.ppp")?,
        ppp_def: settings.get("simulate.ppp_def")?,
        mean_level: settings.get("simulate.exposure")?,
        seed: settings.get::<Option<u64>>("simulate.seed")?.unwrap_or_else(drawn),
    })
}
