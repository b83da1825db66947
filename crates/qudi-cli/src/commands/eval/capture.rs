//! One real capture, restored by every method without a truth: chi-square, cost, pictures.

use super::clip::stem;
use super::exposing::{FRAMES, SEED};
use super::html::{Pictures, loop_frames};
use super::metrics::CHI_SQUARE;
use super::plan::{Contender, Plan};
use super::score::{FrameScore, Row, Score};
use crate::capture::{CaptureAcquisition, Input, LightOverrides, Source, SummedCapture, remarks};
use crate::commands::look::strip::strip;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::memory::PeakMemory;
use crate::report::Report;
use crate::report::middle::cut;
use crate::report::player::counts_frame;
use crate::settings::Settings;
use qudi_core::Frame;
use qudi_core::metrics::Consistency;
use qudi_core::restorer::Acquisition;
use qudi_core::windows::Windows;
use qudi_io::capture::Capture;
use qudi_io::restore::{RestoreSink, Schedule, run as run_method};
use serde_json::{Value, json};
use std::ops::Range;
use std::path::Path;
use std::time::Instant;

/// The results of an evaluation.
pub(crate) struct Evaluation {
    pub(crate) rows: Vec<Row>,
    pub(crate) pictures: Vec<Pictures>,
    /// Description of the scores in a sentence.
    pub(crate) about: String,
    pub(crate) settings: Value,
}

/// Restores the first frames of the capture by every method.
pub(crate) fn evaluate_capture(
    plan: &Plan,
    overrides: &Settings,
    report: &Report,
) -> Result<Evaluation> {
    overrides.refuse(&["simulate."], "with --capture, whose photons are drawn already")?;
    let seed = plan.seed.unwrap_or(SEED);
    let path = Path::new(&plan.data);
    let source = Source {
        input: Input::at(Some(path)),
        options: &plan.read,
        sum: plan.sum,
        sensor: plan.sensor.as_deref(),
        judged: u64::MAX,
    };
    let summed = SummedCapture::new(source.open(overrides)?, &source)?;
    let sensor = summed.required_sensor()?;
    summed.remark_sum(report);
    let mut capture = summed.capture;
    if let (Some(_), Some(cfa)) = (capture.filter(), &capture.info().cfa) {
        return Err(CliError::new(
            format!("a capture behind the colour filter {cfa}"),
            path.display(),
            "methods are compared on gray: read one plane with --channel, or restore it with `qudi restore`",
        ));
    }
    let light = LightOverrides {
        ppp: plan.ppp.first().copied(),
        gain: plan.gain,
        mean_level: plan.mean_level,
        seed,
        white: None,
    };
    let summary = light.measure(&mut capture, Some(&sensor))?;
    let CaptureAcquisition { acquisition, light_source } =
        CaptureAcquisition::new(&light, &mut capture, &sensor, &summary)?;
    let frames = capture.frames().min(plan.frames.unwrap_or(FRAMES));
    let clip = stem(path);
    let shown = if plan.pictures { loop_frames(plan.contenders.len() + 1) as u64 } else { 0 };
    let shown = shown.min(frames);
    let first = (frames / 2).saturating_sub(shown / 2).min(frames - shown);
    let shown = first..first + shown;
    let mut counts = Vec::new();
    for frame in shown.clone() {
        let mut read = vec![0; capture.size().pixels()];
        capture.read(frame, &mut read)?;
        counts.push(counts_frame(capture.size(), &read, acquisition.sensor.max_count()));
    }
    let mut pictures =
        Pictures::new(clip.clone(), acquisition.ppp, shown.clone().collect(), &counts)
            .with_strip(strip(capture.timeline(), capture.findings()));
    let mut rows = Vec::new();
    let mut bar = report.bar();
    for (n, contender) in plan.contenders.iter().enumerate() {
        bar.update("evaluating", n as u64, Some(plan.contenders.len() as u64));
        let mut score =
            score(contender, &clip, &mut capture, (frames, &shown), &acquisition, plan)?;
        let row = contender.row(acquisition.ppp);
        pictures.add(&row.label(), &mut score);
        rows.push(Row { scores: vec![score], ..row });
    }
    drop(bar);
    remarks(&capture, report);
    let about = format!(
        "{frames} frames of {} of {}, sensor {}, {:.4} incident photons/pixel/frame ({light_source}); no truth: chi-square of the counts given the result, 1 where it explains them, below where it follows their noise, above where it blurs or invents",
        capture.size(),
        plan.data,
        acquisition.sensor.name,
        acquisition.ppp
    );
    let settings = json!({
        "capture": plan.data,
        "format": capture.info().format,
        "frames": frames,
        "sum": capture.summed(),
        "ppp_from": light_source,
        "gain": acquisition.gain,
        "sensor": acquisition.sensor,
        "seed": seed,
        "exposure": acquisition.mean_level,
        "overlap": plan.overlap,
    });
    Ok(Evaluation { rows, pictures: vec![pictures], about, settings })
}

/// Scores a method on the first frames, of which some are shown.
fn score(
    contender: &Contender,
    clip: &str,
    capture: &mut Capture,
    (frames, shown): (u64, &Range<u64>),
    acquisition: &Acquisition,
    plan: &Plan,
) -> Result<Score> {
    let mut sink = Watch {
        consistency: Consistency::new(capture.size(), acquisition),
        acquisition,
        shown: shown.clone(),
        frames: Vec::new(),
        pictures: Vec::new(),
    };
    let peak = PeakMemory::start();
    let start = Instant::now();
    let part = capture.longest_part();
    let (mut restorer, how) = capture.in_part(&part, |capture| {
        contender.method.restorer(capture, acquisition, &contender.network)
    })?;
    let windows = Windows::of(restorer.as_ref(), capture.frames(), plan.overlap)?;
    let mut go_on = |_: u64, _: Option<u64>| interrupt::check();
    run_method(
        restorer.as_mut(),
        capture,
        &Schedule::all(windows),
        0..frames,
        acquisition,
        &mut sink,
        &mut go_on,
    )?;
    let seconds = start.elapsed().as_secs_f64();
    Ok(Score {
        clip: clip.to_owned(),
        chi_square: sink.consistency.chi_square(),
        flicker: None,
        flow: None,
        added: None,
        range: None,
        seconds_per_frame: Some(seconds / frames as f64),
        peak_mib: peak.grown_mib(),
        frames: sink.frames,
        pictures: sink.pictures,
        how,
    })
}

/// Measures frames as they come, and keeps the shown part of some.
struct Watch<'a> {
    consistency: Consistency,
    acquisition: &'a Acquisition,
    shown: Range<u64>,
    frames: Vec<FrameScore>,
    pictures: Vec<Frame>,
}

impl RestoreSink for Watch<'_> {
    fn frame(&mut self, number: u64, restored: &Frame, counts: &[u16]) -> qudi_core::Result<()> {
        let chi_square = self.consistency.add(restored, counts, self.acquisition)?;
        self.frames.push(FrameScore::of_values(&[(&CHI_SQUARE, chi_square)]));
        if self.shown.contains(&number) {
            self.pictures.push(cut(restored));
        }
        Ok(())
    }
}
