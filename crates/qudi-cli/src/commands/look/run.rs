//! `qudi look`: an overview of a capture.

use super::args::Look;
use super::mosaic::{gray_world, interpolated};
use super::shown::Shown;
use super::strip::strip;
use crate::args::given::Given;
use crate::args::{Global, Network};
use crate::capture::{
    AlignedCapture, CaptureAcquisition, Input, LightOverrides, Source, SummedCapture,
    unknown_sensor, warnings,
};
use crate::colour::Rendering;
use crate::commands::info::capture::describe;
use crate::error::{CliError, Result};
use crate::methods::default::default_method;
use crate::places::default_look;
use crate::report::grid::Grid;
use crate::report::html::render;
use crate::report::player::{Kind, Layer, Player, QUALITY, Scene, colour_url, counts_url};
use crate::report::{Output, Report, counted, duration};
use crate::settings::Settings;
use qudi_burst::{ColourRestorer, PostFilter, Qbp};
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::{Response, Sensor};
use qudi_core::{Frame, Size};
use qudi_io::capture::{Capture, Summary};
use qudi_io::description::MaskChoice;
use qudi_io::writer::Picture;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Instant;

/// Sums of the window that one instant is restored from.
const WINDOW: u64 = 11;

/// Bytes of frames that are judged, which takes less than a second.
pub(crate) const JUDGED_BYTES: u64 = 1 << 30;

/// Seconds from which on fewer pictures are suggested, and their number.
const LONG_RUN: f64 = 60.0;
const FEW_PICTURES: u64 = 10;

/// Rough time in seconds for aligning and merging one instant, where methods take [`Method::cost`].
///
/// [`Method::cost`]: crate::methods::Method::cost
const INSTANT_COST: f64 = 0.065;

/// Time of a picture in colour, in units of a gray one's.
const COLOUR_COST: f64 = 1.6;

/// Seconds of an instant that is not restored twice.
const LONG_INSTANT: f64 = 2.0;

pub(crate) fn run(
    args: &Look,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let (output, picture_only) = output(args)?;
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
    let mean = summary.picture(&capture, sensor.as_ref(), gain);
    let unknown = sensor.is_none().then(|| unknown_sensor(&capture));
    let acquired = match sensor {
        Some(sensor) => CaptureAcquisition::new(&light, &mut capture, &sensor, &summary),
        None => ideal_sensor(&capture).and_then(|sensor| {
            let summary = light.measure(&mut capture, Some(&sensor))?;
            CaptureAcquisition::new(&light, &mut capture, &sensor, &summary)
        }),
    };
    let acquisition = acquired.as_ref().ok().map(|acquired| &acquired.acquisition);
    let rendering = rendering(&capture, &summary, acquisition);
    let mean = match (capture.filter(), &rendering) {
        (Some(filter), Some(rendering)) => Shown::colour(&interpolated(&mean, filter), rendering),
        _ => Shown::gray(mean),
    };
    let part = capture.longest_part();
    let (first, counts) = capture.in_part(&part, read_window)?;
    let first = first + part.start / u64::from(capture.summed());
    let mut restored = None;
    let mut forecast = Value::Null;
    match acquired {
        Ok(CaptureAcquisition { acquisition, .. }) => {
            let colours = rendering.as_ref();
            let (instant, seconds) = timed_instant(&counts, &capture, &acquisition, colours)?;
            restored = Some(instant);
            if let Some(CliError::Error { what, help, .. }) = unknown {
                line(&not_yet(&what, help.as_deref()));
            } else {
                // What is bad was looked for already.
                let source = Source { judged: 0, ..source };
                let seen = match &sum {
                    Some(_) => seen_acquisition(&source, settings, &capture, &acquisition)?,
                    None => acquisition,
                };
                let (words, document) = plan(&capture, &seen, seconds)?;
                line(&words);
                forecast = document;
            }
        }
        Err(CliError::Error { what, help, .. }) => line(&not_yet(&what, help.as_deref())),
        Err(other) => return Err(other),
    }
    if picture_only {
        file.write(|| png(capture.size(), &mean, restored.as_ref()))?;
    } else {
        file.write(|| {
            let pictures = Pictures {
                capture: &capture,
                mean: &mean,
                instant: restored.as_ref(),
                counts: &counts,
                rendering: rendering.as_ref(),
            };
            let context = json!({
                "title": args.capture.display().to_string(),
                "players": [pictures.player(first, summary.sampled)],
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

/// Returns the file that is written, and whether it holds the pictures alone.
fn output(args: &Look) -> Result<(PathBuf, bool)> {
    let output = args.output.clone().unwrap_or_else(|| default_look(&args.capture));
    match output.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
        Some("html") => Ok((output, false)),
        Some("png") => Ok((output, true)),
        _ => {
            let help = "use a name that ends in .html, or .png for the pictures alone";
            Err(CliError::new("a look is .html or .png", output.display(), help))
        }
    }
}

/// Returns the rendering of the colours of a mosaic; `acquisition` is none where the light is unknown.
fn rendering(
    capture: &Capture,
    summary: &Summary,
    acquisition: Option<&Acquisition>,
) -> Option<Rendering> {
    capture.filter()?;
    Some(match acquisition {
        Some(acquisition) => Rendering::new(None, capture, summary, acquisition),
        None => gray_world(summary.colours),
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

/// Restores the instant in the middle, and returns the time in seconds that a picture takes like it: of the
/// faster of two runs, since the first one prepares what all others use.
fn timed_instant(
    frames: &[Vec<u16>],
    capture: &Capture,
    acquisition: &Acquisition,
    rendering: Option<&Rendering>,
) -> Result<(Shown, f64)> {
    let coloured = match capture.filter() {
        Some(_) => Some(restore_instant(frames, capture, acquisition, rendering)?),
        None => None,
    };
    let mut seconds = f64::INFINITY;
    loop {
        let start = Instant::now();
        let gray = restore_gray(frames, capture, acquisition)?;
        let own = start.elapsed().as_secs_f64();
        if seconds.is_finite() || own > LONG_INSTANT {
            let seconds = seconds.min(own);
            // What colours cost is shared by the pictures of a window.
            return Ok(match coloured {
                Some(instant) => (instant, COLOUR_COST * seconds),
                None => (gray, seconds),
            });
        }
        seconds = own;
    }
}

/// Aligns and merges sums as gray ones, and returns the one in the middle.
fn restore_gray(
    frames: &[Vec<u16>],
    capture: &Capture,
    acquisition: &Acquisition,
) -> Result<Shown> {
    let view = BurstView { size: capture.size(), frames };
    let mut method = Qbp::new(PostFilter::Bm3d);
    let mut restored = method.restore_frames(view, acquisition, &[frames.len() / 2])?;
    Ok(Shown::gray(restored.frames.swap_remove(0).with_white_at_highlights()))
}

/// Aligns and merges sums, in colour where there is a filter, and returns the one in the middle.
fn restore_instant(
    frames: &[Vec<u16>],
    capture: &Capture,
    acquisition: &Acquisition,
    rendering: Option<&Rendering>,
) -> Result<Shown> {
    let (Some(filter), Some(rendering)) = (capture.filter(), rendering) else {
        return restore_gray(frames, capture, acquisition);
    };
    let view = BurstView { size: capture.size(), frames };
    let method = Box::new(Qbp::new(PostFilter::Bm3d));
    let mut method = ColourRestorer::new(method, filter.clone(), true);
    let restored = method.restore_frames(view, acquisition, &[frames.len() / 2])?;
    Ok(match &restored.colour {
        Some(colour) => Shown::colour(&colour[0], rendering),
        None => Shown::gray(restored.frames[0].clone().with_white_at_highlights()),
    })
}

/// Encodes the mean next to one instant.
fn png(size: Size, mean: &Shown, instant: Option<&Shown>) -> Result<Vec<u8>> {
    let list = [Some(("MEAN", mean)), instant.map(|instant| ("ONE INSTANT", instant))];
    let list = (0..).zip(list.into_iter().flatten());
    if let Shown::Colour(_) = mean {
        let mut grid = Grid::new(size, 1, 2, 1);
        for (column, (label, shown)) in list {
            grid.place(0, column, &[label], shown.planes());
        }
        return grid.png();
    }
    let mut picture = Picture::new(size, 1, 2, 1);
    for (column, (label, shown)) in list {
        picture.place(0, column, &[label], shown.planes()[0]);
    }
    Ok(picture.to_png()?)
}

/// The pictures of the page.
struct Pictures<'a> {
    capture: &'a Capture,
    mean: &'a Shown,
    /// One instant, where the light is known.
    instant: Option<&'a Shown>,
    /// The sums that the instant is made of.
    counts: &'a [Vec<u16>],
    /// Rendering of colours, of a mosaic.
    rendering: Option<&'a Rendering>,
}

impl Pictures<'_> {
    /// Returns the pictures as the template plays them; `first` is the number of the first sum, and
    /// `averaged` the number of frames in the mean.
    fn player(&self, first: u64, averaged: u64) -> Player {
        let (size, frames) = (self.capture.size(), self.counts.len());
        let brightest = self.counts.iter().flatten().copied().max().unwrap_or(0);
        let full = f32::from(brightest.max(1));
        let gray = |counts: &Vec<u16>| Frame {
            size,
            data: counts.iter().map(|&count| f32::from(count) / full).collect(),
        };
        let colours = self.capture.filter().zip(self.rendering);
        let url = |counts: &Vec<u16>| match colours {
            Some((filter, rendering)) => {
                colour_url(&rendering.rendered(&interpolated(&gray(counts), filter)), QUALITY)
            }
            None => counts_url(&gray(counts), QUALITY),
        };
        let counts = self.counts.par_iter().map(url);
        let mut scene = Scene::new("Mean, counts, one instant", size, frames as u64);
        scene.notes = vec![format!(
            "The mean of {averaged} frames, response inverted, bad pixels repaired; {frames} sums around the middle \
             of the capture; and one instant, for which these are aligned and merged. Mean and instant are brightened \
             for the eye (sRGB), white at the 99.5th percentile."
        )];
        if let Some(rendering) = self.rendering {
            scene.notes.push(format!(
                "Colours of mean and counts are interpolated from the pixels that see them, and balanced: {}.",
                rendering.describe()
            ));
        }
        let numbers = first..first + frames as u64;
        scene.numbers = Some(numbers.collect());
        scene.total = Some(self.capture.frames());
        scene.layers = vec![
            Layer::new("mean", Kind::Restored, vec![self.mean.url()]),
            Layer::new("counts", Kind::Counts, counts.collect()),
        ];
        if let Some(instant) = self.instant {
            scene.layers.push(Layer::new("one instant", Kind::Restored, vec![instant.url()]));
        }
        scene.right = scene.layers.len() - 1;
        scene.strip = strip(self.capture.timeline(), self.capture.findings());
        scene.player()
    }
}

/// Returns the acquisition that the default method sees: of aligned sums, where plain ones are kept short.
fn seen_acquisition(
    source: &Source<'_>,
    settings: &Settings,
    capture: &Capture,
    acquisition: &Acquisition,
) -> Result<Acquisition> {
    let summed = SummedCapture::new(source.open(settings)?, source)?;
    let sensor = summed.required_sensor()?;
    let aligned = AlignedCapture::new(summed, source, &sensor, None, None)?;
    let Some(alignment) = aligned.alignment else { return Ok(acquisition.clone()) };
    let mut seen = acquisition.clone();
    let ratio = alignment.native_frames() as f64 / f64::from(capture.summed());
    seen.ppp *= ratio;
    seen.sensor.frames_summed = (f64::from(seen.sensor.frames_summed) * ratio).round() as u32;
    Ok(seen)
}

/// Describes what `qudi restore` would do with frames like `acquisition`, and about how long that takes.
fn plan(capture: &Capture, acquisition: &Acquisition, seconds: f64) -> Result<(String, Value)> {
    let usual =
        default_method(&Network::default().options(None, &Given::default()), capture, acquisition)?;
    let pictures = capture.frames();
    let total = seconds * usual.method.cost / INSTANT_COST * pictures as f64;
    let time = duration(total);
    let reason = usual.reason.map_or(String::new(), |reason| format!(" ({reason})"));
    let sensor = &acquisition.sensor.name;
    let few = if total > LONG_RUN && pictures > 2 * FEW_PICTURES {
        let every = pictures * u64::from(capture.summed()) / FEW_PICTURES;
        let time = duration(total * FEW_PICTURES as f64 / pictures as f64);
        format!("--every {every} makes {FEW_PICTURES}, in about {time}")
    } else {
        "--every N makes fewer".to_owned()
    };
    let words = format!(
        "`qudi restore` makes {} by {}{reason}, sensor {sensor}, in about {time}; {few}",
        counted(pictures, "picture"),
        usual.method.name
    );
    let document = json!({"method": usual.method.name, "pictures": pictures, "seconds": total});
    Ok((words, document))
}
