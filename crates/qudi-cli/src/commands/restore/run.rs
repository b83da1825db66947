//! `qudi restore`: a capture through a method into frames.

use super::args::Restore;
use super::chi_square_map::ChiSquareMap;
use super::output::{Output, Sink};
use super::plan::Plan;
use super::uncertainty::UncertaintyFile;
use crate::args::{Global, Shard};
use crate::capture::acquisition::acquisition;
use crate::capture::{open_capture, remarks, required_sensor, unknown_sensor};
use crate::device;
use crate::error::Result;
use crate::interrupt;
use crate::methods::network::device_failed;
use crate::methods::options::{NetworkOptions, other_method};
use crate::methods::{method, usual_method};
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::restorer::{Acquisition, Restorer};
use qudi_core::windows::Windows;
use qudi_io::capture::{Capture, MaskChoice};
use qudi_io::restore::{FolderRun, Inputs, Share, run as run_method};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::ops::Range;
use std::path::Path;
use std::time::Instant;

pub(crate) fn run(
    args: &Restore,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let plan = Plan::new(args, global, report.json())?;
    let mut job = Job::prepare(&plan, settings)?;
    let run = job.folder_run(&plan)?;
    let mut output = Output::open(&plan.output, &job.capture, run, plan.tiff, plan.overwrite)?;
    let start = Instant::now();
    // A pipe may not say how many frames come.
    let frames = job.capture.length().unwrap_or(u64::MAX);
    let part = plan.shard.map_or(0..frames, |shard| shard.range(frames));
    let mut map = ChiSquareMap::new(&job.capture, &job.acquisition);
    let done = output.finished(part.clone());
    let mut uncertainty = UncertaintyFile::create(&plan, job.restorer.name(), &job.capture, done)?;
    let rest = part.start + done..part.end;
    if done == 0 {
        let sink = Sink::new(&mut output, Some(&mut map), &mut uncertainty);
        job.run(rest, sink, &plan.network, report)?;
    } else {
        // Frames of an interrupted run are measured with the others, in the same order; but after
        // the rest is made, so that a run that keeps being killed still gets on.
        let sink = Sink::new(&mut output, None, &mut uncertainty);
        job.run(rest, sink, &plan.network, report)?;
        output.measure_finished(&mut map, &mut job.capture, part.clone())?;
    }
    let frames = job.capture.frames();
    let part = part.start..part.end.min(frames);
    let is_network = !job.settings["network"].is_null();
    let mode = is_network.then(|| plan.network.mode()).transpose()?;
    let results = json!({"chi_square": map.chi_square(), "mode": mode});
    let complete = part == (0..frames) || output.finished(0..frames) == frames;
    output.finish(&results, complete)?;
    uncertainty.finish()?;
    if let Some(path) = &plan.chi_square_map {
        map.save(path, plan.overwrite)?;
    }
    if let (Some(path), Some(picture)) = (&plan.side_by_side, map.side_by_side()) {
        picture.save(path, plan.overwrite)?;
    }
    remarks(&job.capture, report);
    let made = part.end - part.start - done;
    let seconds = (made > 0).then(|| start.elapsed().as_secs_f64() / made as f64);
    let frames = part.end - part.start;
    let text = describe(&plan.output, &job, frames, done, map.chi_square(), seconds);
    if plan.output == "-" {
        report.remark(text.trim_end());
        return Ok(());
    }
    report.result(&text, || {
        json!({
            "output": plan.output,
            "settings": job.settings,
            "results": results,
            "ppp_from": job.source,
            "resumed_frames": done,
            "seconds_per_frame": seconds,
        })
    })
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
    fn prepare(plan: &Plan, overrides: &Settings) -> Result<Self> {
        let name = plan.sensor.as_deref();
        let (mut capture, sensor) = if plan.reads_pipe() {
            let named = name.map(|name| overrides.sensor(name)).transpose()?;
            let capture = Capture::from_pipe(std::io::stdin(), &plan.read, named.as_ref())?;
            let sensor = match named {
                Some(sensor) => sensor,
                None => overrides.adjusted(required_sensor(&capture)?)?,
            };
            (capture, sensor)
        } else {
            let (capture, sensor) = open_capture(&plan.capture, &plan.read, name, overrides)?;
            let sensor = sensor.ok_or_else(|| unknown_sensor(&capture))?;
            (capture, sensor)
        };
        let (acquisition, source) = acquisition(&plan.light, &mut capture, &sensor)?;
        let name = match &plan.method {
            Some(name) => name,
            None => usual_method(&plan.network, &capture, &acquisition)?,
        };
        if let Some(flag) = plan.seed_flag.filter(|_| name != "qudi") {
            return Err(other_method(flag));
        }
        let (restorer, choice) = method(name, &mut capture, &acquisition, &plan.network)?;
        let windows = Windows::new(capture.frames(), restorer.window() as u64, plan.overlap)?;
        let place = if plan.reads_pipe() {
            capture.path().to_owned()
        } else {
            std::path::absolute(&plan.capture).unwrap_or_else(|_| plan.capture.clone())
        };
        let settings = json!({
            "capture": place,
            "format": capture.info().format,
            "read": plan.read,
            "frames": capture.length(),
            "height": capture.size().height,
            "width": capture.size().width,
            "method": restorer.name(),
            "choice": choice,
            "window": restorer.window(),
            "overlap": plan.overlap,
            "seed": plan.light.seed,
            "network": network_settings(restorer.name(), &plan.network)?,
            "ppp": acquisition.ppp,
            "exposure": acquisition.mean_level,
            "gain": acquisition.gain,
            "sensor": acquisition.sensor,
            "repaired_pixels": capture.bad_pixels().len(),
        });
        Ok(Self { capture, acquisition, source, restorer, choice, windows, settings })
    }

    /// The entries of the manifest of an output folder. Weights are among the settings by their SHA-256.
    fn folder_run(&self, plan: &Plan) -> Result<FolderRun> {
        let mut inputs = Inputs::default();
        let to_folder = Path::new(&plan.output).extension().is_none() && plan.output != "-";
        if !plan.reads_pipe() && to_folder {
            inputs.add("capture", &plan.capture)?;
            if let MaskChoice::File(mask) = &plan.read.mask {
                inputs.add("mask", mask)?;
            }
            if let Some(map) = &plan.read.dcr {
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
        let share = plan.shard.map_or(Share::Whole, Shard::share);
        Ok(FolderRun { settings: self.settings.clone(), inputs, share })
    }

    fn run(
        &mut self,
        wanted: Range<u64>,
        mut sink: Sink<'_>,
        network: &NetworkOptions,
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
        let (capture, acquisition) = (&mut self.capture, &self.acquisition);
        let restorer = self.restorer.as_mut();
        let restorer_is_network = restorer.name() == "qudi";
        let windows = &self.windows;
        let run = || {
            run_method(restorer, capture, windows, wanted, acquisition, &mut sink, &mut progress)
        };
        if restorer_is_network {
            // Devices report too little memory and broken drivers by panicking.
            let run = device::guarded(&network.device, run);
            return Ok(run.map_err(|problem| device_failed(&problem, network))??);
        }
        Ok(run()?)
    }
}

/// The settings of the network that frames depend on, where it makes them.
fn network_settings(method: &str, options: &NetworkOptions) -> Result<Option<Value>> {
    if method != "qudi" {
        return Ok(None);
    }
    Ok(Some(json!({
        "weights": options.weights.to_string(),
        "weights_sha256": options.weights.sha256()?,
        "steps": options.steps()?,
        "spacing": options.spacing_name(),
        "sampler": options.sampler_name(),
        "samples": options.samples,
        "tile": options.tile,
    })))
}

fn describe(
    output: &str,
    job: &Job,
    frames: u64,
    resumed: u64,
    chi_square: Option<f64>,
    seconds: Option<f64>,
) -> String {
    let (acquisition, size) = (&job.acquisition, job.capture.size());
    let (name, choice) = (job.restorer.name(), &job.choice);
    let mut text = format!("{output}   {frames} frames of {size} by {name}{choice}\n");
    let mut line = |key: &str, value: String| {
        let _ = writeln!(text, "  {key:<12}{value}");
    };
    let (ppp, mean_level) = (acquisition.ppp, acquisition.mean_level);
    let source = job.source;
    line(
        "light",
        format!("{ppp:.4} incident photons/pixel/frame ({source}), exposure {mean_level:.4}"),
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
