//! Commands for calling programs: with the arguments of the command line, on the calling thread, printing
//! nothing.

use crate::args::{Args, Command, Global, Sum};
use crate::capture::{Input, Source, SummedCapture};
use crate::commands::restore::args::Restore;
use crate::commands::restore::caller::{self, Receiver};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::methods::METHODS;
use crate::report::{Listener, Report};
use crate::settings::Settings;
use clap::Parser;
use qudi_core::atomic_file::Overwrite;
use qudi_core::sensor::Sensor;
use qudi_core::{Frame, Size};
use qudi_io::capture::Capture;
use qudi_io::description::MaskChoice;
use qudi_io::writer::{ClipWriter, Planes, TiffSamples};
use qudi_model::MatrixUnits;
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Runs a command, given as the arguments after the program's name. What it has to say goes to `listener`;
/// it stops soon after `stop` is set.
///
/// # Errors
/// As the command line; arguments that it does not take are an error, too.
pub fn call(
    arguments: &[String],
    stop: &Arc<AtomicBool>,
    listener: Listener,
) -> Result<(), CliError> {
    let args = parse(arguments)?;
    refuse_threads(&args)?;
    let report = Report::to(listener);
    match interrupt::stoppable(stop, || crate::run_command(&args, &report)) {
        Err(CliError::TimeOver(what)) => {
            report.remark(&what);
            Ok(())
        }
        result => result,
    }
}

/// Restores `input`, or the capture that the arguments of `qudi restore` name, and hands its frames to
/// `receiver`; returns settings and results.
///
/// # Errors
/// As the command line.
pub fn restore(
    arguments: &[String],
    input: Option<Input>,
    stop: &Arc<AtomicBool>,
    listener: Listener,
    receiver: &mut dyn Receiver,
) -> Result<Value, CliError> {
    let (global, settings, restore) = parse_restore(arguments)?;
    let report = Report::to(listener);
    interrupt::stoppable(stop, || {
        caller::run(*restore, input, &settings, &global, &report, receiver)
    })
}

/// Opens `input`, or the capture that the arguments of `qudi restore` name, with its sensor, if that is
/// known. Pixels are repaired, and frames are summed by themselves, only where that is asked for.
///
/// # Errors
/// As the command line.
pub fn open(
    arguments: &[String],
    input: Option<Input>,
) -> Result<(Capture, Option<Sensor>), CliError> {
    let (_, settings, args) = parse_restore(arguments)?;
    let options = args.reading.options(MaskChoice::None);
    let sum = args.reading.sum();
    let input = input.unwrap_or_else(|| Input::at(Some(&args.capture)));
    let sensor = args.sensor.as_deref();
    let source = Source { input, options: &options, sum, sensor, judged: 0 };
    let opened = source.open(&settings)?;
    if sum != Some(Sum::Auto) {
        return Ok((opened.capture, opened.sensor));
    }
    let SummedCapture { capture, sensor, .. } = SummedCapture::new(opened, &source)?;
    Ok((capture, sensor))
}

/// Returns the names of all methods, each with a line about it.
pub fn methods() -> Vec<(&'static str, &'static str)> {
    METHODS.iter().map(|method| (method.name, method.about)).collect()
}

/// Loads a sensor by its name, or from a TOML file.
///
/// # Errors
/// [`CliError`] if there is none of this name, or if it is impossible.
pub fn sensor(name: &str) -> Result<Sensor, CliError> {
    Ok(Sensor::load(name)?)
}

/// Writes frames of `size`, each of one plane, or of three of red, green and blue, to a `.npy`, `.tif`,
/// `.gif` or `.mp4` file, or to a folder of PNG; nothing is left behind if `frames` ends with an error.
///
/// # Errors
/// [`CliError`] if the place is taken and `force` is false, if it cannot be written, or the error of a frame.
pub fn write_frames(
    path: &Path,
    size: Size,
    planes: Planes,
    float: bool,
    fps: f64,
    force: bool,
    frames: &mut dyn Iterator<Item = qudi_core::Result<Vec<Frame>>>,
) -> Result<(), CliError> {
    let overwrite = if force { Overwrite::Yes } else { Overwrite::No };
    let samples = if float { TiffSamples::F32 } else { TiffSamples::U16 };
    let mut writer = ClipWriter::create(path, size, planes, samples, fps, overwrite)?;
    for frame in frames {
        match <[Frame; 3]>::try_from(frame?) {
            Ok(colours) => writer.push_colour(&colours)?,
            Err(planes) => planes.iter().try_for_each(|plane| writer.push(plane))?,
        }
    }
    Ok(writer.finish()?)
}

fn parse(arguments: &[String]) -> Result<Args> {
    let all = std::iter::once("qudi").chain(arguments.iter().map(String::as_str));
    Args::try_parse_from(all).map_err(|refusal| {
        CliError::of_value(&refusal).unwrap_or_else(|| {
            let text = refusal.to_string();
            let what = text.lines().next().unwrap_or_default().trim_start_matches("error: ");
            CliError::argument(what, "the arguments", "`qudi help COMMAND` lists what it takes")
        })
    })
}

fn parse_restore(arguments: &[String]) -> Result<(Global, Settings, Box<Restore>)> {
    MatrixUnits::chosen()?;
    let args = parse(arguments)?;
    refuse_threads(&args)?;
    let Args { global, command } = args;
    let settings = Settings::load(&global, command.name())?;
    match command {
        Command::Restore(restore) => Ok((global, settings, restore)),
        _ => Err(CliError::new("no restoration", "the arguments", "begin with `restore`")),
    }
}

/// Refuses `--threads`: the threads of a program that goes on are started once.
fn refuse_threads(args: &Args) -> Result<()> {
    match args.global.threads {
        None => Ok(()),
        Some(_) => Err(CliError::new(
            "threads are started once in a program",
            "--threads",
            "leave it out, and set RAYON_NUM_THREADS before the program starts",
        )),
    }
}
