//! `qudi selftest`: a device against the processor.

use super::args::Selftest;
use crate::device;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::Report;
use burn::tensor::Device;
use qudi_model::MatrixUnits;
use qudi_train::selftest::{BF16_TOLERANCE, CHECKS, TOLERANCE, Verdict};
use serde_json::json;
use std::fmt::Write;
use std::time::Instant;

pub(crate) fn run(args: &Selftest, report: &Report) -> Result<()> {
    let device = device::open(&args.device)?;
    let reference = Device::flex();
    let chosen =
        |name: &str| args.only.is_empty() || args.only.iter().any(|o| name.contains(o.as_str()));
    let checks: Vec<_> = CHECKS.iter().filter(|check| chosen(check.name)).collect();
    if checks.is_empty() {
        let names: Vec<_> = CHECKS.iter().map(|check| check.name).collect();
        let help = format!("there are {}", names.join(", "));
        return Err(CliError::new("no check of that name", "--only", help));
    }
    let mut text = format!("{} against the stock operations of cpu\n", device.name);
    let units = (device.name == "cpu").then(MatrixUnits::chosen).transpose()?;
    if let Some(units) = units {
        let _ = writeln!(text, "  bf16 is multiplied by {}", in_words(units));
    }
    let mut results = Vec::new();
    let mut missed = Vec::new();
    let mut bar = report.bar();
    for (number, check) in checks.iter().enumerate() {
        bar.update("checking", number as u64, Some(checks.len() as u64));
        if interrupt::check().is_break() {
            return Err(CliError::Interrupted);
        }
        if !check.is_possible(&device.device) {
            let verdict = "not on this device";
            let _ = writeln!(text, "  {:<24}{:>9}  {:>9}  {verdict}", check.name, "-", "");
            results.push(json!({"check": check.name, "error": null, "verdict": verdict}));
            continue;
        }
        let start = Instant::now();
        let outcome = device::guarded(&device.name, || check.error(&device.device, &reference));
        let seconds = start.elapsed().as_secs_f64();
        let (error, passed, verdict) = match outcome {
            Ok(Ok(error)) => {
                let verdict = check.verdict(error);
                (Some(error), verdict != Verdict::Wrong, word(verdict).to_owned())
            }
            Ok(Err(fault)) => (None, false, format!("FAILED: {fault}")),
            Err(problem) => (None, false, format!("FAILED: {problem}")),
        };
        let shown = error.map_or("-".to_owned(), |error| format!("{error:.1e}"));
        let _ = writeln!(text, "  {:<24}{shown:>9}  {seconds:>7.2} s  {verdict}", check.name);
        if !passed {
            missed.push(check.name);
        }
        results.push(
            json!({"check": check.name, "error": error, "seconds": seconds, "verdict": verdict}),
        );
    }
    drop(bar);
    let _ = writeln!(
        text,
        "largest difference over the largest value; below {TOLERANCE:.0e} is right, with bf16 below {BF16_TOLERANCE:.0e}"
    );
    report.result(&text, || {
        json!({
            "device": device.name,
            "matrix_units": units.map(|units| units.to_string()),
            "checks": results,
        })
    })?;
    if missed.is_empty() {
        return Ok(());
    }
    Err(CliError::Missed(format!("{} is wrong in {}", device.name, missed.join(", "))))
}

fn in_words(units: MatrixUnits) -> String {
    let what = match units {
        MatrixUnits::F32 => "numbers are rounded, at no better speed",
        MatrixUnits::Avx512Bf16 => "the vector unit's products of pairs",
        MatrixUnits::Amx => "the matrix unit's tiles",
    };
    format!("{units}: {what}")
}

fn word(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Right => "ok",
        Verdict::Rough => "ok, but sums have 16 bits",
        Verdict::Wrong => "WRONG",
    }
}
