//! A scene under the camera, and what every method makes of its counts.

use super::scenes::{DemoScene, FRAMES, SIZE};
use super::uncertainty::Uncertainty;
use crate::error::Result;
use crate::interrupt;
use crate::report::{Bar, Cell, Column, Table};
use qudi_core::metrics::{Statistics, best_gain, gain_aligned_psnr, psnr, ssim};
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{
    Camera, ClipStatistics, Error, Frame, Light, PppDefinition, USUAL_MEAN_LEVEL, resolve_light,
};
use std::time::Instant;

/// The frame in the middle of the window.
pub(super) const CENTRE: usize = FRAMES / 2;

/// A scene as the camera saw it.
pub(super) struct ExposedScene {
    pub(super) scene: DemoScene,
    pub(super) truths: Vec<Frame>,
    pub(super) counts: Vec<Vec<u16>>,
    pub(super) acquisition: Acquisition,
}

/// A scene with what every method makes of it.
pub(super) struct RestoredScene {
    pub(super) exposed: ExposedScene,
    pub(super) methods: Vec<Shown>,
    /// Uncertainty of the last method.
    pub(super) uncertainty: Uncertainty,
}

/// A method, its restorer, and how it works.
pub(super) struct Contender {
    /// The label in pictures.
    pub(super) label: &'static str,
    pub(super) restorer: Box<dyn Restorer>,
    pub(super) how: String,
}

/// The frames of a method, at the truth's brightness, and its scores.
pub(super) struct Shown {
    pub(super) label: &'static str,
    pub(super) name: &'static str,
    /// Description of the method.
    pub(super) how: String,
    pub(super) frames: Vec<Frame>,
    /// PSNR of every frame after its best gain, in dB.
    pub(super) psnr_a: Vec<f64>,
    /// Scores of the frame in the centre.
    pub(super) psnr: f64,
    pub(super) ssim: f64,
    pub(super) seconds: f64,
}

impl ExposedScene {
    /// Renders a scene and counts its photons.
    pub(super) fn new(
        scene: DemoScene,
        sensor: &Sensor,
        ppp: f64,
        seed: u64,
        bar: &mut Bar,
    ) -> Result<Self> {
        let frames = (0..FRAMES).map(|t| {
            bar.update("rendering", t as u64 + 1, Some(FRAMES as u64));
            scene.scene.render(t as f64)
        });
        let truths: Vec<Frame> = frames.collect();
        let light = light(sensor, ppp, &truths)?;
        let mut camera = Camera::new(sensor, SIZE, light, seed)?;
        let mut counts = Vec::with_capacity(FRAMES);
        for (t, frame) in (0..).zip(&truths) {
            counts.push(camera.expose(t, &[frame])?);
        }
        let acquisition = Acquisition::new(sensor.clone(), light.ppp, USUAL_MEAN_LEVEL)?;
        Ok(Self { scene, truths, counts, acquisition: acquisition.with_seed(seed) })
    }

    /// Restores the scene by every method.
    pub(super) fn restore(
        self,
        mut contenders: Vec<Contender>,
        bar: &mut Bar,
    ) -> Result<RestoredScene> {
        let mut methods = Vec::new();
        let mut last = Restored { frames: Vec::new(), std: None };
        let count = contenders.len() as u64;
        for (done, contender) in (1..).zip(&mut contenders) {
            let start = Instant::now();
            let view = BurstView { size: SIZE, frames: &self.counts };
            last = contender.restorer.restore(view, &self.acquisition)?;
            methods.push(self.shown(contender, &last.frames, start.elapsed().as_secs_f64()));
            bar.update("restoring", done, Some(count));
            stop_if_asked()?;
        }
        let restorer = &mut contenders.last_mut().expect("there are three at least").restorer;
        let uncertainty = match last.std {
            Some(sigmas) => Uncertainty::predicted(sigmas),
            None => Uncertainty::redrawn(restorer.as_mut(), &last.frames, &self.acquisition, bar)?,
        };
        Ok(RestoredScene { exposed: self, methods, uncertainty })
    }

    fn shown(&self, contender: &Contender, frames: &[Frame], seconds: f64) -> Shown {
        let pairs = || frames.iter().zip(&self.truths);
        let (frame, truth) = (&frames[CENTRE], &self.truths[CENTRE]);
        Shown {
            label: contender.label,
            name: contender.restorer.name(),
            how: contender.how.clone(),
            frames: pairs().map(|(frame, truth)| aligned(frame, truth)).collect(),
            psnr_a: pairs().map(|(frame, truth)| gain_aligned_psnr(frame, truth)).collect(),
            psnr: psnr(frame, truth),
            ssim: ssim(frame, truth).unwrap_or(f64::NAN),
            seconds,
        }
    }
}

impl RestoredScene {
    /// Returns the scores of every method: of the frame in the centre, and the mean over all frames.
    pub(super) fn table(&self) -> Table {
        let mut table = Table::new(vec![
            Column::new("method", format!("{}, centre frame", self.exposed.scene.name)),
            Column::new("psnr_a", "psnr-a").with_unit("dB"),
            Column::new("psnr_a_all", "all frames").with_unit("dB"),
            Column::new("psnr", "psnr").with_unit("dB"),
            Column::new("ssim", "ssim"),
            Column::new("seconds", "seconds"),
        ]);
        table.rows.extend(self.methods.iter().map(|method| {
            vec![
                Cell::text(method.name),
                Cell::number(method.psnr_a[CENTRE], 2),
                method.over_frames(),
                Cell::number(method.psnr, 2),
                Cell::number(method.ssim, 3),
                Cell::number(method.seconds, 2),
            ]
        }));
        table
    }

    /// Returns the error of a method in the centre frame.
    pub(super) fn error(&self, method: &Shown) -> Frame {
        let pairs = method.frames[CENTRE].data.iter().zip(&self.exposed.truths[CENTRE].data);
        Frame { size: SIZE, data: pairs.map(|(e, t)| (e - t).abs()).collect() }
    }
}

impl Shown {
    /// Returns the mean of psnr-a over all frames, with its confidence.
    fn over_frames(&self) -> Cell {
        let Some(Statistics { mean, ci95, .. }) = Statistics::of(&self.psnr_a) else {
            return Cell::Unknown;
        };
        Cell::Mean { value: mean, ci95: ci95.unwrap_or(0.0), digits: 2 }
    }
}

/// Returns the root mean square of a frame.
pub(super) fn rms(frame: &Frame) -> f64 {
    let squares: f64 = frame.data.iter().map(|&e| f64::from(e) * f64::from(e)).sum();
    (squares / frame.data.len() as f64).sqrt()
}

/// Stops the command if that is asked for.
pub(super) fn stop_if_asked() -> Result<()> {
    if interrupt::check().is_break() {
        return Err(Error::Interrupted.into());
    }
    Ok(())
}

fn light(sensor: &Sensor, ppp: f64, truths: &[Frame]) -> Result<Light> {
    let mut clip = ClipStatistics::default();
    for frame in truths {
        clip.add(&frame.data);
    }
    let dark = sensor.dark_per_frame()?;
    Ok(resolve_light(sensor, PppDefinition::Incident, ppp, None, &clip, dark)?)
}

/// Scales a frame to the truth's brightness, which counts do not tell.
fn aligned(frame: &Frame, truth: &Frame) -> Frame {
    let gain = best_gain(frame, truth) as f32;
    Frame { size: SIZE, data: frame.data.iter().map(|e| (e * gain).clamp(0.0, 1.0)).collect() }
}
