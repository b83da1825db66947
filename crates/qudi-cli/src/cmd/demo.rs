//! `qudi demo`: one built-in scene, what the sensor sees of it, and what averaging makes of that.

use crate::args::{Demo, Global};
use crate::error::Result;
use crate::interrupt;
use crate::report::Report;
use qudi_sim::metrics::{best_gain, gain_aligned_psnr, psnr};
use qudi_sim::output::{Overwrite, Picture};
use qudi_sim::scene::{Procedural, ProceduralScene, Scene};
use qudi_sim::sensor::{CountLaw, Sensor};
use qudi_sim::{Camera, ClipStatistics, Frame, PppDefinition, SimError, Size, resolve_light};
use serde_json::json;
use std::fmt::Write;
use std::path::PathBuf;

/// Frames of the paper's window, and the one in its middle.
const FRAMES: usize = 11;
const CENTRE: usize = FRAMES / 2;
const SIZE: Size = Size { height: 256, width: 256 };

/// Errors are shown this many times brighter than images.
const ERROR_GAIN: f32 = 4.0;

pub(crate) fn run(demo: &Demo, global: &Global, report: &Report) -> Result<()> {
    let path = demo.output.clone().unwrap_or_else(|| PathBuf::from("qudi-demo.png"));
    let overwrite =
        if global.force || demo.output.is_none() { Overwrite::Yes } else { Overwrite::No };
    let sensor = Sensor::load(&demo.sensor)?;
    let scene = built_in_scene();

    let mut bar = report.bar();
    let mut truths = Vec::with_capacity(FRAMES);
    let mut clip = ClipStatistics::default();
    for t in 0..FRAMES {
        let frame = scene.render(t as f64);
        clip.add(&frame.data);
        truths.push(frame);
        bar.update("rendering", t as u64 + 1, Some(FRAMES as u64));
    }
    let light = resolve_light(
        &sensor,
        PppDefinition::Incident,
        demo.ppp,
        None,
        &clip,
        sensor.dark_per_frame()?,
    )?;
    let mut camera = Camera::new(&sensor, SIZE, light, demo.seed)?;
    let estimator = Estimator::new(&sensor, camera.gain(), light.ppp / light.exposure)?;

    let truth = &truths[CENTRE];
    let mut moving = Vec::with_capacity(FRAMES);
    let mut still = Vec::with_capacity(FRAMES);
    for (t, frame) in truths.iter().enumerate() {
        moving.push(as_frame(&camera.expose(t as u64, &[frame])?));
        still.push(as_frame(&camera.expose((FRAMES + t) as u64, &[truth])?));
        if interrupt::check().is_break() {
            return Err(SimError::Interrupted.into());
        }
        bar.update("exposing", t as u64 + 1, Some(FRAMES as u64));
    }
    let results = [
        ("ONE FRAME", "one frame", estimator.restore(&moving[CENTRE], 1)),
        (
            "AVERAGE OF 11",
            "average of 11, moving",
            estimator.restore(&mean(&moving), FRAMES as u32),
        ),
        (
            "ALONG TRUE MOTION",
            "average along the true motion",
            estimator.restore(&aligned_mean(&scene, &moving), FRAMES as u32),
        ),
        (
            "STILL CAMERA",
            "average of 11, nothing moving",
            estimator.restore(&mean(&still), FRAMES as u32),
        ),
    ];
    drop(bar);

    let mut picture = Picture::new(SIZE, 2, results.len() + 2, 2);
    let full_scale = f32::from(sensor.max_count());
    let counts =
        Frame { size: SIZE, data: moving[CENTRE].data.iter().map(|c| c / full_scale).collect() };
    picture.place(0, 0, &["COUNTS", &format!("{} BIT", sensor.output_bits())], &counts);
    let mut text = format!("{:<32}{:>9}{:>9}\n", "centre frame", "psnr-a", "psnr");
    let mut figures = Vec::new();
    for (column, (label, name, frame)) in results.iter().enumerate() {
        let (aligned, raw) = (gain_aligned_psnr(frame, truth), psnr(frame, truth));
        let _ = writeln!(text, "{name:<32}{aligned:>9.2}{raw:>9.2}");
        figures.push(json!({"method": name, "psnr_a": aligned, "psnr": raw}));
        picture.place(0, column + 1, &[label, &format!("{aligned:.1} DB")], frame);
        let error = error_map(frame, truth);
        let rms = (error.data.iter().map(|e| f64::from(e * e)).sum::<f64>()
            / error.data.len() as f64)
            .sqrt();
        let rms = format!("RMS {:.3}", rms / f64::from(ERROR_GAIN));
        picture.place(1, column + 1, &["ERROR X4", &rms], &error);
    }
    picture.place(0, results.len() + 1, &["TRUTH", &format!("{} PPP", demo.ppp)], truth);
    picture.save(&path, overwrite)?;
    let _ = writeln!(
        text,
        "\n{}   {} at {} photons/pixel/frame, seed {}; psnr in dB, -a after the best gain",
        path.display(),
        sensor.name,
        demo.ppp,
        demo.seed
    );
    report.result(&text, || json!({"picture": path, "seed": demo.seed, "figures": figures}))
}

/// A turning and panning chart behind two lines of text that pass it in opposite directions.
fn built_in_scene() -> Scene {
    let scene = |kind, speed| Procedural { kind, size: SIZE, seed: 4, speed }.scene();
    let mut chart = scene(ProceduralScene::Chart, 4.0);
    chart.layers.extend(scene(ProceduralScene::Text, 3.0).layers.into_iter().skip(1).step_by(2));
    chart
}

/// Inverts the mean response of the sensor, dark counts subtracted.
struct Estimator {
    law: CountLaw,
    full_scale: f64,
    dark: f64,
    /// Electrons per unit of image value.
    electrons: f64,
}

impl Estimator {
    fn new(sensor: &Sensor, gain: f64, photons_per_value: f64) -> Result<Self> {
        Ok(Self {
            law: CountLaw::new(sensor, gain),
            full_scale: f64::from(sensor.max_count()),
            dark: sensor.dark_per_frame()?,
            electrons: sensor.quantum_efficiency * photons_per_value,
        })
    }

    /// Image values from mean counts over `frames` frames.
    fn restore(&self, mean_counts: &Frame, frames: u32) -> Frame {
        // One table entry per possible mean of whole counts, and the fractions of warped ones.
        let steps = (self.full_scale as usize * frames as usize * 4).clamp(64, 4096);
        let value = |step: usize| {
            let mean = self.full_scale * step as f64 / steps as f64;
            let photons = self.law.detections_for_mean(mean) - self.dark;
            (photons / self.electrons).clamp(0.0, 2.0) as f32
        };
        let table: Vec<f32> = (0..=steps).map(value).collect();
        let data = mean_counts.data.iter().map(|&c| {
            let position = (f64::from(c) / self.full_scale * steps as f64).clamp(0.0, steps as f64);
            table[position.round() as usize]
        });
        Frame { size: mean_counts.size, data: data.collect() }
    }
}

fn as_frame(counts: &[u16]) -> Frame {
    Frame { size: SIZE, data: counts.iter().map(|&c| f32::from(c)).collect() }
}

fn mean(frames: &[Frame]) -> Frame {
    let at = |i: usize| frames.iter().map(|f| f.data[i]).sum::<f32>() / frames.len() as f32;
    Frame { size: SIZE, data: (0..SIZE.pixels()).map(at).collect() }
}

/// Mean over the frames in which a surface of the centre frame is visible, each looked up where
/// that surface is.
fn aligned_mean(scene: &Scene, frames: &[Frame]) -> Frame {
    let mut sum = vec![0.0f32; SIZE.pixels()];
    let mut seen = vec![0.0f32; SIZE.pixels()];
    for (t, frame) in frames.iter().enumerate() {
        let flow = scene.flow(CENTRE as f64, t as f64);
        for i in (0..sum.len()).filter(|&i| flow.visible[i]) {
            let (x, y) = ((i % SIZE.width) as f64, (i / SIZE.width) as f64);
            sum[i] += frame.bilinear(x + f64::from(flow.dx[i]), y + f64::from(flow.dy[i]));
            seen[i] += 1.0;
        }
    }
    Frame { size: SIZE, data: sum.iter().zip(&seen).map(|(s, n)| s / n.max(1.0)).collect() }
}

fn error_map(frame: &Frame, truth: &Frame) -> Frame {
    let gain = best_gain(frame, truth) as f32;
    let error = |(e, t): (&f32, &f32)| ERROR_GAIN * ((e * gain).clamp(0.0, 1.0) - t).abs();
    Frame { size: SIZE, data: frame.data.iter().zip(&truth.data).map(error).collect() }
}
