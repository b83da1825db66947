//! `qudi bench`: speed and memory of methods, medians after a warm-up.

use super::args::Bench;
use super::burst::{burst, median};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::memory::PeakMemory;
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::limits::RECORD_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::restorer::BurstView;
use qudi_io::capture::Capture;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::fmt::Write;
use std::path::Path;
use std::time::Instant;

/// Figures of one method.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Measured {
    method: String,
    /// Median seconds per window of frames.
    seconds: f64,
    /// The fastest round.
    fastest: f64,
    /// Peak of resident memory above what the process held before, in MiB, where the system tells.
    peak_mib: Option<f64>,
}

/// A run, as `--json` prints it and `--compare` reads it.
#[derive(Debug, Serialize, Deserialize)]
struct Results {
    program: String,
    height: usize,
    width: usize,
    frames: usize,
    rounds: usize,
    threads: usize,
    methods: Vec<Measured>,
}

pub(crate) fn run(args: &Bench, settings: &Settings, report: &Report) -> Result<()> {
    if let Some(recipe) = &args.train {
        return super::training::run(recipe, args, settings, report);
    }
    let options = args.network.options(args.steps.steps, &args.given);
    options.check_methods(&args.method)?;
    let old = args.compare.as_deref().map(load).transpose()?;
    if args.rounds == 0 || args.frames == 0 {
        return Err(CliError::new(
            "nothing to measure",
            "--rounds, --frames",
            "ask for at least 1",
        ));
    }
    let (counts, acquisition) = burst(args)?;
    let sensor = acquisition.sensor.clone();
    let mut measured = Vec::new();
    let mut bar = report.bar();
    for method in &args.method {
        let mut capture = Capture::in_memory("bench", args.size, counts.clone(), &sensor)?;
        let (mut restorer, _) = method.restorer(&mut capture, &acquisition, &options)?;
        let burst = BurstView { size: args.size, frames: &counts };
        let peak = PeakMemory::start();
        // The first round warms caches up, and compiles kernels where there are any.
        restorer.restore(burst, &acquisition)?;
        let mut times = Vec::with_capacity(args.rounds);
        for round in 0..args.rounds {
            bar.update("measuring", round as u64, Some(args.rounds as u64));
            if interrupt::check().is_break() {
                return Err(CliError::Interrupted);
            }
            let start = Instant::now();
            restorer.restore(burst, &acquisition)?;
            times.push(start.elapsed().as_secs_f64());
        }
        measured.push(Measured {
            method: method.name.to_owned(),
            fastest: times.iter().copied().fold(f64::MAX, f64::min),
            seconds: median(times),
            peak_mib: peak.grown_mib(),
        });
    }
    drop(bar);
    let results = Results {
        program: format!("qudi {}", env!("CARGO_PKG_VERSION")),
        height: args.size.height,
        width: args.size.width,
        frames: args.frames,
        rounds: args.rounds,
        threads: rayon::current_num_threads(),
        methods: measured,
    };
    report.result(&describe(&results, old.as_ref()), || json!(results))
}

fn load(path: &Path) -> Result<Results> {
    let text = read_limited(path, RECORD_BYTES, "read the old results")?;
    serde_json::from_slice(&text).map_err(|e| {
        CliError::new(
            format!("not the results of a benchmark: {e}"),
            path.display(),
            "make them with `qudi bench --json > old.json`",
        )
    })
}

fn describe(results: &Results, old: Option<&Results>) -> String {
    let mut text = format!("{:<12}{:>12}{:>12}{:>12}", "method", "ms/frame", "fastest", "peak MiB");
    if old.is_some() {
        let _ = write!(text, "{:>12}", "old/new");
    }
    text.push('\n');
    for m in &results.methods {
        let per_frame = |seconds: f64| 1e3 * seconds / results.frames as f64;
        let peak = m.peak_mib.map_or("-".to_owned(), |mib| format!("{mib:.1}"));
        let _ = write!(
            text,
            "{:<12}{:>12.3}{:>12.3}{:>12}",
            m.method,
            per_frame(m.seconds),
            per_frame(m.fastest),
            peak
        );
        let before = old.and_then(|old| {
            let same = old.methods.iter().find(|o| o.method == m.method)?;
            Some(same.seconds / old.frames as f64 * results.frames as f64 / m.seconds)
        });
        if let Some(ratio) = before {
            let _ = write!(text, "{ratio:>11.2}x");
        }
        text.push('\n');
    }
    let _ = writeln!(
        text,
        "\n{} frames of {} x {}, {} threads; medians of {} rounds after one of warm-up",
        results.frames, results.height, results.width, results.threads, results.rounds
    );
    let differs = old.is_some_and(|old| (old.height, old.width) != (results.height, results.width));
    if differs {
        text += "the old results are of another frame size: ratios mean little\n";
    }
    text
}
