//! `qudi restore`: a capture through a method into frames.

use super::args::{Restore, Tonemap};
use super::challenge;
use super::chi_square_map::ChiSquareMap;
use super::output::{Output, Sink};
use super::page::{About, RestoredPage};
use super::plan::Plan;
use super::uncertainty::UncertaintyFile;
use crate::args::{Global, Shard};
use crate::capture::{
    AlignedCapture, Alignment, CaptureAcquisition, LightOverrides, OtherPlanes, Source,
    SummedCapture, remarks, warnings,
};
use crate::colour::{Rendering, behind_filter, dng_tags, is_linear};
use crate::commands::look::strip::strip;
use crate::device;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::methods::default::default_method;
use crate::methods::network::{OwnNetwork, device_failed};
use crate::methods::options::NetworkOptions;
use crate::methods::{Built, Kind, Method};
use crate::report::{Output as PageFile, Report, counted, duration};
use crate::settings::Settings;
use qudi_burst::ColourRestorer;
use qudi_core::colour::FilterChoice;
use qudi_core::progress::{Observer, observed};
use qudi_core::restorer::{Acquisition, Restorer};
use qudi_core::sensor::Sensor;
use qudi_io::capture::{Capture, Summary};
use qudi_io::description::MaskChoice;
use qudi_io::restore::{
    FolderRun, Inputs, Instants, RestoreSink, Schedule, Share, run as run_method,
};
use serde_json::{Value, json};
use std::cell::RefCell;
use std::fmt::Write as _;
use std::ops::Range;
use std::path::Path;
use std::rc::Rc;
use std::time::Instant;

/// Seconds from which on it is said beforehand how long a run takes.
const LONG_RUN: f64 = 300.0;

pub(crate) fn run(
    args: &Restore,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    if args.challenge {
        return challenge::run(args, settings, global, report);
    }
    let plan = Plan::new(args, global, report.json())?;
    let mut job = Job::prepare(&plan, &plan.source(), settings, report)?;
    if plan.output == "-" && job.rendering.is_some() {
        return Err(CliError::new(
            "colours are not written as Y4M",
            "-o -",
            "name a file or a folder, or restore luma alone with --gray",
        ));
    }
    let settings = job.settings(&plan)?;
    let run = job.folder_run(&plan, &settings)?;
    // Where the page cannot be written, no folder of frames is begun.
    let page_file = PageFile::open(plan.html.as_deref(), plan.overwrite)?;
    let mut output = Output::open(&plan, job.capture(), job.rendering.clone(), run)?;
    let start = Instant::now();
    // A pipe may not say how many frames come.
    let known = job.schedule.instants.pictures(job.capture());
    let frames = known.unwrap_or(u64::MAX);
    let part = plan.shard.map_or(0..frames, |shard| shard.range(frames));
    let page = plan.html.is_some().then(|| job.page(&plan));
    let map = ChiSquareMap::new(job.capture().size(), known, &job.acquisition);
    let mut map = map.behind(job.capture().filter().cloned()).with_page(page);
    let done = output.finished(part.clone());
    let measured = [
        ("--html", plan.html.is_some()),
        ("--chi-map", plan.chi_square_map.is_some()),
        ("--side-by-side", plan.side_by_side.is_some()),
    ];
    if let Some((flag, _)) = measured.into_iter().find(|(_, asked)| *asked)
        && done > 0
        && job.rendering.is_some()
    {
        let help = "leave it out, or write into another folder";
        let what =
            format!("{done} frames were restored by an earlier run, whose colours are balanced");
        return Err(CliError::new(what, flag, help));
    }
    let mut uncertainty = UncertaintyFile::create(&plan, job.method, job.capture(), done)?;
    let rest = part.start + done..part.end;
    if done == 0 {
        let mut sink = Sink::new(&mut output, Some(&mut map), &mut uncertainty);
        job.run(rest, &mut sink, &plan.network, report)?;
    } else {
        // Frames of an interrupted run are measured with the others, in the same order; but after
        // the rest is made, so that a run that keeps being killed still gets on.
        let mut sink = Sink::new(&mut output, None, &mut uncertainty);
        job.run(rest, &mut sink, &plan.network, report)?;
        output.measure_finished(&mut map, &mut job.aligned.capture, &job.schedule, part.clone())?;
    }
    let frames = job.schedule.instants.pictures(job.capture()).unwrap_or(0);
    let part = part.start..part.end.min(frames);
    let is_whole = part == (0..frames);
    let results = job.results(&plan, map.chi_square(), is_whole)?;
    let complete = is_whole || output.finished(0..frames) == frames;
    output.finish(&results, complete)?;
    uncertainty.finish()?;
    if let Some(path) = &plan.chi_square_map {
        map.save(path, plan.overwrite)?;
    }
    if let (Some(path), Some(picture)) = (&plan.side_by_side, map.side_by_side()) {
        picture.save(path, plan.overwrite)?;
    }
    remarks(job.capture(), report);
    for warning in &job.warnings {
        report.warning(warning);
    }
    let made = part.end - part.start - done;
    let seconds = (made > 0).then(|| start.elapsed().as_secs_f64() / made as f64);
    let frames = part.end - part.start;
    let text = describe(&plan.output, &job, frames, done, map.chi_square(), seconds);
    if let Some(page) = map.take_page() {
        let about = About {
            capture: plan.capture.display().to_string(),
            method: job.method.name,
            text: &text,
            warnings: &job.warnings,
            settings: &settings,
            misfit: map.map(),
            strip: strip(job.capture().timeline(), job.capture().findings()),
        };
        page_file.write(|| page.html(about))?;
    }
    if plan.output == "-" {
        report.remark(text.trim_end());
        return Ok(());
    }
    report.result(&text, || {
        json!({
            "output": plan.output,
            "settings": settings,
            "results": results,
            "ppp_from": job.light_source,
            "resumed_frames": done,
            "seconds_per_frame": seconds,
        })
    })
}

/// What a run needs: a capture and its acquisition, the method, and the pictures that it makes.
pub(super) struct Job {
    pub(super) aligned: AlignedCapture,
    pub(super) acquisition: Acquisition,
    light_source: &'static str,
    pub(super) method: &'static Method,
    restorer: Box<dyn Restorer>,
    /// What the method chose for this capture.
    choice: String,
    pub(super) schedule: Schedule,
    /// What makes the result doubtful.
    pub(super) warnings: Vec<String>,
    /// True if so many samples are saturated that it is among the warnings.
    saturated: bool,
    /// Rendering of the colours, where colours are restored.
    pub(super) rendering: Option<Rendering>,
}

impl Job {
    /// Opens the capture, sums its frames, determines its acquisition, and makes the restorer.
    pub(super) fn prepare(
        plan: &Plan,
        source: &Source<'_>,
        overrides: &Settings,
        report: &Report,
    ) -> Result<Self> {
        let opened = source.open(overrides)?;
        let summed = SummedCapture::new(opened, source)?;
        let sensor = summed.required_sensor()?;
        summed.remark_sum(report);
        let plain_sum = summed.capture.summed();
        let mut aligned = AlignedCapture::new(summed, source, &sensor, plan.method, plan.every)?;
        aligned.remark_alignment(report);
        let capture = &mut aligned.capture;
        // A light is given for the frames that `qudi info` tells of.
        let share = f64::from(capture.summed()) / f64::from(plain_sum);
        let light =
            LightOverrides { ppp: plan.light.ppp.map(|ppp| ppp * share), ..plan.light.clone() };
        let summary = light.measure(capture, Some(&sensor))?;
        let CaptureAcquisition { acquisition, light_source } =
            CaptureAcquisition::new(&light, capture, &sensor, &summary)?;
        let warnings = warnings::of_capture(capture, &summary, Some(&sensor));
        let saturated = warnings::saturation(capture, &summary, Some(&sensor)).is_some();
        let rendering = rendering(plan, capture, &summary, &acquisition)?;
        let (method, (restorer, choice)) =
            restorer(plan, source, &sensor, &mut aligned, &acquisition, report)?;
        let overlap = plan.overlap * aligned.frames_per_sum();
        let schedule = aligned.schedule(restorer.as_ref(), overlap, plan.every)?;
        if matches!(schedule.instants, Instants::Centred { .. }) && is_full_colour(&aligned.capture)
        {
            return Err(CliError::new(
                "pictures between the sums of three planes of colour",
                "--every",
                "leave it out, or read one plane as gray with --channel 0 to 2",
            ));
        }
        Ok(Self {
            aligned,
            acquisition,
            light_source,
            method,
            restorer,
            choice,
            schedule,
            warnings,
            saturated,
            rendering,
        })
    }

    /// Returns the method in words, as in `qudi (regression) on cpu`.
    pub(super) fn method_text(&self) -> String {
        format!("{}{}", self.method.name, self.choice)
    }

    /// Returns the number of native frames in a frame; none if sums are aligned.
    pub(super) fn plain_sum(&self) -> Option<u32> {
        self.aligned.alignment.is_none().then(|| self.capture().summed())
    }

    pub(super) fn capture(&self) -> &Capture {
        &self.aligned.capture
    }

    /// Returns the page of the pictures, which are yet to come.
    fn page(&self, plan: &Plan) -> RestoredPage {
        let (size, max_count) = (self.capture().size(), self.acquisition.sensor.max_count());
        let pictures = self.schedule.instants.pictures(self.capture());
        RestoredPage::new(size, max_count, plan.tonemap(), self.rendering.clone(), pictures)
    }

    /// Returns the settings that the pictures depend on, for the manifest and `--json`.
    pub(super) fn settings(&self, plan: &Plan) -> Result<Value> {
        let (capture, acquisition) = (self.capture(), &self.acquisition);
        let place = if plan.reads_pipe() || capture.path() != plan.capture {
            capture.path().to_owned()
        } else {
            std::path::absolute(&plan.capture).unwrap_or_else(|_| plan.capture.clone())
        };
        let mut settings = json!({
            "capture": place,
            "format": capture.info().format,
            "read": plan.read,
            "frames": capture.length(),
            "height": capture.size().height,
            "width": capture.size().width,
            "method": self.method.name,
            "choice": self.choice,
            "window": self.restorer.window(),
            "overlap": plan.overlap * self.aligned.frames_per_sum(),
            "seed": plan.light.seed,
            "network": network_settings(self.method, &plan.network)?,
            "ppp": acquisition.ppp,
            "exposure": acquisition.mean_level,
            "gain": acquisition.gain,
            "sensor": acquisition.sensor,
            "repaired_pixels": capture.bad_pixels().len(),
        });
        if capture.summed() > 1 && plan.read.sum.is_none() {
            settings["sum"] = json!(capture.summed());
        }
        let parts = capture.parts();
        if parts.len() > 1 {
            let parts: Vec<_> = parts.iter().map(|part| [part.start, part.end]).collect();
            settings["parts"] = json!(parts);
        }
        if let Some(alignment) = self.aligned.alignment {
            settings["aligned_sums"] = json!(alignment.native_frames());
        }
        if let Some(every) = plan.every {
            settings["every"] = json!(every);
        }
        if is_full_colour(capture) {
            settings["full_colour"] = json!(true);
            settings["gray"] = json!(plan.luma_alone);
            if let Some(rendering) = &self.rendering {
                settings["white_balance"] = json!(rendering.gains.0);
            }
        }
        if let Some(filter) = capture.filter() {
            settings["gray"] = json!(plan.luma_alone);
            if let (Some(rendering), Some(choice)) = (&self.rendering, &capture.info().cfa) {
                settings["dng"] = dng_tags(choice, filter, acquisition, rendering);
            }
        }
        if plan.tonemap() != Tonemap::None {
            settings["tonemap"] = json!("srgb");
        }
        if let Some(fps) = capture.fps().or(sensor_fps(acquisition)) {
            let step = self.aligned.alignment.map_or(1, Alignment::step);
            settings["capture_fps"] = json!(fps / step as f64);
        }
        Ok(settings)
    }

    /// Returns what is known of the pictures once they are made, and adds what makes them doubtful. The
    /// misfit of a part says nothing of the others: it is told, but is no result.
    pub(super) fn results(
        &mut self,
        plan: &Plan,
        chi_square: Option<f64>,
        is_whole: bool,
    ) -> Result<Value> {
        let own = self
            .method
            .as_own()
            .map(|choice| OwnNetwork::new(&plan.network, choice))
            .transpose()?;
        let mode = own.map(|own| own.mode(&plan.network));
        let sensor = &self.acquisition.sensor;
        let of_whole = chi_square.filter(|_| is_whole);
        let misfit = warnings::of_chi_square(chi_square, sensor, self.saturated);
        let before = self.warnings.len();
        self.warnings.extend(misfit);
        let warnings = if is_whole { &self.warnings[..] } else { &self.warnings[..before] };
        Ok(json!({
            "chi_square": of_whole,
            "mode": mode,
            "warnings": warnings,
            "notes": self.capture().info().notes,
            "findings": self.capture().findings(),
        }))
    }

    /// Returns the entries of the manifest of an output folder. Weights are among the settings by their
    /// SHA-256.
    fn folder_run(&self, plan: &Plan, settings: &Value) -> Result<FolderRun> {
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
            if let Some(FilterChoice::Picture(path)) = &self.capture().info().cfa {
                inputs.add("cfa", path)?;
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
        let frames = self.schedule.instants.pictures(self.capture());
        Ok(FolderRun { settings: settings.clone(), inputs, share, frames })
    }

    pub(super) fn run(
        &mut self,
        wanted: Range<u64>,
        sink: &mut dyn RestoreSink,
        network: &NetworkOptions,
        report: &Report,
    ) -> Result<()> {
        if wanted.is_empty() {
            return Ok(());
        }
        let bar = Rc::new(RefCell::new(report.bar()));
        let (begin, mut forecast) = (Instant::now(), false);
        let mut progress = |done: u64, total: Option<u64>| {
            bar.borrow_mut().update("restoring", done, total);
            if let Some(total) = total.filter(|_| done > 0 && !forecast) {
                forecast = true;
                forecast_time(begin.elapsed().as_secs_f64() / done as f64, total, report);
            }
            interrupt::check()
        };
        let shown = bar.clone();
        let observer: Observer = Rc::new(move |progress| {
            shown.borrow().stage(progress);
            interrupt::check()
        });
        let (capture, acquisition) = (&mut self.aligned.capture, &self.acquisition);
        let restorer = self.restorer.as_mut();
        let is_network = self.method.is_network();
        let schedule = &self.schedule;
        let run = || {
            observed(observer, || {
                let on = &mut progress;
                run_method(restorer, capture, schedule, wanted, acquisition, sink, on)
            })
        };
        if is_network {
            // Devices report too little memory and broken drivers by panicking.
            let run = device::guarded(&network.device, run);
            return Ok(run.map_err(|problem| device_failed(&problem, network))??);
        }
        Ok(run()?)
    }
}

/// Returns the rendering of the colours of a capture behind a colour filter, unless luma alone is restored.
fn rendering(
    plan: &Plan,
    capture: &Capture,
    summary: &Summary,
    acquisition: &Acquisition,
) -> Result<Option<Rendering>> {
    if !capture.has_colours() {
        let given = plan.gray.then_some("--gray").or(plan.white_balance.map(|_| "--wb"));
        let Some(flag) = given else { return Ok(None) };
        return Err(CliError::new(
            "the capture is gray",
            flag,
            "leave it out, or name the colour filter with --cfa",
        ));
    }
    if plan.luma_alone {
        if plan.chi_square_map.is_some() {
            return Err(CliError::new(
                "luma alone says nothing of the counts behind each colour",
                "--chi-map",
                "leave it out, or restore colours, without --gray",
            ));
        }
        return Ok(None);
    }
    let shown = plan.output != "-" && !is_linear(Path::new(&plan.output), plan.tiff);
    if plan.tonemap == Some(Tonemap::None) && shown {
        return Err(CliError::new(
            format!("pictures of colours have the curve of sRGB, as {} would", plan.output),
            "--tonemap none",
            "leave it out, or write linear light into .npy, or .tif with --float",
        ));
    }
    Ok(Some(Rendering::new(plan.white_balance, capture, summary, acquisition)))
}

/// Returns true for captures of three full planes.
fn is_full_colour(capture: &Capture) -> bool {
    capture.info().full_colour
}

/// Makes the restorer of the named method, or of the default one, for this capture.
fn restorer(
    plan: &Plan,
    source: &Source<'_>,
    sensor: &Sensor,
    aligned: &mut AlignedCapture,
    acquisition: &Acquisition,
    report: &Report,
) -> Result<(&'static Method, Built)> {
    let seen = aligned.seen_acquisition(acquisition)?;
    let method = match plan.method {
        Some(method) => method,
        None => announced_method(plan, &aligned.capture, &seen, report)?,
    };
    plan.network.check_diffusion(&[method])?;
    let part = aligned.capture.longest_part();
    let (restorer, choice) =
        aligned.capture.in_part(&part, |capture| method.restorer(capture, &seen, &plan.network))?;
    let restorer = aligned.around(restorer);
    if is_full_colour(&aligned.capture) {
        let planes = Box::new(OtherPlanes::open(source, sensor, &aligned.capture)?);
        let coloured = ColourRestorer::of_planes(restorer, planes, !plan.luma_alone);
        return Ok((method, (Box::new(coloured), choice)));
    }
    let Some(filter) = aligned.capture.filter() else { return Ok((method, (restorer, choice))) };
    let coloured = behind_filter(restorer, filter, !plan.luma_alone)?;
    Ok((method, (coloured, choice)))
}

/// Returns the default method; prints the reason if it is not the network.
fn announced_method(
    plan: &Plan,
    capture: &Capture,
    acquisition: &Acquisition,
    report: &Report,
) -> Result<&'static Method> {
    let usual = default_method(&plan.network, capture, acquisition)?;
    if let Some(reason) = &usual.reason {
        report.remark(&format!("note: {reason}: restoring by {}", usual.method.name));
    }
    Ok(usual.method)
}

/// Says how long all pictures take, if that is long enough to be worth a line.
fn forecast_time(seconds_per_picture: f64, pictures: u64, report: &Report) {
    let seconds = seconds_per_picture * pictures as f64;
    if seconds < LONG_RUN {
        return;
    }
    let time = duration(seconds);
    report.remark(&format!(
        "note: {pictures} pictures take about {time} ({seconds_per_picture:.2} s each); --every N makes fewer"
    ));
}

/// Output frames per second of a sensor whose rate is known.
fn sensor_fps(acquisition: &Acquisition) -> Option<f64> {
    let sensor = &acquisition.sensor;
    sensor.fps.map(|fps| fps / f64::from(sensor.frames_summed))
}

/// Returns the settings of the network on which the frames depend, if the method is a network.
pub(super) fn network_settings(method: &Method, options: &NetworkOptions) -> Result<Option<Value>> {
    Ok(match method.kind {
        Kind::Classical(_) => None,
        Kind::Learned { method, .. } => {
            let weights = options.weights_of(method)?;
            Some(json!({
                "weights": weights.to_string(),
                "weights_sha256": weights.sha256()?,
                "tile": options.tile,
            }))
        }
        Kind::Network(choice) => Some(OwnNetwork::new(options, choice)?.settings(options)?),
    })
}

/// Describes a run in lines.
pub(super) fn describe(
    output: &str,
    job: &Job,
    frames: u64,
    resumed: u64,
    chi_square: Option<f64>,
    seconds: Option<f64>,
) -> String {
    let (acquisition, size) = (&job.acquisition, job.capture().size());
    let made = counted(frames, "frame");
    let mut text = format!("{output}   {made} of {size} by {}\n", job.method_text());
    let mut line = |key: &str, value: String| {
        let _ = writeln!(text, "  {key:<12}{value}");
    };
    let (ppp, mean_level) = (acquisition.ppp, acquisition.mean_level);
    let source = job.light_source;
    line(
        "light",
        format!("{ppp:.4} incident photons/pixel/frame ({source}), exposure {mean_level:.4}"),
    );
    line("sensor", format!("{}, gain {:.4} DN/e-", acquisition.sensor.name, acquisition.gain));
    if let Some(rendering) = &job.rendering {
        line("colours", rendering.describe());
    }
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
