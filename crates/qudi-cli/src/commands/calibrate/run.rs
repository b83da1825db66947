//! `qudi calibrate`: a dark capture into a sensor file with maps.

use super::args::Calibrate;
use crate::args::{Global, Sum};
use crate::capture::{remarks, required_sensor};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::places::calibration_maps;
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::atomic_file::{Overwrite, PendingFile, refuse_taken};
use qudi_core::npy::write_header;
use qudi_core::sensor::{DarkRate, Gain, Response, Sensor, preset};
use qudi_io::capture::{Calibration, Capture, Pedestal, calibrate};
use qudi_io::description::MaskChoice;
use serde_json::json;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

pub(crate) fn run(
    args: &Calibrate,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let overwrite = global.overwrite();
    if args.output.extension().is_none_or(|e| e != "toml") {
        return Err(CliError::new(
            "sensor files end in .toml",
            args.output.display(),
            "name it, for example, camera.toml",
        ));
    }
    let maps = calibration_maps(&args.output);
    for path in maps.iter().chain([&args.output]) {
        refuse_taken(path, overwrite)?;
    }
    if args.reading.sum() == Some(Sum::Auto) {
        return Err(CliError::new(
            "a dark capture does not say how many frames to sum",
            "--sum",
            "leave it out, or give a number",
        ));
    }
    let (mut capture, offset) = open(args)?;
    let (base, sensor) = base_sensor(args, settings, &capture)?;
    let offset = offset.or((sensor.offset > 0.0).then_some(sensor.offset));
    let gain = args.gain.or(sensor.fixed_gain());
    let fps = capture.info().exposure_rate().or(sensor.fps);
    let hot = args.hot.as_deref().map(|text| threshold(text, fps)).transpose()?;
    let mut bar = report.bar();
    let calibration = calibrate(&mut capture, &sensor, gain, offset, hot, &mut |done, total| {
        bar.update("measuring", done, Some(total));
        interrupt::check()
    })?;
    drop(bar);
    let document = document(args, base.as_deref(), &sensor, &calibration, gain, &maps);
    write_map(&maps[0], "<f4", &calibration, overwrite, |i, bytes| {
        bytes.extend(calibration.dark[i].to_le_bytes());
    })?;
    let bad = calibration.bad.mask(calibration.size);
    write_map(&maps[1], "|b1", &calibration, overwrite, |i, bytes| bytes.push(u8::from(bad[i])))?;
    PendingFile::write_whole(&args.output, document.as_bytes(), overwrite)?;
    // What was written must be readable.
    Sensor::load(&args.output.to_string_lossy())?;
    remarks(&capture, report);
    if let Some(correlation) = calibration.picture {
        report.warning(&format!(
            "neighbouring pixels have like rates (correlation {correlation:.2}): the capture shows a picture, or the sensor glows; close the shutter and cover it"
        ));
    }
    let per_second = |rate: f64| fps.map_or(String::new(), |fps| format!(" ({:.1}/s)", rate * fps));
    let mut text = String::new();
    let _ = writeln!(
        text,
        "{}   from {} dark frames of {}",
        args.output.display(),
        calibration.frames,
        calibration.size
    );
    let _ = writeln!(
        text,
        "  dark        {:.3e} e- per frame{}, the ordinary pixel",
        calibration.bulk,
        per_second(calibration.bulk)
    );
    let _ = writeln!(
        text,
        "  hot         {} pixels ({:.3} %) beyond {:.3e} e- per frame{}",
        calibration.bad.len(),
        100.0 * calibration.bad.len() as f64 / calibration.size.pixels() as f64,
        calibration.threshold,
        per_second(calibration.threshold)
    );
    if let Some(noise) = calibration.read_noise {
        let _ = writeln!(text, "  read noise  {noise:.3} e-");
    }
    if let Some(pedestal) = calibration.pedestal {
        let _ = writeln!(text, "  pedestal    {:.2} DN{}", pedestal.offset, doubt(pedestal));
    }
    for map in &maps {
        let _ = writeln!(text, "  wrote       {}", map.display());
    }
    report.result(&text, || {
        json!({
            "sensor": args.output,
            "frames": calibration.frames,
            "dark_per_frame": calibration.bulk,
            "hot_threshold_per_frame": calibration.threshold,
            "hot_pixels": calibration.bad.len(),
            "read_noise": calibration.read_noise,
            "offset": calibration.pedestal.map(|pedestal| pedestal.offset),
            "fps": fps,
            "written": maps,
        })
    })
}

/// Opens the dark capture with its pedestal, and returns the one that is given.
fn open(args: &Calibrate) -> Result<(Capture, Option<f64>)> {
    let mut options = args.reading.options(MaskChoice::None);
    let given = if options.threshold.is_none() { options.offset.take() } else { None };
    let capture = Capture::open(&args.capture, &options, None)?;
    let recorded = capture.info().sensor.as_ref().map_or(0.0, |sensor| sensor.offset);
    if recorded > 0.0 && options.threshold.is_none() {
        options.offset = Some(0.0);
        return Ok((Capture::open(&args.capture, &options, None)?, given.or(Some(recorded))));
    }
    Ok((capture, given))
}

/// Describes dark rates that cannot be told from a pedestal that was found.
fn doubt(pedestal: Pedestal) -> String {
    if pedestal.uncertain == 0.0 {
        return String::new();
    }
    let rate = pedestal.uncertain;
    format!(
        ", from the counts: dark rates below {rate:.2e} e- per frame may lie in it; --offset gives it"
    )
}

/// Returns the sensor to start from, and its name for `base` if it is a preset.
fn base_sensor(
    args: &Calibrate,
    settings: &Settings,
    capture: &Capture,
) -> Result<(Option<String>, Sensor)> {
    let (name, sensor) = if let Some(name) = &args.sensor {
        (name.clone(), settings.sensor(name)?)
    } else {
        let sensor = required_sensor(capture)?;
        (sensor.name.clone(), settings.adjusted(sensor)?)
    };
    // A preset with changes has no name to build on.
    let preset = preset(&name).is_some() && !settings.overrides_sensor();
    Ok((preset.then_some(name), sensor))
}

fn threshold(text: &str, fps: Option<f64>) -> Result<f64> {
    let fault = |what: String, help: &str| CliError::new(what, "--hot", help);
    let rate: DarkRate = text.parse().map_err(|e| fault(e, "give a rate, as in 100/s"))?;
    match (rate, fps) {
        (DarkRate::PerFrame(rate), _) => Ok(rate),
        (DarkRate::PerSecond(rate), Some(fps)) => Ok(rate / fps),
        (DarkRate::PerSecond(_), None) => Err(fault(
            "a rate per second, and the frame rate is unknown".to_owned(),
            "give the rate per frame, or a sensor with its `fps`",
        )),
    }
}

fn document(
    args: &Calibrate,
    base: Option<&str>,
    sensor: &Sensor,
    calibration: &Calibration,
    gain: Option<f64>,
    maps: &[PathBuf; 2],
) -> String {
    let quoted = |text: &str| toml::Value::String(text.to_owned()).to_string();
    let name = |path: &Path| quoted(&path.file_name().unwrap_or_default().to_string_lossy());
    let stem = args.output.file_stem().unwrap_or_default().to_string_lossy();
    let mut text = format!(
        "# Calibrated from {} dark frames of {}.\n",
        calibration.frames,
        args.capture.file_name().unwrap_or_default().to_string_lossy()
    );
    let changes = |text: &mut String| {
        let _ = writeln!(text, "name = {}", quoted(&stem));
        let _ = writeln!(
            text,
            "dark = {:e}   # e- per pixel and native frame, the ordinary pixel",
            calibration.bulk
        );
        if let Some(noise) = calibration.read_noise {
            let _ = writeln!(text, "read_noise = {noise:.4}   # e- rms");
        }
        if let Some(pedestal) = calibration.pedestal {
            let _ = writeln!(text, "offset = {:.3}   # DN without light", pedestal.offset);
        }
        if let Some(gain) = gain.filter(|_| sensor.response == Response::Linear) {
            let _ = writeln!(text, "gain = {gain:?}   # DN/e-, of the dark capture");
        }
        let _ = writeln!(text, "\n[defects]");
        let _ = writeln!(text, "dark_map = {}   # e- per native frame", name(&maps[0]));
        let _ = writeln!(text, "bad_pixels = {}   # nonzero: repaired", name(&maps[1]));
    };
    if let Some(base) = base {
        let _ = writeln!(text, "base = {}", quoted(base));
        changes(&mut text);
        return text;
    }
    // A sensor of the user's own: everything it says, then what was measured.
    let mut own = sensor.clone();
    own.name = stem.into_owned();
    own.dark = DarkRate::PerFrame(calibration.bulk);
    own.read_noise = calibration.read_noise.unwrap_or(own.read_noise);
    own.offset = calibration.pedestal.map_or(own.offset, |pedestal| pedestal.offset);
    if let Some(gain) = gain.filter(|_| own.response == Response::Linear) {
        own.gain = Gain::Fixed(gain);
    }
    let file = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    own.defects.dark_map = Some(file(&maps[0]));
    own.defects.bad_pixels = Some(file(&maps[1]));
    text + &toml::to_string(&own).unwrap_or_default()
}

fn write_map(
    path: &Path,
    descr: &str,
    calibration: &Calibration,
    overwrite: Overwrite,
    value: impl Fn(usize, &mut Vec<u8>),
) -> Result<()> {
    let size = calibration.size;
    let mut bytes = Vec::new();
    let mut file = PendingFile::create(path, overwrite)?;
    write_header(&mut bytes, descr, &[size.height, size.width]).map_err(|e| file.fault(e))?;
    (0..size.pixels()).for_each(|i| value(i, &mut bytes));
    file.write_all(&bytes).map_err(|e| file.fault(e))?;
    Ok(file.finish()?)
}
