//! `qudi demo`: what the tool is for, on one built-in scene: the noisy burst, what averaging and the best
//! classical methods make of it, what the network makes of it, the truth, errors and uncertainty.

use super::args::Demo;
use super::html::html;
use super::shown::{ERROR_GAIN, FRAMES, Shown};
use crate::args::Global;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::methods::network::{self, NetworkChoice};
use crate::methods::trained::built_in_knows;
use crate::report::{Bar, Cell, Column, Output, Report, Table, json};
use crate::settings::Settings;
use qudi_burst::Average;
use qudi_burst::{PostFilter, Qbp, QbpRefined};
use qudi_core::atomic_file::Overwrite;
use qudi_core::metrics::{best_gain, gain_aligned_psnr, psnr, ssim};
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{
    Camera, ClipStatistics, Error, Frame, Light, PppDefinition, Size, USUAL_MEAN_LEVEL,
    resolve_light,
};
use qudi_io::writer::Picture;
use qudi_sim::scene::{Procedural, ProceduralScene, Scene};
use serde_json::json;
use std::fmt::Write;
use std::path::PathBuf;
use std::time::Instant;

/// The frame in the middle of the window.
const CENTRE: usize = FRAMES / 2;
const SIZE: Size = Size { height: 256, width: 256 };

/// Bursts drawn from the result for its uncertainty, where the method does not predict one.
const REDRAWN_BURSTS: u64 = 4;

/// Origin of the uncertainty: for the console, and for the page.
type Origin = [&'static str; 2];
const PREDICTED: Origin = [
    "it predicts, without the truth,",
    "the standard deviation of its errors that the method predicts",
];
const BOOTSTRAP: Origin = [
    "where photons are drawn again from its result, it varies by",
    "how its result varies where photons are drawn again from that result",
];

pub(crate) fn run(
    demo: &Demo,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    let path = demo.output.clone().unwrap_or_else(|| PathBuf::from("qudi-demo.png"));
    let page = path.with_extension("html");
    if page == path {
        let help = "name a .png; the page lies next to it";
        return Err(CliError::new("the picture and the page are one file", path.display(), help));
    }
    let overwrite =
        if global.force || demo.output.is_none() { Overwrite::Yes } else { Overwrite::No };
    let page_file = Output::open(Some(&page), overwrite)?;
    let sensor = settings.sensor(&demo.sensor)?;
    let mut bar = report.bar();
    let truths = render(&mut bar);
    let light = light(demo, &sensor, &truths)?;
    let mut camera = Camera::new(&sensor, SIZE, light, demo.seed)?;
    let mut burst = Vec::with_capacity(FRAMES);
    for (t, frame) in (0..).zip(&truths) {
        burst.push(camera.expose(t, &[frame])?);
    }
    let acquisition = Acquisition::new(sensor.clone(), light.ppp, USUAL_MEAN_LEVEL)?;
    let acquisition = acquisition.with_seed(demo.seed);
    let truth = &truths[CENTRE];
    let how = |how: &str| how.to_owned();
    let mut methods: Vec<(&str, Box<dyn Restorer>, String)> = vec![
        ("AVERAGE OF 11", Box::new(Average), how("the mean of all frames, without motion")),
        (
            "QBP + BM3D",
            Box::new(Qbp::new(PostFilter::Bm3d)),
            how("frames aligned and merged patch by patch, then BM3D on every frame"),
        ),
        (
            "QBP REFINED",
            Box::new(QbpRefined),
            how("a burst merged twice, the second time along better motion"),
        ),
    ];
    let options = demo.network.options(demo.steps.steps, &demo.given);
    options.check_weights(&[])?;
    if demo.network.own_weights().is_some() || built_in_knows(&acquisition)? {
        let (restorer, how) = network::restorer(NetworkChoice::Best, &options, &acquisition, SIZE)?;
        methods.push(("QUDI", restorer, format!("the network{how}")));
    } else {
        report.remark(
            "note: the built-in weights do not know this sensor or light; the other methods do",
        );
    }
    let mut shown = Vec::new();
    let mut last = Restored::gray(Vec::new(), None);
    let count = methods.len() as u64;
    for (done, (label, method, how)) in (1..).zip(&mut methods) {
        let start = Instant::now();
        let view = BurstView { size: SIZE, frames: &burst };
        last = method.restore(view, &acquisition)?;
        let frame = last.frames[CENTRE].clone();
        shown.push(Shown {
            label,
            name: method.name(),
            how: how.clone(),
            psnr_a: gain_aligned_psnr(&frame, truth),
            psnr: psnr(&frame, truth),
            ssim: ssim(&frame, truth).unwrap_or(f64::NAN),
            seconds: start.elapsed().as_secs_f64(),
            frame,
        });
        bar.update("restoring", done, Some(count));
        stop_if_asked()?;
    }
    let (uncertainty, [origin, explained]) = if let Some(mut uncertainties) = last.std {
        (uncertainties.swap_remove(CENTRE), PREDICTED)
    } else {
        let (_, method, _) = methods.last_mut().expect("there are three at least");
        (redrawn(method.as_mut(), &last.frames, &acquisition, &mut bar)?, BOOTSTRAP)
    };
    drop(bar);

    let picture = picture(&shown, &burst, &uncertainty, truth, &sensor, demo.ppp);
    picture.save(&path, overwrite)?;
    let table = table(&shown);
    let text = table.to_text() + &text(&shown, &uncertainty, origin, truth);
    let foot = format!(
        "{} at {} photons/pixel/frame, seed {}; psnr in dB, -a after the best gain",
        sensor.name, demo.ppp, demo.seed
    );
    let png = std::fs::read(&path).map_err(|e| Error::io("read", &path, e))?;
    page_file.write(|| html(&png, &shown, &table, explained, &foot))?;
    let text = format!("{text}\n{}   {foot}\n{}\n", path.display(), page.display());
    report.result(
        &text,
        || json!({"picture": path, "page": page, "seed": demo.seed, "figures": json::rows(&table)}),
    )
}

fn render(bar: &mut Bar) -> Vec<Frame> {
    let scene = built_in_scene();
    let frames = (0..FRAMES).map(|t| {
        bar.update("rendering", t as u64 + 1, Some(FRAMES as u64));
        scene.render(t as f64)
    });
    frames.collect()
}

/// Makes a turning and panning chart behind two lines of text that pass it in opposite directions.
fn built_in_scene() -> Scene {
    let scene = |kind, speed| Procedural { kind, size: SIZE, seed: 4, speed }.scene();
    let mut chart = scene(ProceduralScene::Chart, 4.0);
    chart.layers.extend(scene(ProceduralScene::Text, 3.0).layers.into_iter().skip(1).step_by(2));
    chart
}

fn light(demo: &Demo, sensor: &Sensor, truths: &[Frame]) -> Result<Light> {
    let mut clip = ClipStatistics::default();
    for frame in truths {
        clip.add(&frame.data);
    }
    let dark = sensor.dark_per_frame()?;
    Ok(resolve_light(sensor, PppDefinition::Incident, demo.ppp, None, &clip, dark)?)
}

/// Estimates how the centre frame of `result` varies where the photons are drawn again, as if it were the
/// truth: what a capture without truth can tell of its errors (Efron 1979, the parametric bootstrap).
fn redrawn(
    method: &mut dyn Restorer,
    result: &[Frame],
    acquisition: &Acquisition,
    bar: &mut Bar,
) -> Result<Frame> {
    let light = Light { ppp: acquisition.ppp, mean_level: acquisition.mean_level };
    let mut sums = vec![[0.0f32; 2]; SIZE.pixels()];
    for draw in 1..=REDRAWN_BURSTS {
        let mut camera = Camera::new(&acquisition.sensor, SIZE, light, acquisition.seed)?;
        let mut burst = Vec::with_capacity(FRAMES);
        for (t, frame) in (draw * FRAMES as u64..).zip(result) {
            burst.push(camera.expose(t, &[frame])?);
        }
        let view = BurstView { size: SIZE, frames: &burst };
        let again = method.restore(view, acquisition)?.frames;
        for (sum, value) in sums.iter_mut().zip(&again[CENTRE].data) {
            *sum = [sum[0] + value, sum[1] + value * value];
        }
        bar.update("drawing photons again", draw, Some(REDRAWN_BURSTS));
        stop_if_asked()?;
    }
    let n = REDRAWN_BURSTS as f32;
    let sigma = |[sum, squares]: &[f32; 2]| ((squares - sum * sum / n).max(0.0) / (n - 1.0)).sqrt();
    Ok(Frame { size: SIZE, data: sums.iter().map(sigma).collect() })
}

fn stop_if_asked() -> Result<()> {
    if interrupt::check().is_break() {
        return Err(Error::Interrupted.into());
    }
    Ok(())
}

fn picture(
    shown: &[Shown],
    burst: &[Vec<u16>],
    uncertainty: &Frame,
    truth: &Frame,
    sensor: &Sensor,
    ppp: f64,
) -> Picture {
    let mut picture = Picture::new(SIZE, 2, shown.len() + 2, 2);
    let full_scale = f32::from(sensor.max_count());
    let scaled = |data: Vec<f32>| Frame { size: SIZE, data };
    let counts =
        |frame: usize| scaled(burst[frame].iter().map(|&c| f32::from(c) / full_scale).collect());
    picture.place(0, 0, &["COUNTS", &format!("{} BIT", sensor.output_bits())], &counts(CENTRE));
    picture.place(1, 0, &["COUNTS", "LAST OF 11"], &counts(FRAMES - 1));
    for (column, method) in (1..).zip(shown) {
        let error = error_map(&method.frame, truth);
        let error_rms = format!("RMS {:.3}", rms(&error) / f64::from(ERROR_GAIN));
        picture.place(
            0,
            column,
            &[method.label, &format!("{:.1} DB", method.psnr_a)],
            &aligned(&method.frame, truth),
        );
        picture.place(1, column, &["ERROR X4", &error_rms], &error);
    }
    let last = shown.len() + 1;
    picture.place(0, last, &["TRUTH", &format!("{ppp} PPP")], truth);
    let spread = format!("RMS {:.3}", rms(uncertainty));
    let uncertainty = scaled(uncertainty.data.iter().map(|d| d * ERROR_GAIN).collect());
    picture.place(1, last, &["UNCERTAINTY X4", &spread], &uncertainty);
    picture
}

/// Returns the scores of every method on the frame in the centre.
fn table(shown: &[Shown]) -> Table {
    let mut table = Table::new(vec![
        Column::new("method", "centre frame"),
        Column::new("psnr_a", "psnr-a").with_unit("dB"),
        Column::new("psnr", "psnr").with_unit("dB"),
        Column::new("ssim", "ssim"),
        Column::new("seconds", "seconds"),
    ]);
    table.rows.extend(shown.iter().map(|method| {
        vec![
            Cell::text(method.name),
            Cell::number(method.psnr_a, 2),
            Cell::number(method.psnr, 2),
            Cell::number(method.ssim, 3),
            Cell::number(method.seconds, 2),
        ]
    }));
    table
}

fn text(shown: &[Shown], uncertainty: &Frame, origin: &str, truth: &Frame) -> String {
    let mut text = String::new();
    if let Some(method) = shown.last() {
        let error = rms(&error_map(&method.frame, truth)) / f64::from(ERROR_GAIN);
        let _ = writeln!(
            text,
            "\n{} errs by {error:.3}; {origin} {:.3}",
            method.name,
            rms(uncertainty)
        );
    }
    text
}

fn rms(frame: &Frame) -> f64 {
    let squares: f64 = frame.data.iter().map(|&e| f64::from(e) * f64::from(e)).sum();
    (squares / frame.data.len() as f64).sqrt()
}

/// Scales a frame to the truth's brightness, which counts do not tell.
fn aligned(frame: &Frame, truth: &Frame) -> Frame {
    let gain = best_gain(frame, truth) as f32;
    Frame { size: SIZE, data: frame.data.iter().map(|e| (e * gain).clamp(0.0, 1.0)).collect() }
}

fn error_map(frame: &Frame, truth: &Frame) -> Frame {
    let pairs = aligned(frame, truth).data.into_iter().zip(&truth.data);
    Frame { size: SIZE, data: pairs.map(|(e, t)| ERROR_GAIN * (e - t).abs()).collect() }
}
