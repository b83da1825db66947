//! One real capture, judged for every method without a truth: chi-square, cost, pictures.

use crate::args::{Eval, Protocol};
use crate::cmd::capture_info::{open_capture, remarks, unknown_sensor};
use crate::cmd::capture_light::{Stated, acquisition};
use crate::cmd::eval_clip::stem;
use crate::cmd::eval_exposing::{FRAMES, SEED};
use crate::cmd::eval_html::Pictures;
use crate::cmd::eval_score::{FrameScore, Row, Score};
use crate::cmd::methods::method;
use crate::error::{Fault, Result};
use crate::interrupt;
use crate::memory::Peak;
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::Frame;
use qudi_core::metrics::Consistency;
use qudi_core::restorer::Acquisition;
use qudi_core::windows::Windows;
use qudi_io::capture::{Capture, MaskChoice};
use qudi_io::restore::{RestoreSink, run as run_method};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Instant;

/// What is found on a capture.
pub(crate) struct Judged {
    pub(crate) rows: Vec<Row>,
    pub(crate) pictures: Vec<Pictures>,
    /// What the figures are, in a sentence.
    pub(crate) about: String,
    pub(crate) settings: Value,
}

/// Restores the first frames of the capture by every method.
pub(crate) fn judge(args: &Eval, overrides: &Settings, report: &Report) -> Result<Judged> {
    refuse_what_needs_truth(args)?;
    overrides.refuse(&["simulate."], "with --capture, whose photons are drawn already")?;
    let seed = args.seed.unwrap_or(SEED);
    let path = Path::new(&args.data);
    let options = args.reading.options(MaskChoice::Auto);
    let (mut capture, sensor) = open_capture(path, &options, args.sensor.as_deref(), overrides)?;
    let sensor = sensor.ok_or_else(|| unknown_sensor(&capture))?;
    let stated =
        Stated { ppp: args.ppp.first().copied(), gain: args.gain, exposure: args.exposure, seed };
    let (acquisition, source) = acquisition(&stated, &mut capture, &sensor)?;
    let frames = capture.frames().min(args.frames.unwrap_or(FRAMES));
    let mut counts = vec![0; capture.size().pixels()];
    capture.read(frames / 2, &mut counts)?;
    let full = f32::from(acquisition.sensor.max_count());
    let data = counts.iter().map(|&count| f32::from(count) / full).collect();
    let clip = stem(path);
    let counts = Frame { size: capture.size(), data };
    let mut pictures = Pictures::new(clip.clone(), acquisition.ppp, counts, None);
    let mut rows = Vec::new();
    let mut bar = report.bar();
    for (n, name) in args.method.iter().enumerate() {
        bar.update("evaluating", n as u64, Some(args.method.len() as u64));
        let score = score(name, &clip, &mut capture, frames, &acquisition, args)?;
        pictures.add(name, &score);
        rows.push(Row { method: name.clone(), ppp: acquisition.ppp, scores: vec![score] });
    }
    drop(bar);
    remarks(&capture, report);
    let about = format!(
        "{frames} frames of {} of {}, sensor {}, {:.4} incident photons/pixel/frame ({source}); no truth: chi-square of the counts given the result, 1 where it explains them, below where it follows their noise, above where it blurs or invents",
        capture.size(),
        args.data,
        acquisition.sensor.name,
        acquisition.ppp
    );
    let settings = json!({
        "capture": args.data,
        "format": capture.info().format,
        "frames": frames,
        "ppp_from": source,
        "gain": acquisition.gain,
        "sensor": acquisition.sensor,
        "seed": seed,
        "exposure": acquisition.exposure,
        "overlap": args.overlap,
    });
    Ok(Judged { rows, pictures: vec![pictures], about, settings })
}

fn refuse_what_needs_truth(args: &Eval) -> Result<()> {
    let refused = [
        (args.protocol == Protocol::Quiver, "--protocol"),
        (args.export_photons.is_some(), "--export-photons"),
        (!args.external.is_empty(), "--external"),
        (args.min_psnr.is_some(), "--min-psnr"),
    ];
    if let Some((_, option)) = refused.iter().find(|(given, _)| *given) {
        return Err(Fault::new(
            "a capture has no truth, and its photons are drawn already",
            option,
            "leave it out, or evaluate on clips without --capture",
        ));
    }
    if args.ppp.len() > 1 {
        return Err(Fault::new(
            format!("{} light levels for one capture", args.ppp.len()),
            "--ppp",
            "give the light of this capture, or leave it out",
        ));
    }
    if args.frames == Some(0) {
        return Err(Fault::new("no frames", "--frames", "ask for at least 1"));
    }
    Ok(())
}

fn score(
    name: &str,
    clip: &str,
    capture: &mut Capture,
    frames: u64,
    acquisition: &Acquisition,
    args: &Eval,
) -> Result<Score> {
    let mut sink = Watch {
        consistency: Consistency::new(capture.size(), acquisition),
        acquisition,
        shown: frames / 2,
        frames: Vec::new(),
        picture: None,
    };
    let peak = Peak::start();
    let start = Instant::now();
    let (mut restorer, how) = method(name, capture, acquisition, &args.network)?;
    let windows = Windows::new(capture.frames(), restorer.window() as u64, args.overlap)?;
    let mut go_on = |_: u64, _: Option<u64>| interrupt::check();
    run_method(
        restorer.as_mut(),
        capture,
        &windows,
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
        seconds_per_frame: Some(seconds / frames as f64),
        peak_mib: peak.grown_mib(),
        frames: sink.frames,
        picture: sink.picture.unwrap_or(Frame::filled(capture.size(), 0.0)),
        how,
    })
}

/// Judges frames as they come, and keeps the one that is shown.
struct Watch<'a> {
    consistency: Consistency,
    acquisition: &'a Acquisition,
    shown: u64,
    frames: Vec<FrameScore>,
    picture: Option<Frame>,
}

impl RestoreSink for Watch<'_> {
    fn frame(&mut self, number: u64, restored: &Frame, counts: &[u16]) -> qudi_core::Result<()> {
        let chi_square = Some(self.consistency.add(restored, counts, self.acquisition)?);
        self.frames.push(FrameScore { chi_square, ..FrameScore::default() });
        if number == self.shown {
            self.picture = Some(restored.clone());
        }
        Ok(())
    }
}
