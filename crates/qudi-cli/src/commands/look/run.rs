//! `qudi look`: an overview of a capture.

use super::args::Look;
use super::strip::strip;
use crate::args::given::Given;
use crate::args::{Global, Network};
use crate::capture::{
    CaptureAcquisition, Input, LightOverrides, Source, SummedCapture, unknown_sensor, warnings,
};
use crate::commands::info::capture::describe;
use crate::error::{CliError, Result};
use crate::methods::default::default_method;
use crate::places::default_look;
use crate::report::html::render;
use crate::report::player::{Kind, Layer, Player, QUALITY, Scene, counts_url, picture_url};
use crate::report::{Output, Report, counted, duration};
use crate::settings::Settings;
use qudi_burst::{ColourRestorer, PostFilter, Qbp};
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::{Response, Sensor};
use qudi_core::{Frame, linear_to_srgb};
use qudi_io::capture::Capture;
use qudi_io::description::MaskChoice;
use qudi_io::writer::Picture;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::time::Instant;

/// Sums of the window that one instant is restored from.
const WINDOW: u64 = 11;

/// Bytes of frames that are judged, which takes less than a second.
pub(crate) const JUDGED_BYTES: u64 = 1 << 30;

/// Rough time in seconds for aligning and merging one instant, where methods take [`Method::cost`].
///
/// [`Method::cost`]: crate::methods::Method::cost
const INSTANT_COST: f64 = 0.065;

/// Seconds of an instant that is not restored twice.
const LONG_INSTANT: f64 = 2.0;

pub(crate) fn run(
    args: &Look,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let output = match &args.output {
        Some(output) => output.clone(),
        None => default_look(&args.capture),
    };
    let picture_only = match output.extension().map(|e| e.to_string_lossy().to_lowercase()) {
        Some(extension) if extension == "html" => false,
        Some(extension) if extension == "png" => true,
        _ => {
            let help = "use a name that ends in .html, or .png for the pictures alone";
            return Err(CliError::new("a look is .html or .png", output.display(), help));
        }
    };
    let file = Output::open(Some(&output), global.overwrite())?;
    let options = args.reading.options(MaskChoice::Auto);
    let source = Source {
        input: Input::at(Some(&args.capture)),
        options: &options,
        sum: args.reading.sum(),
        sensor: args.sensor.as_deref(),
        judged: JUDGED_BYTES,
    };
    let summed = SummedCapture::new(source.open(settings)?, &source)?;
    let sum = summed.sum().cloned();
    let SummedCapture { mut capture, sensor, .. } = summed;
    let gain = capture.info().gain;
    let light = LightOverrides { ppp: None, gain: None, mean_level: None, seed: 0, white: None };
    let summary = light.measure(&mut capture, sensor.as_ref())?;
    let warnings = warnings::of_capture(&capture, &summary, sensor.as_ref());
    let mut text = describe(&capture, &summary, sensor.as_ref(), sum.as_ref(), &warnings);
    let mut line = |value: &str| {
        let _ = writeln!(text, "restore    {value}");
    };
    let mean = for_the_eye(summary.picture(&capture, sensor.as_ref(), gain));
    let unknown = sensor.is_none().then(|| unknown_sensor(&capture));
    let acquired = match sensor {
        Some(sensor) => CaptureAcquisition::new(&light, &mut capture, &sensor, &summary),
        None => ideal_sensor(&capture).and_then(|sensor| {
            let summary = light.measure(&mut capture, Some(&sensor))?;
            CaptureAcquisition::new(&light, &mut capture, &sensor, &summary)
        }),
    };
    let mut picture = Picture::new(mean.size, 1, 2, 1);
    picture.place(0, 0, &["MEAN"], &mean);
    let part = capture.longest_part();
    let (first, counts) = capture.in_part(&part, read_window)?;
    let first = first + part.start / u64::from(capture.summed());
    let mut restored = None;
    let mut forecast = Value::Null;
    match acquired {
        Ok(CaptureAcquisition { acquisition, .. }) => {
            let (instant, seconds) = timed_instant(&counts, &capture, &acquisition)?;
            let instant = for_the_eye(instant.with_white_at_highlights());
            picture.place(0, 1, &["ONE INSTANT"], &instant);
            restored = Some(instant);
            if let Some(CliError::Error { what, help, .. }) = unknown {
                line(&not_yet(&what, help.as_deref()));
            } else {
                let (words, document) = plan(&capture, &acquisition, seconds)?;
                line(&words);
                forecast = document;
            }
        }
        Err(CliError::Error { what, help, .. }) => line(&not_yet(&what, help.as_deref())),
        Err(other) => return Err(other),
    }
    if picture_only {
        file.write(|| Ok(picture.to_png()?))?;
    } else {
        file.write(|| {
            let pictures = Pictures {
                mean: &mean,
                instant: restored.as_ref(),
                counts: &counts,
                strip: strip(capture.timeline(), capture.findings()),
            };
            let context = json!({
                "title": args.capture.display().to_string(),
                "players": [pictures.player(first, capture.frames(), summary.sampled)],
                "text": text,
            });
            render("look.html", context)
        })?;
    }
    let text = format!("{text}{}\n", output.display());
    report.result(&text, || {
        json!({
            "output": output,
            "format": capture.info().format,
            "frames": capture.frames(),
            "summed": capture.summed(),
            "sum": sum,
            "ppp": summary.ppp,
            "warnings": warnings,
            "findings": capture.findings(),
            "restore": forecast,
        })
    })
}

/// Says why `qudi restore` refuses the capture as it is, and the remedy.
fn not_yet(what: &str, help: Option<&str>) -> String {
    let help = help.map_or(String::new(), |help| format!(": {help}"));
    format!("not yet: {what}{help}")
}

/// Returns a sensor that detects every photon, for the one instant of binary frames of an unknown camera.
fn ideal_sensor(capture: &Capture) -> Result<Sensor> {
    if !capture.info().binary {
        return Err(unknown_sensor(capture));
    }
    let mut ideal = Sensor::load("ideal")?;
    (ideal.response, ideal.bits, ideal.frames_summed) = (Response::Binary, 1, 1);
    Ok(ideal)
}

/// Reads sums around the middle of a part, and returns the number of the first one.
fn read_window(capture: &mut Capture) -> Result<(u64, Vec<Vec<u16>>)> {
    let length = capture.frames().min(WINDOW);
    let first = if capture.forward_only() { 0 } else { (capture.frames() - length) / 2 };
    let mut frames = vec![vec![0; capture.size().pixels()]; length as usize];
    for (frame, counts) in (first..).zip(&mut frames) {
        capture.read(frame, counts)?;
    }
    Ok((first, frames))
}

/// Restores the instant in the middle, and returns its time in seconds: of the faster of two runs, since the
/// first one prepares what all others use.
fn timed_instant(
    frames: &[Vec<u16>],
    capture: &Capture,
    acquisition: &Acquisition,
) -> Result<(Frame, f64)> {
    let mut seconds = f64::INFINITY;
    loop {
        let start = Instant::now();
        let instant = restore_instant(frames, capture, acquisition)?;
        let own = start.elapsed().as_secs_f64();
        if seconds.is_finite() || own > LONG_INSTANT {
            return Ok((instant, seconds.min(own)));
        }
        seconds = own;
    }
}

/// Aligns and merges sums, and returns the one in the middle.
fn restore_instant(
    frames: &[Vec<u16>],
    capture: &Capture,
    acquisition: &Acquisition,
) -> Result<Frame> {
    let view = BurstView { size: capture.size(), frames };
    let mut method: Box<dyn Restorer> = Box::new(Qbp::new(PostFilter::Bm3d));
    if let Some(filter) = capture.filter() {
        method = Box::new(ColourRestorer::new(method, filter.clone(), false));
    }
    Ok(method.restore_frames(view, acquisition, &[frames.len() / 2])?.frames.swap_remove(0))
}

/// The pictures of the page.
struct Pictures<'a> {
    mean: &'a Frame,
    /// One instant, where the light is known.
    instant: Option<&'a Frame>,
    /// The sums that the instant is made of.
    counts: &'a [Vec<u16>],
    /// Light and change over time.
    strip: Option<String>,
}

impl Pictures<'_> {
    /// Returns the pictures as the template plays them; `first` is the number of the first sum of the
    /// capture's `total`, and `averaged` the number of frames in the mean.
    fn player(&self, first: u64, total: u64, averaged: u64) -> Player {
        let (size, frames) = (self.mean.size, self.counts.len());
        let brightest = self.counts.iter().flatten().copied().max().unwrap_or(0);
        let full = f32::from(brightest.max(1));
        let gray = |counts: &Vec<u16>| Frame {
            size,
            data: counts.iter().map(|&count| f32::from(count) / full).collect(),
        };
        let counts = self.counts.iter().map(|counts| counts_url(&gray(counts), QUALITY));
        let mut scene = Scene::new("Mean, counts, one instant", size, frames as u64);
        scene.caption = vec![format!(
            "The mean of {averaged} frames, response inverted, bad pixels repaired; {frames} sums around the middle \
             of the capture; and one instant, for which these are aligned and merged. Mean and instant are brightened \
             for the eye (sRGB), white at the 99.5th percentile."
        )];
        let numbers = first..first + frames as u64;
        scene.numbers = Some(numbers.collect());
        scene.total = Some(total);
        scene.layers = vec![
            Layer::new("mean", Kind::Restored, vec![picture_url(self.mean, QUALITY)]),
            Layer::new("counts", Kind::Counts, counts.collect()),
        ];
        if let Some(instant) = self.instant {
            let frames = vec![picture_url(instant, QUALITY)];
            scene.layers.push(Layer::new("one instant", Kind::Restored, frames));
        }
        scene.right = scene.layers.len() - 1;
        scene.strip.clone_from(&self.strip);
        scene.player()
    }
}

/// Describes what `qudi restore` would do, and about how long that takes.
fn plan(capture: &Capture, acquisition: &Acquisition, seconds: f64) -> Result<(String, Value)> {
    let usual =
        default_method(&Network::default().options(None, &Given::default()), capture, acquisition)?;
    let pictures = capture.frames();
    let total = seconds * usual.method.cost / INSTANT_COST * pictures as f64;
    let time = duration(total);
    let reason = usual.reason.map_or(String::new(), |reason| format!(" ({reason})"));
    let sensor = &acquisition.sensor.name;
    let words = format!(
        "`qudi restore` makes {} by {}{reason}, sensor {sensor}, in about {time}; --every N makes fewer",
        counted(pictures, "picture"),
        usual.method.name
    );
    let document = json!({"method": usual.method.name, "pictures": pictures, "seconds": total});
    Ok((words, document))
}

/// Applies the tone curve of screens.
fn for_the_eye(mut frame: Frame) -> Frame {
    for value in &mut frame.data {
        *value = linear_to_srgb(*value);
    }
    frame
}
