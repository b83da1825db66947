//! A scene under the camera, and what every method makes of its counts.

use super::scenes::{DemoScene, FRAMES, Planes, SIZE};
use super::uncertainty::Uncertainty;
use crate::colour::behind_filter;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::{Bar, Cell, Column, Table};
use qudi_core::colour::ColourFilter;
use qudi_core::metrics::{Statistics, best_gain, gain_aligned_psnr, psnr, ssim};
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{
    Camera, ClipStatistics, Error, Frame, Light, PppDefinition, USUAL_MEAN_LEVEL, resolve_light,
};
use std::time::Instant;

/// The frame in the middle of the window.
pub(super) const CENTRE: usize = FRAMES / 2;

/// Filter of the camera that sees scenes in colour.
const FILTER: &str = "rggb";

/// A scene as the camera saw it.
pub(super) struct ExposedScene {
    pub(super) name: &'static str,
    pub(super) about: &'static str,
    /// The truth of every frame, or its luma.
    pub(super) truths: Vec<Frame>,
    /// The colours of a scene that has some.
    colour: Option<ColourTruth>,
    pub(super) counts: Vec<Vec<u16>>,
    pub(super) acquisition: Acquisition,
}

/// Colours of a scene, and the filter through which they are seen.
struct ColourTruth {
    filter: ColourFilter,
    planes: Vec<[Frame; 3]>,
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
    /// Red, green and blue, where the scene has colours.
    colour: Option<Vec<[Frame; 3]>>,
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
        let mut times = (0..FRAMES).map(|t| {
            bar.update("rendering", t as u64 + 1, Some(FRAMES as u64));
            t as f64
        });
        let (truths, seen, colour) = match &scene.planes {
            Planes::Gray(scene) => {
                let truths: Vec<Frame> = times.map(|t| scene.render(t)).collect();
                (truths.clone(), truths, None)
            }
            Planes::Colour(scenes) => {
                let mosaic = FILTER
                    .parse()
                    .map_err(|e: String| CliError::new(e, FILTER, "report this as a bug"))?;
                let filter = ColourFilter::tiled(&mosaic, SIZE)?;
                let render = |t| scenes.each_ref().map(|scene| scene.render(t));
                let planes: Vec<[Frame; 3]> = times.by_ref().map(render).collect();
                let seen = planes.iter().map(|planes| filter.mosaic(planes)).collect();
                let weights = filter.luma_weights();
                let truths = planes.iter().map(|planes| luma(planes, weights)).collect();
                (truths, seen, Some(ColourTruth { filter, planes }))
            }
        };
        let light = light(sensor, ppp, &seen)?;
        let mut camera = Camera::new(sensor, SIZE, light, seed)?;
        let mut counts = Vec::with_capacity(FRAMES);
        for (t, frame) in (0..).zip(&seen) {
            counts.push(camera.expose(t, &[frame])?);
        }
        let acquisition = Acquisition::new(sensor.clone(), light.ppp, USUAL_MEAN_LEVEL)?;
        let acquisition = acquisition.with_seed(seed);
        let DemoScene { name, about, .. } = scene;
        Ok(Self { name, about, truths, colour, counts, acquisition })
    }

    /// Makes a method see the filter, if there is one.
    pub(super) fn behind_filter(&self, restorer: Box<dyn Restorer>) -> Result<Box<dyn Restorer>> {
        match &self.colour {
            Some(ColourTruth { filter, .. }) => behind_filter(restorer, filter, true),
            None => Ok(restorer),
        }
    }

    /// Restores the scene by every method.
    pub(super) fn restore(
        self,
        mut contenders: Vec<Contender>,
        bar: &mut Bar,
    ) -> Result<RestoredScene> {
        let mut methods = Vec::new();
        let mut last = Restored::gray(Vec::new(), None);
        let count = contenders.len() as u64;
        for (done, contender) in (1..).zip(&mut contenders) {
            let start = Instant::now();
            let view = BurstView { size: SIZE, frames: &self.counts };
            last = contender.restorer.restore(view, &self.acquisition)?;
            methods.push(self.shown(contender, &last, start.elapsed().as_secs_f64()));
            bar.update("restoring", done, Some(count));
            stop_if_asked()?;
        }
        let restorer = &mut contenders.last_mut().expect("there are three at least").restorer;
        let uncertainty = if let Some(sigmas) = last.std {
            Uncertainty::predicted(sigmas)
        } else {
            let seen = match (&self.colour, last.colour) {
                (Some(truth), Some(planes)) => {
                    planes.iter().map(|planes| truth.filter.mosaic(planes)).collect()
                }
                _ => last.frames,
            };
            Uncertainty::redrawn(restorer.as_mut(), &seen, &self.acquisition, bar)?
        };
        Ok(RestoredScene { exposed: self, methods, uncertainty })
    }

    fn shown(&self, contender: &Contender, restored: &Restored, seconds: f64) -> Shown {
        let frames = &restored.frames;
        let pairs = || frames.iter().zip(&self.truths);
        let gains: Vec<f32> =
            pairs().map(|(frame, truth)| best_gain(frame, truth) as f32).collect();
        let colour = restored.colour.as_ref().map(|colour| {
            let scaled = |(planes, &gain): (&[Frame; 3], &f32)| {
                planes.each_ref().map(|plane| scaled(plane, gain))
            };
            colour.iter().zip(&gains).map(scaled).collect()
        });
        let (frame, truth) = (&frames[CENTRE], &self.truths[CENTRE]);
        Shown {
            label: contender.label,
            name: contender.restorer.name(),
            how: contender.how.clone(),
            frames: frames.iter().zip(&gains).map(|(frame, &gain)| scaled(frame, gain)).collect(),
            colour,
            psnr_a: pairs().map(|(frame, truth)| gain_aligned_psnr(frame, truth)).collect(),
            psnr: psnr(frame, truth),
            ssim: ssim(frame, truth).unwrap_or(f64::NAN),
            seconds,
        }
    }

    /// Returns red, green and blue of the truth of a frame.
    pub(super) fn truth(&self, t: usize) -> [&Frame; 3] {
        match &self.colour {
            Some(ColourTruth { planes, .. }) => planes[t].each_ref(),
            None => [&self.truths[t]; 3],
        }
    }

    /// Returns true if the scene has colours.
    pub(super) fn is_coloured(&self) -> bool {
        self.colour.is_some()
    }
}

impl RestoredScene {
    /// Returns the scores of every method: of the frame in the centre, and the mean over all frames.
    pub(super) fn table(&self) -> Table {
        let mut table = Table::new(vec![
            Column::new("method", format!("{}, centre frame", self.exposed.name)),
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
    /// Returns red, green and blue of a frame.
    pub(super) fn planes(&self, t: usize) -> [&Frame; 3] {
        match &self.colour {
            Some(colour) => colour[t].each_ref(),
            None => [&self.frames[t]; 3],
        }
    }

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

/// Multiplies a frame by the gain to the truth's brightness, which counts do not tell, and clips it.
fn scaled(frame: &Frame, gain: f32) -> Frame {
    Frame { size: SIZE, data: frame.data.iter().map(|e| (e * gain).clamp(0.0, 1.0)).collect() }
}

/// Adds red, green and blue to luma.
fn luma(planes: &[Frame; 3], weights: [f64; 3]) -> Frame {
    let value = |i: usize| -> f32 {
        planes.iter().zip(weights).map(|(plane, weight)| plane.data[i] * weight as f32).sum()
    };
    Frame { size: SIZE, data: (0..SIZE.pixels()).map(value).collect() }
}
