//! `qudi restore`: a capture through a method into frames.

use crate::args::{Global, Restore};
use crate::cmd::capture_info::{remarks, required_sensor};
use crate::cmd::methods::method;
use crate::cmd::restore_output::{Misfit, Output};
use crate::error::{Fault, Result};
use crate::interrupt;
use crate::report::Report;
use qudi_sim::SimError;
use qudi_sim::capture::{Capture, MaskChoice, Summary};
use qudi_sim::output::{ArrayWriter, Overwrite, Picture, refuse_taken};
use qudi_sim::restore::{Context, Restorer, Windows, run as run_method};
use qudi_sim::sensor::Sensor;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::ops::Range;
use std::path::Path;
use std::time::Instant;

pub(crate) fn run(args: &Restore, global: &Global, report: &Report) -> Result<()> {
    if args.output == "-" && report.json() {
        return Err(Fault::new(
            "--json and -o - both write to standard output",
            "--json",
            "write the frames to a file",
        ));
    }
    let overwrite = if global.force { Overwrite::Yes } else { Overwrite::No };
    for path in [&args.chi_map, &args.side_by_side].into_iter().flatten() {
        refuse_taken(path, overwrite)?;
    }
    if args.shard.is_some() && args.side_by_side.is_some() {
        return Err(Fault::new(
            "a part of the work has not all the frames to show",
            "--side-by-side",
            "ask for it when all parts are done: the same command without --shard",
        ));
    }
    Output::refuse_taken(&args.output, args.shard.is_some(), overwrite)?;
    let mut job = Job::prepare(args)?;
    let mut output = Output::open(&args.output, &job.capture, &job.settings, overwrite)?;
    let start = Instant::now();
    let frames = job.capture.frames();
    let part = args.shard.map_or(0..frames, |shard| shard.range(frames));
    let mut misfit = Misfit::new(&job.capture, &job.context);
    let done = output.finished(part.clone());
    let rest = part.start + done..part.end;
    if done == 0 {
        job.run(rest, &mut output, Some(&mut misfit), report)?;
    } else {
        // Frames of an interrupted run are judged with the others, in the same order; but after
        // the rest is made, so that a run that keeps being killed still gets on.
        job.run(rest, &mut output, None, report)?;
        misfit.read_finished(&output, &mut job.capture, part.clone())?;
    }
    let results = json!({"chi_square": misfit.chi_square()});
    let complete = part == (0..frames) || output.finished(0..frames) == frames;
    output.finish(&results, complete)?;
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

/// Everything that a run needs.
struct Job {
    capture: Capture,
    context: Context,
    /// Where the light comes from.
    source: &'static str,
    restorer: Box<dyn Restorer>,
    /// What the method chose for this clip.
    choice: String,
    windows: Windows,
    settings: Value,
}

impl Job {
    fn prepare(args: &Restore) -> Result<Self> {
        let named = args.sensor.as_deref().map(Sensor::load).transpose()?;
        let options = args.reading.options(MaskChoice::Auto);
        let mut capture = Capture::open(&args.capture, &options, named.as_ref())?;
        let sensor = match named {
            Some(sensor) => sensor,
            None => required_sensor(&capture)?,
        };
        let (context, source) = context(args, &mut capture, &sensor)?;
        let (restorer, choice) = method(&args.method, &mut capture, &context)?;
        let windows = Windows::new(capture.frames(), restorer.window() as u64, args.overlap)?;
        let settings = json!({
            "capture": std::path::absolute(&args.capture).unwrap_or_else(|_| args.capture.clone()),
            "format": capture.about().format,
            "read": options,
            "frames": capture.frames(),
            "height": capture.size().height,
            "width": capture.size().width,
            "method": restorer.name(),
            "choice": choice,
            "window": restorer.window(),
            "overlap": args.overlap,
            "seed": args.seed,
            "ppp": context.ppp,
            "exposure": context.exposure,
            "gain": context.gain,
            "sensor": context.sensor,
            "repaired_pixels": capture.bad_pixels().len(),
        });
        Ok(Self { capture, context, source, restorer, choice, windows, settings })
    }

    fn run(
        &mut self,
        wanted: Range<u64>,
        output: &mut Output,
        misfit: Option<&mut Misfit>,
        report: &Report,
    ) -> Result<()> {
        if wanted.is_empty() {
            return Ok(());
        }
        let mut bar = report.bar();
        let mut progress = |done: u64, total: u64| {
            bar.update("restoring", done, Some(total));
            interrupt::check()
        };
        let mut sink = output.sink(misfit);
        let (capture, context) = (&mut self.capture, &self.context);
        let restorer = self.restorer.as_mut();
        Ok(run_method(restorer, capture, &self.windows, wanted, context, &mut sink, &mut progress)?)
    }
}

fn describe(
    args: &Restore,
    job: &Job,
    frames: u64,
    resumed: u64,
    chi_square: Option<f64>,
    seconds: Option<f64>,
) -> String {
    let (context, size) = (&job.context, job.capture.size());
    let (name, choice) = (job.restorer.name(), &job.choice);
    let mut text = format!("{}   {frames} frames of {size} by {name}{choice}\n", args.output);
    let mut line = |key: &str, value: String| {
        let _ = writeln!(text, "  {key:<12}{value}");
    };
    let (ppp, exposure) = (context.ppp, context.exposure);
    let source = job.source;
    line("light", format!("{ppp:.4} incident photons/pixel/frame ({source}), exposure {exposure}"));
    line("sensor", format!("{}, gain {:.4} DN/e-", context.sensor.name, context.gain));
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

/// What is known of light and sensor, and where the light comes from.
fn context(
    args: &Restore,
    capture: &mut Capture,
    sensor: &Sensor,
) -> Result<(Context, &'static str)> {
    if !(args.exposure.is_finite() && args.exposure > 0.0) {
        return Err(Fault::new(
            format!("an exposure of {}", args.exposure),
            "--exposure",
            "give the mean image value, between 0 and 1",
        ));
    }
    let of_frames = capture.output_sensor(sensor)?;
    let recorded = capture.about().ppp.map(|ppp| ppp * f64::from(capture.summed()));
    let known_gain = args.gain.or(capture.about().gain);
    let (ppp, source) = match (args.ppp, recorded) {
        (Some(ppp), _) => (ppp, "given"),
        (None, Some(ppp)) => (ppp, "from the record"),
        (None, None) => {
            let summary = Summary::measure(capture, Some(sensor), known_gain)?;
            let ppp = summary.ppp.incident.ok_or_else(|| {
                Fault::new(
                    format!(
                        "the light cannot be estimated: the gain of `{}` follows it",
                        sensor.name
                    ),
                    "--ppp",
                    "give the photons per pixel and frame, or the gain with --gain",
                )
            })?;
            (ppp, "estimated")
        }
    };
    if !(ppp.is_finite() && ppp > 0.0) {
        return Err(Fault::new(
            format!("{ppp} photons per pixel and frame"),
            "--ppp",
            "the capture is dark, or the sensor's dark rate too high: give the light, or another --sensor",
        ));
    }
    let gain = match known_gain {
        Some(gain) => gain,
        None => of_frames.gain_at(ppp)?,
    };
    let summed = of_frames.frames_summed as f32;
    let dark = capture.dark().map(|map| map.iter().map(|dark| dark * summed).collect());
    let context = Context {
        seed: args.seed,
        first_frame: 0,
        ppp,
        exposure: args.exposure,
        sensor: of_frames,
        gain,
        dark,
    };
    Ok((context, source))
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
