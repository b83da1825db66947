//! `qudi restore`: a capture through a method into frames.

use crate::args::{Global, Network, Restore, Shard};
use crate::cmd::capture_info::{open_capture, remarks, required_sensor, unknown_sensor};
use crate::cmd::capture_light::{Stated, acquisition};
use crate::cmd::methods::{method, usual_method};
use crate::cmd::network::device_failed;
use crate::cmd::restore_deviation::Deviation;
use crate::cmd::restore_output::{Misfit, Output};
use crate::cmd::tiff_samples::tiff_samples;
use crate::device;
use crate::error::{Fault, Result};
use crate::interrupt;
use crate::places::Places;
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::SimError;
use qudi_core::atomic_file::{Overwrite, refuse_taken};
use qudi_core::restorer::{Acquisition, Restorer};
use qudi_core::windows::Windows;
use qudi_io::capture::{Capture, MaskChoice};
use qudi_io::restore::{FolderRun, Inputs, Share, run as run_method};
use qudi_io::writer::{ArrayWriter, Picture};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::io::IsTerminal;
use std::ops::Range;
use std::path::Path;
use std::time::Instant;

pub(crate) fn run(
    args: &Restore,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    if args.output == "-" && report.json() {
        return Err(Fault::new(
            "--json and -o - both write to standard output",
            "--json",
            "write the frames to a file",
        ));
    }
    let overwrite = if global.force { Overwrite::Yes } else { Overwrite::No };
    let beside = [&args.chi_map, &args.side_by_side, &args.deviation];
    Places::default()
        .reads_burst(&args.capture)
        .reads(args.reading.files())
        .reads(args.sensor.as_deref())
        .reads(&args.network.weights)
        .reads(&global.config)
        .writes([&args.output])
        .writes(beside.into_iter().flatten())
        .check()?;
    for path in beside.into_iter().flatten() {
        refuse_taken(path, overwrite)?;
    }
    if args.shard.is_some() && args.side_by_side.is_some() {
        return Err(Fault::new(
            "a part of the work has not all the frames to show",
            "--side-by-side",
            "ask for it when all parts are done: the same command without --shard",
        ));
    }
    if let Some(method) = &args.method {
        args.network.check_methods(std::iter::once(method.as_str()))?;
    }
    let tiff = tiff_samples(args.float, Path::new(&args.output))?;
    Output::refuse_taken(&args.output, args.shard.is_some(), overwrite)?;
    if is_pipe(args) {
        refuse_for_pipes(args, overwrite)?;
    }
    let mut job = Job::prepare(args, settings)?;
    let run = job.folder_run(args)?;
    let mut output = Output::open(&args.output, &job.capture, run, tiff, overwrite)?;
    let start = Instant::now();
    // A pipe may not have told how many frames come.
    let frames = job.capture.length().unwrap_or(u64::MAX);
    let part = args.shard.map_or(0..frames, |shard| shard.range(frames));
    let mut misfit = Misfit::new(&job.capture, &job.acquisition);
    let done = output.finished(part.clone());
    let mut deviation =
        Deviation::create(args, job.restorer.name(), &job.capture, done, overwrite)?;
    let rest = part.start + done..part.end;
    if done == 0 {
        job.run(rest, &mut output, Some(&mut misfit), &mut deviation, &args.network, report)?;
    } else {
        // Frames of an interrupted run are judged with the others, in the same order; but after
        // the rest is made, so that a run that keeps being killed still gets on.
        job.run(rest, &mut output, None, &mut deviation, &args.network, report)?;
        misfit.read_finished(&output, &mut job.capture, part.clone())?;
    }
    let frames = job.capture.frames();
    let part = part.start..part.end.min(frames);
    let is_network = !job.settings["network"].is_null();
    let mode = is_network.then(|| args.network.mode()).transpose()?;
    let results = json!({"chi_square": misfit.chi_square(), "mode": mode});
    let complete = part == (0..frames) || output.finished(0..frames) == frames;
    output.finish(&results, complete)?;
    deviation.finish()?;
    if let Some(path) = &args.chi_map {
        save_map(&misfit, path, overwrite)?;
    }
    if let (Some(path), Some(picture)) = (&args.side_by_side, misfit.side_by_side()) {
        picture.save(path, overwrite)?;
    }
    remarks(&job.capture, report);
    let made = part.end - part.start - done;
    let seconds = (made > 0).then(|| start.elapsed().as_secs_f64() / made as f64);
    let text = describe(args, &job, part.end - part.start, done, misfit.chi_square(), seconds);
    if args.output == "-" {
        report.remark(text.trim_end());
        return Ok(());
    }
    report.result(&text, || {
        json!({
            "output": args.output,
            "settings": job.settings,
            "results": results,
            "ppp_from": job.source,
            "resumed_frames": done,
            "seconds_per_frame": seconds,
        })
    })
}

/// Whether the capture comes through standard input.
fn is_pipe(args: &Restore) -> bool {
    args.capture.as_os_str() == "-"
}

/// What takes a capture that can be asked for again.
fn refuse_for_pipes(args: &Restore, overwrite: Overwrite) -> Result<()> {
    if std::io::stdin().is_terminal() {
        return Err(Fault::new(
            "standard input is a terminal, and a capture comes through a pipe",
            "-",
            "pipe one in, as in `cat burst.npy | qudi restore - -o out`, or name a file",
        ));
    }
    if args.shard.is_some() {
        return Err(Fault::new(
            "a pipe comes once and whole",
            "--shard",
            "store the capture in a file to share the work",
        ));
    }
    if args.output != "-" {
        // Nobody knows whether the same frames come again, so that a folder is not gone on with.
        refuse_taken(Path::new(&args.output), overwrite)?;
    }
    Ok(())
}

/// Everything that a run needs.
struct Job {
    capture: Capture,
    acquisition: Acquisition,
    /// Where the light comes from.
    source: &'static str,
    restorer: Box<dyn Restorer>,
    /// What the method chose for this clip.
    choice: String,
    windows: Windows,
    settings: Value,
}

impl Job {
    fn prepare(args: &Restore, overrides: &Settings) -> Result<Self> {
        let options = args.reading.options(MaskChoice::Auto);
        let name = args.sensor.as_deref();
        let (mut capture, sensor) = if is_pipe(args) {
            let named = name.map(|name| overrides.sensor(name)).transpose()?;
            let capture = Capture::from_pipe(std::io::stdin(), &options, named.as_ref())?;
            let sensor = match named {
                Some(sensor) => sensor,
                None => overrides.adjusted(required_sensor(&capture)?)?,
            };
            (capture, sensor)
        } else {
            let (capture, sensor) = open_capture(&args.capture, &options, name, overrides)?;
            let sensor = sensor.ok_or_else(|| unknown_sensor(&capture))?;
            (capture, sensor)
        };
        let stated =
            Stated { ppp: args.ppp, gain: args.gain, exposure: args.exposure, seed: args.seed };
        let (acquisition, source) = acquisition(&stated, &mut capture, &sensor)?;
        let name = match &args.method {
            Some(name) => name,
            None => usual_method(&args.network, &capture, &acquisition)?,
        };
        let (restorer, choice) = method(name, &mut capture, &acquisition, &args.network)?;
        let windows = Windows::new(capture.frames(), restorer.window() as u64, args.overlap)?;
        let place = if is_pipe(args) {
            capture.path().to_owned()
        } else {
            std::path::absolute(&args.capture).unwrap_or_else(|_| args.capture.clone())
        };
        let settings = json!({
            "capture": place,
            "format": capture.info().format,
            "read": options,
            "frames": capture.length(),
            "height": capture.size().height,
            "width": capture.size().width,
            "method": restorer.name(),
            "choice": choice,
            "window": restorer.window(),
            "overlap": args.overlap,
            "seed": args.seed,
            "network": network_settings(restorer.name(), &args.network)?,
            "ppp": acquisition.ppp,
            "exposure": acquisition.exposure,
            "gain": acquisition.gain,
            "sensor": acquisition.sensor,
            "repaired_pixels": capture.bad_pixels().len(),
        });
        Ok(Self { capture, acquisition, source, restorer, choice, windows, settings })
    }

    /// What the manifest of an output folder notes. Weights are among the settings by their SHA-256.
    fn folder_run(&self, args: &Restore) -> Result<FolderRun> {
        let mut inputs = Inputs::default();
        if !is_pipe(args) && Path::new(&args.output).extension().is_none() && args.output != "-" {
            inputs.add("capture", &args.capture)?;
            let options = args.reading.options(MaskChoice::Auto);
            if let MaskChoice::File(mask) = &options.mask {
                inputs.add("mask", mask)?;
            }
            if let Some(map) = &options.dcr {
                inputs.add("dcr", map)?;
            }
            let defects = &self.acquisition.sensor.defects;
            for (name, file) in
                [("dark_map", &defects.dark_map), ("bad_pixels", &defects.bad_pixels)]
            {
                if let Some(file) = file {
                    inputs.add(name, Path::new(file))?;
                }
            }
        }
        let share = args.shard.map_or(Share::Whole, Shard::share);
        Ok(FolderRun { settings: self.settings.clone(), inputs, share })
    }

    fn run(
        &mut self,
        wanted: Range<u64>,
        output: &mut Output,
        misfit: Option<&mut Misfit>,
        deviation: &mut Deviation,
        network: &Network,
        report: &Report,
    ) -> Result<()> {
        if wanted.is_empty() {
            return Ok(());
        }
        let mut bar = report.bar();
        let mut progress = |done: u64, total: Option<u64>| {
            bar.update("restoring", done, total);
            interrupt::check()
        };
        let mut sink = output.sink(misfit, deviation);
        let (capture, acquisition) = (&mut self.capture, &self.acquisition);
        let restorer = self.restorer.as_mut();
        let restorer_is_network = restorer.name() == "qudi";
        let windows = &self.windows;
        let run = || {
            run_method(restorer, capture, windows, wanted, acquisition, &mut sink, &mut progress)
        };
        if restorer_is_network {
            // Devices report too little memory and broken drivers by panicking.
            let run = device::guarded(network.device(), run);
            return Ok(run.map_err(|problem| device_failed(&problem, network))??);
        }
        Ok(run()?)
    }
}

/// What the frames depend on besides, where the network makes them.
fn network_settings(method: &str, options: &Network) -> Result<Option<Value>> {
    if method != "qudi" {
        return Ok(None);
    }
    let weights = options.weights();
    Ok(Some(json!({
        "weights": weights.to_string(),
        "weights_sha256": weights.sha256()?,
        "steps": options.steps()?,
        "spacing": format!("{:?}", options.spacing()).to_lowercase(),
        "sampler": format!("{:?}", options.sampler()).to_lowercase(),
        "samples": options.samples(),
        "tile": options.tile(),
    })))
}

fn describe(
    args: &Restore,
    job: &Job,
    frames: u64,
    resumed: u64,
    chi_square: Option<f64>,
    seconds: Option<f64>,
) -> String {
    let (acquisition, size) = (&job.acquisition, job.capture.size());
    let (name, choice) = (job.restorer.name(), &job.choice);
    let mut text = format!("{}   {frames} frames of {size} by {name}{choice}\n", args.output);
    let mut line = |key: &str, value: String| {
        let _ = writeln!(text, "  {key:<12}{value}");
    };
    let (ppp, exposure) = (acquisition.ppp, acquisition.exposure);
    let source = job.source;
    line(
        "light",
        format!("{ppp:.4} incident photons/pixel/frame ({source}), exposure {exposure:.4}"),
    );
    line("sensor", format!("{}, gain {:.4} DN/e-", acquisition.sensor.name, acquisition.gain));
    if resumed > 0 {
        line("resumed", format!("{resumed} frames were there already"));
    }
    if let Some(chi_square) = chi_square {
        line("chi-square", format!("{chi_square:.4} (1: the photons agree)"));
    }
    if let Some(seconds) = seconds {
        line("time", format!("{seconds:.4} s per frame"));
    }
    text
}

/// The chi-square map: values in `.npy`, or a picture in which 2 is white.
fn save_map(misfit: &Misfit, path: &Path, overwrite: Overwrite) -> Result<()> {
    let mut map = misfit.map();
    match path.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
        Some("npy") => {
            let mut array = ArrayWriter::create(path, overwrite, "<f4", &[map.size.width])?;
            for row in map.data.chunks(map.size.width) {
                array.push_f32(row.iter().copied())?;
            }
            Ok(array.finish()?)
        }
        Some("png") => {
            for value in &mut map.data {
                *value *= 0.5;
            }
            Ok(Picture::single(&map).save(path, overwrite)?)
        }
        _ => Err(SimError::data("maps are .npy or .png", path, "choose one of the two").into()),
    }
}
