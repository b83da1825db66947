//! Measurement of a network on fixed bursts.

use super::recipe::{Recipe, VALIDATION, ValidationConfig};
use crate::dataset::{Pack, acquisition, refuse_dark_map};
use qudi_core::fitting_mean_level;
use qudi_core::metrics::{gain_aligned_psnr, psnr, ssim};
use qudi_core::restorer::{BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Error, Frame, Light, Result, RollingShutter, Size, USUAL_MEAN_LEVEL};
use qudi_sim::scene::{Procedural, ProceduralScene};
use serde::Serialize;
use std::slice::from_ref;

/// Seed of the photons.
const SEED: u64 = 2026;

/// Speed of procedural scenes, in pixels per frame.
const SPEED: f64 = 2.0;

/// Fixed bursts.
#[derive(Debug)]
pub struct Validator {
    config: ValidationConfig,
    clips: Vec<(String, Vec<Frame>)>,
    sensor: Sensor,
}

/// Quality on one clip.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ValidationClip {
    /// Its name.
    pub name: String,
    /// Photons per pixel and frame.
    pub ppp: f64,
    /// Gain-aligned PSNR in dB, mean over frames.
    pub psnr_a: f64,
    /// Raw PSNR in dB.
    pub psnr: f64,
    /// SSIM.
    pub ssim: f64,
    /// Counts, restored and true images: all frames at the first light level, the middle one at others.
    #[serde(skip)]
    pub pictures: Vec<[Frame; 3]>,
}

impl ValidationClip {
    /// Returns counts, restored and true image of the middle frame.
    pub fn middle(&self) -> &[Frame; 3] {
        &self.pictures[self.pictures.len() / 2]
    }
}

/// Quality on all clips.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Validation {
    /// Training steps taken.
    pub step: u64,
    /// Every clip at every light level.
    pub clips: Vec<ValidationClip>,
}

impl Validator {
    /// Reads the clips of a recipe from its pack; none if the recipe measures nothing.
    ///
    /// # Errors
    /// [`Error`] if the pack lacks them or they are too small.
    pub fn new(recipe: &Recipe, pack: Option<&Pack>) -> Result<Option<Self>> {
        let Some(config) = recipe.validation.clone() else { return Ok(None) };
        let side = Size { height: config.crop, width: config.crop };
        let mut clips = Vec::new();
        for name in config.from.iter().filter_map(|from| from.strip_prefix("scene:")) {
            let Some(kind) = ProceduralScene::by_name(name) else {
                let what = format!("no procedural scene named `{name}`");
                return Err(Error::request(what, "validation.from", "correct the recipe"));
            };
            let scene = Procedural { kind, size: side, seed: SEED, speed: SPEED }.scene();
            let frames: Vec<_> = (0..config.frames).map(|t| scene.render(t as f64)).collect();
            clips.push((name.to_owned(), frames));
        }
        if recipe.validation_source().is_some() {
            let Some(pack) = pack else {
                let help = "give the data folder, or a pack";
                let what = "the validation clips need files";
                return Err(Error::request(what, "validation.from", help));
            };
            for (number, clip) in pack.clips().iter().enumerate() {
                if clip.source != VALIDATION {
                    continue;
                }
                let Size { height, width } = clip.size;
                if height.min(width) < config.crop || clip.frames < config.frames {
                    let what =
                        format!("`{}` is smaller than the validation's crop or frames", clip.name);
                    return Err(Error::data(
                        what,
                        pack.path(),
                        "lower validation.crop or validation.frames",
                    ));
                }
                let first = (clip.frames - config.frames) / 2;
                let (left, top) = ((width - config.crop) / 2, (height - config.crop) / 2);
                let frames = (first..first + config.frames).map(|t| {
                    let frame = pack.frame(number, t);
                    Frame::from_fn(side, |x, y| frame.value(left + x, top + y))
                });
                clips.push((clip.name.clone(), frames.collect()));
            }
        }
        if clips.is_empty() {
            let what = "the pack holds no validation clips";
            return Err(Error::request(
                what,
                "validation.from",
                "make the pack again from this recipe",
            ));
        }
        let sensor = Sensor::load(&config.sensor)?.as_read();
        refuse_dark_map(&sensor, "validation.sensor")?;
        for (_, frames) in &mut clips {
            let mut shutter = RollingShutter::new(&sensor);
            *frames = frames.iter().flat_map(|frame| shutter.roll(from_ref(frame))).collect();
        }
        Ok(Some(Self { config, clips, sensor }))
    }

    /// Returns the steps between validations.
    pub fn every(&self) -> u64 {
        self.config.every
    }

    /// Restores every clip at every light level with `restorer`, after `step` steps.
    ///
    /// # Errors
    /// [`Error`] if the device fails.
    pub fn measure(&self, restorer: &mut dyn Restorer, step: u64) -> Result<Validation> {
        let mut clips = Vec::new();
        for (level, &ppp) in self.config.ppp.iter().enumerate() {
            for (number, (name, truth)) in self.clips.iter().enumerate() {
                let size = truth[0].size;
                let mean = truth.iter().map(Frame::mean).sum::<f64>() / truth.len() as f64;
                let light = Light { ppp, mean_level: mean.max(1e-3) };
                let mut camera = Camera::new(&self.sensor, size, light, SEED + number as u64)?;
                let counts = (0..).zip(truth).map(|(t, frame)| camera.expose(t, &[frame]));
                let counts: Vec<Vec<u16>> = counts.collect::<Result<_>>()?;
                let acquisition = acquisition(&self.sensor, ppp, USUAL_MEAN_LEVEL)?;
                let mut acquisition = acquisition.with_seed(SEED);
                let read = |frame: u64| Ok(counts[frame as usize].clone());
                acquisition.mean_level =
                    fitting_mean_level(size, counts.len() as u64, &acquisition, read)?;
                let restored =
                    restorer.restore(BurstView { size, frames: &counts }, &acquisition)?.frames;
                let mean = |of: fn(&Frame, &Frame) -> f64| {
                    let all = restored.iter().zip(truth).map(|(frame, truth)| of(frame, truth));
                    all.sum::<f64>() / truth.len() as f64
                };
                let middle = truth.len() / 2;
                let full = f32::from(self.sensor.max_count());
                let picture = |t: usize| {
                    let seen = counts[t].iter().map(|&count| f32::from(count) / full).collect();
                    [Frame { size, data: seen }, restored[t].clone(), truth[t].clone()]
                };
                let shown = if level == 0 { 0..truth.len() } else { middle..middle + 1 };
                clips.push(ValidationClip {
                    name: name.clone(),
                    ppp,
                    psnr_a: mean(gain_aligned_psnr),
                    psnr: mean(psnr),
                    ssim: mean(|a, b| ssim(a, b).unwrap_or(f64::NAN)),
                    pictures: shown.map(picture).collect(),
                });
            }
        }
        Ok(Validation { step, clips })
    }
}

impl Validation {
    /// Returns the means of gain-aligned PSNR, raw PSNR and SSIM at every light level, in the recipe's order.
    pub fn means(&self) -> Vec<(f64, [f64; 3])> {
        let mut means: Vec<(f64, [f64; 3], usize)> = Vec::new();
        for clip in &self.clips {
            let values = [clip.psnr_a, clip.psnr, clip.ssim];
            if let Some((_, sums, count)) = means.iter_mut().find(|mean| mean.0 == clip.ppp) {
                for (sum, value) in sums.iter_mut().zip(values) {
                    *sum += value;
                }
                *count += 1;
            } else {
                means.push((clip.ppp, values, 1));
            }
        }
        means.into_iter().map(|(ppp, sums, n)| (ppp, sums.map(|sum| sum / n as f64))).collect()
    }
}
