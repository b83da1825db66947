//! `qudi simulate`: settings to simulation, exposed frames to files.

use super::args::Simulate;
use super::outputs::Outputs;
use super::plan::Plan;
use crate::args::Global;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::{Report, counted};
use crate::settings::Settings;
use qudi_io::sidecar::{BurstLayout, ClipDigest, Record, VERSION};
use qudi_io::writer::BurstFormat;
use qudi_sim::{Simulation, Stage, Summary, simulate};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::PathBuf;

pub(crate) fn run(
    args: &Simulate,
    settings: Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let Plan { mut simulation, recorded, outputs: plan } =
        Plan::new(args, settings, global, report.json())?;
    let mut outputs = Outputs::new(&plan);
    simulation.input.spool(&mut std::io::stdin().lock(), &mut interrupt::check)?;
    let mut bar = report.bar();
    let summary = simulate(&simulation, &mut outputs, &mut |progress| {
        let what = match progress.stage {
            Stage::Measuring => "measuring",
            Stage::Exposing => "exposing",
        };
        bar.update(what, progress.done, progress.total);
        interrupt::check()
    })?;
    drop(bar);
    if let Some((crc32, path)) = &recorded
        && *crc32 != summary.clip_crc32
    {
        return Err(CliError::new(
            "the input has changed since the record was written",
            path.display(),
            "restore the old input; `simulation.input` in the record names it",
        ));
    }
    if let Some(asked) = simulation.sampling.frames
        && summary.frames < asked
    {
        let frames = counted(summary.frames, "frame");
        report.remark(&format!("the clip gives {frames} of the {asked} asked for"));
    }
    for note in &summary.notes {
        report.warning(note);
    }
    let record = record_of(simulation, &summary, plan.format);
    let written = outputs.finish(&record)?;
    let text = describe(&record, &summary, &written, &plan.output);
    if plan.to_stdout() {
        report.remark(text.trim_end());
        return Ok(());
    }
    report.result(&text, || {
        let mut document = serde_json::to_value(&record).unwrap_or(Value::Null);
        document["written"] = json!(written);
        document["mean_count"] = json!(summary.mean_count);
        document["saturated"] = json!(summary.saturated);
        document
    })
}

fn record_of(simulation: Simulation, summary: &Summary, format: BurstFormat) -> Record {
    Record {
        version: VERSION,
        program: concat!("qudi ", env!("CARGO_PKG_VERSION")).to_owned(),
        burst: BurstLayout::new(format, summary.frames, summary.size, &simulation.sensor),
        light: summary.light,
        gain: summary.gain,
        clip: ClipDigest { mean: summary.clip_mean, crc32: summary.clip_crc32 },
        simulation,
    }
}

fn describe(record: &Record, summary: &Summary, written: &[PathBuf], output: &str) -> String {
    let burst = &record.burst;
    let meaning = serde_json::to_value(record.simulation.ppp_def).ok();
    let meaning = meaning.as_ref().and_then(Value::as_str).unwrap_or_default().to_owned();
    let mut text = String::new();
    let name = if output == "-" { "standard output" } else { output };
    let frames = counted(burst.frames, "frame");
    let _ = writeln!(text, "{name}   {frames} of {}, {} bit", burst.size, burst.bits);
    let _ = writeln!(
        text,
        "  sensor  {} · gain {:.4} DN/e-",
        record.simulation.sensor.name, record.gain
    );
    let _ = writeln!(
        text,
        "  light   {} photons/pixel/frame ({meaning}) · {:.4} incident · exposure {:.4}",
        record.simulation.ppp, record.light.ppp, record.light.mean_level
    );
    let _ = writeln!(
        text,
        "  counts  mean {:.4} of {} · {:.2} % saturated",
        summary.mean_count,
        burst.max_count,
        100.0 * summary.saturated
    );
    if summary.hot_and_dead != (0, 0) {
        let _ = writeln!(
            text,
            "  pixels  {} hot · {} dead",
            summary.hot_and_dead.0, summary.hot_and_dead.1
        );
    }
    let _ = writeln!(text, "  seed    {}", record.simulation.seed);
    for path in written.iter().skip(1) {
        let _ = writeln!(text, "  wrote   {}", path.display());
    }
    text
}
