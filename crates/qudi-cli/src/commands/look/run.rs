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
use crate::report::html::{data_url, render};
use crate::report::{Output, Report, duration};
use crate::settings::Settings;
use qudi_burst::{PostFilter, Qbp};
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
const JUDGED_BYTES: u64 = 1 << 30;

/// Rough time in seconds for aligning and merging one instant, where methods take [`Method::cost`].
///
/// [`Method::cost`]: crate::methods::Method::cost
const INSTANT_COST: f64 = 0.065;

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
    let light = LightOverrides { ppp: None, gain, mean_level: None, seed: 0 };
    let summary = light.measure(&mut capture, sensor.as_ref())?;
    let warnings = warnings::of_capture(&capture, &summary);
    let mut text = describe(&capture, &summary, sensor.as_ref(), sum.as_ref(), &warnings);
    let mut line = |value: &str| {
        let _ = writeln!(text, "restore    {value}");
    };
    let mean = for_the_eye(summary.picture(&capture, sensor.as_ref(), gain));
    let acquired = match sensor {
        Some(sensor) => CaptureAcquisition::new(&light, &mut capture, &sensor, &summary),
        None => ideal_sensor(&capture).and_then(|sensor| {
            let summary = light.measure(&mut capture, Some(&sensor))?;
            CaptureAcquisition::new(&light, &mut capture, &sensor, &summary)
        }),
    };
    let mut picture = Picture::new(mean.size, 1, 2, 1);
    picture.place(0, 0, &["MEAN"], &mean);
    let mut forecast = Value::Null;
    match acquired {
        Ok(CaptureAcquisition { acquisition, .. }) => {
            let start = Instant::now();
            let part = capture.longest_part();
            let instant =
                capture.in_part(&part, |capture| restore_instant(capture, &acquisition))?;
            let seconds = start.elapsed().as_secs_f64();
            picture.place(0, 1, &["ONE INSTANT"], &for_the_eye(instant.with_white_at_highlights()));
            let (words, document) = plan(&capture, &acquisition, seconds)?;
            line(&words);
            forecast = document;
        }
        Err(CliError::Error { what, .. }) => line(&format!("not yet: {what}")),
        Err(other) => return Err(other),
    }
    let png = picture.to_png()?;
    if picture_only {
        file.write(|| Ok(png))?;
    } else {
        file.write(|| {
            let context = json!({
                "title": args.capture.display().to_string(),
                "picture": data_url(&png),
                "averaged": summary.sampled,
                "aligned": WINDOW.min(capture.frames()),
                "strip": strip(capture.timeline(), capture.findings()),
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

/// Returns a sensor that detects every photon, for binary frames of an unknown camera.
fn ideal_sensor(capture: &Capture) -> Result<Sensor> {
    if !capture.info().binary {
        return Err(unknown_sensor(capture));
    }
    let mut ideal = Sensor::load("ideal")?;
    (ideal.response, ideal.bits, ideal.frames_summed) = (Response::Binary, 1, 1);
    Ok(ideal)
}

/// Aligns and merges sums around the middle of the capture.
fn restore_instant(capture: &mut Capture, acquisition: &Acquisition) -> Result<Frame> {
    let length = capture.frames().min(WINDOW);
    let first = if capture.forward_only() { 0 } else { (capture.frames() - length) / 2 };
    let size = capture.size();
    let mut frames = vec![vec![0; size.pixels()]; length as usize];
    for (frame, counts) in (first..).zip(&mut frames) {
        capture.read(frame, counts)?;
    }
    let view = BurstView { size, frames: &frames };
    let mut qbp = Qbp::new(PostFilter::Bm3d);
    Ok(qbp.restore_frames(view, acquisition, &[frames.len() / 2])?.frames.swap_remove(0))
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
        "`qudi restore` makes {pictures} pictures by {}{reason}, sensor {sensor}, in about {time}; --every N makes fewer",
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
