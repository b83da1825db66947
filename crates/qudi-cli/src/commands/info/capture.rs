//! `qudi info CAPTURE`: what it is, how sure that is, and what is in it.

use super::args::Info;
use super::record::{origin, record_document};
use crate::args::Global;
use crate::capture::{Input, Source, SummedCapture, describe_sum, warnings};
use crate::error::fields::flags_in_text;
use crate::error::{CliError, Result};
use crate::report::{Report, counted};
use crate::settings::Settings;
use qudi_core::atomic_file::{Overwrite, refuse_taken};
use qudi_core::colour::Colour;
use qudi_core::sensor::Sensor;
use qudi_core::{Frame, linear_to_srgb};
use qudi_io::capture::{BitOrderCheck, Capture, SumChoice, Summary};
use qudi_io::description::{MaskChoice, Packing};
use qudi_io::sidecar::Sidecar;
use qudi_io::writer::Picture;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Bytes of frames that are judged, which takes some hundredths of a second.
const JUDGED_BYTES: u64 = 1 << 25;

/// Columns of the histogram's bars.
const BAR: usize = 40;

/// Counts shown in the histogram; more are grouped.
const BINS: usize = 8;

/// Describes a capture; `record` is its record, with its path.
pub(crate) fn run(
    path: &Path,
    record: Option<&(Sidecar, PathBuf)>,
    info: &Info,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let overwrite = global.overwrite();
    if let Some(preview) = &info.preview {
        refuse_taken(preview, overwrite)?;
    }
    let options = info.reading.options(MaskChoice::Auto);
    let source = Source {
        input: Input::at(Some(path)),
        options: &options,
        sum: info.reading.sum(),
        sensor: info.sensor.as_deref(),
        judged: JUDGED_BYTES,
    };
    let summed = SummedCapture::new(source.open(settings)?, &source)?;
    let sum = summed.sum().cloned();
    let SummedCapture { mut capture, sensor, .. } = summed;
    let gain = capture.info().gain;
    let summary = Summary::measure(&mut capture, sensor.as_ref(), gain)?;
    if let Some(preview) = &info.preview {
        let mut picture = summary.picture(&capture, sensor.as_ref(), gain);
        for value in &mut picture.data {
            *value = linear_to_srgb(*value);
        }
        save(&picture, preview, overwrite)?;
    }
    let warnings = warnings::of_capture(&capture, &summary, sensor.as_ref());
    let mut text = describe(&capture, &summary, sensor.as_ref(), sum.as_ref(), &warnings);
    if let Some((record, path)) = record {
        text += &origin(record, path);
    }
    report.result(&text, || {
        let mut document = document(&capture, &summary, sensor.as_ref());
        document["sum"] = json!(sum);
        document["warnings"] = json!(warnings);
        document["record"] = record.map_or(Value::Null, |(record, _)| record_document(record));
        document
    })
}

fn save(picture: &Frame, path: &Path, overwrite: Overwrite) -> Result<()> {
    if path.extension().is_none_or(|e| !e.eq_ignore_ascii_case("png")) {
        return Err(CliError::new(
            "previews are PNG",
            path.display(),
            "use a name that ends in .png",
        ));
    }
    Ok(Picture::single(picture).save(path, overwrite)?)
}

/// Describes a capture and what is in it, line by line.
pub(crate) fn describe(
    capture: &Capture,
    summary: &Summary,
    sensor: Option<&Sensor>,
    sum: Option<&SumChoice>,
    warnings: &[String],
) -> String {
    let about = capture.info();
    let mut text = String::new();
    let mut line = |key: &str, value: String| {
        let _ = writeln!(text, "{key:<11}{value}");
    };
    let evidence = flags_in_text(&about.reasons.join(", "));
    line(
        "format",
        format!("{}: {} ({}: {evidence})", about.format, about.title, about.certainty.name()),
    );
    let depth = match capture.max_count() {
        Some(max) => format!("{} bit, counts up to {max}", 16 - max.leading_zeros()),
        None => "depth unknown".to_owned(),
    };
    let summed = match capture.summed() {
        1 => String::new(),
        n => format!(", sums of {n}"),
    };
    line("frames", format!("{} of {}, {depth}{summed}", capture.frames(), capture.size()));
    if let Some(packing) = about.packing {
        line("packing", describe_packing(packing, summary.bit_order));
    }
    if about.orient != qudi_io::description::Orientation::Raw {
        line("turned", about.orient.name().to_owned());
    }
    if let Some(fps) = capture.fps() {
        line("rate", format!("{fps} frames per second"));
    }
    let sensor_fps = sensor.and_then(|s| s.fps).filter(|_| capture.fps().is_none());
    if let (Some(sensor), Some(fps)) = (sensor, sensor_fps) {
        line(
            "rate",
            format!("not in the file; `{}` takes up to {fps} frames per second", sensor.name),
        );
    }
    line("looked at", counted(summary.sampled, "frame"));
    let ppp = &summary.ppp;
    let photons = |value: Option<f64>| value.map_or("unknown".to_owned(), |v| format!("{v:.4}"));
    let by = sensor
        .map_or("no sensor known: --sensor NAME".to_owned(), |s| format!("sensor {}", s.name));
    line(
        "light",
        format!(
            "dn {:.4}, detected {}, incident {} per pixel and frame ({by})",
            ppp.dn,
            photons(ppp.detected),
            photons(ppp.incident)
        ),
    );
    match summary.saturated {
        Some(_) if capture.max_count() == Some(1) => {
            line("ones", format!("{:.3} % of all bits", 100.0 * summary.mean));
        }
        Some(saturated) => line("saturated", format!("{:.3} % of samples", 100.0 * saturated)),
        None => {
            let largest = summary.histogram.len() - 1;
            let bits = usize::BITS - largest.leading_zeros();
            let depth = match bits {
                0 => "no frame has a count".to_owned(),
                _ => format!("if counts have {bits} bits, say --bits {bits}"),
            };
            line("largest", format!("{largest}; {depth}"));
        }
    }
    if let (Some(colours), Some(cfa)) = (summary.colours, &about.cfa) {
        let rates = Colour::ALL
            .into_iter()
            .zip(colours)
            .filter_map(|(colour, mean)| mean.map(|mean| format!("{} {mean:.4}", colour.name())));
        let rates: Vec<_> = rates.collect();
        line("colours", format!("{cfa}: mean counts {}", rates.join(", ")));
    }
    line("pixels", capture.bad_pixels().describe(capture.size()));
    histogram(&mut text, &summary.histogram);
    for remark in &about.notes {
        let _ = writeln!(text, "note       {}", flags_in_text(remark));
    }
    if let Some(choice) = sum {
        let _ = writeln!(text, "sum        {}", describe_sum(choice, capture, sensor));
    }
    for warning in warnings {
        let _ = writeln!(text, "warning    {warning}");
    }
    text
}

fn describe_packing(packing: Packing, check: Option<BitOrderCheck>) -> String {
    let axis = match packing.axis {
        qudi_io::description::PackAxis::Height => "height",
        _ => "width",
    };
    let order = packing.order;
    let judged = match check {
        Some(BitOrderCheck { seen: Some(seen), z_score }) if seen == order => {
            format!("the picture agrees, {z_score:.0} standard errors")
        }
        Some(BitOrderCheck { seen: Some(seen), z_score }) => {
            format!("but the picture says {seen}, {:.0} standard errors: see --bitorder", -z_score)
        }
        Some(BitOrderCheck { seen: None, z_score }) => {
            format!("unsure from the picture, {z_score:.1} standard errors")
        }
        None => return format!("8 pixels per byte along the {axis}, {order}"),
    };
    format!("8 pixels per byte along the {axis}, {order} ({judged})")
}

fn histogram(text: &mut String, histogram: &[u64]) {
    let total: u64 = histogram.iter().sum();
    let width = histogram.len().div_ceil(BINS);
    let bins: Vec<u64> = histogram.chunks(width).map(|bin| bin.iter().sum()).collect();
    let most = bins.iter().copied().max().unwrap_or(1).max(1);
    for (i, &bin) in bins.iter().enumerate() {
        let (low, high) = (i * width, ((i + 1) * width - 1).min(histogram.len() - 1));
        let label = if low == high { format!("{low}") } else { format!("{low}-{high}") };
        let key = if i == 0 { "counts" } else { "" };
        let bar = "#".repeat((bin as f64 / most as f64 * BAR as f64).round() as usize);
        let percent = 100.0 * bin as f64 / total.max(1) as f64;
        let _ = writeln!(text, "{key:<11}{label:>11} {percent:>7.3} % {bar}");
    }
}

fn document(capture: &Capture, summary: &Summary, sensor: Option<&Sensor>) -> Value {
    let bad = capture.bad_pixels();
    json!({
        "path": capture.path(),
        "about": capture.info(),
        "frames": capture.frames(),
        "height": capture.size().height,
        "width": capture.size().width,
        "max_count": capture.max_count(),
        "summed": capture.summed(),
        "fps": capture.fps(),
        "looked_at": summary.sampled,
        "findings": capture.findings(),
        "ppp": summary.ppp,
        "sensor": sensor.map(|sensor| &sensor.name),
        "mean": summary.mean,
        "saturated": summary.saturated,
        "histogram": summary.histogram,
        "bit_order": summary.bit_order,
        "colours": summary.colours,
        "hot": bad.hot.len(),
        "dead": bad.dead.len(),
    })
}
