//! Drawing of samples: a scene, a crop, a sensor, a light level, and new photons.

use super::config::{DataConfig, SourceConfig, SourceKind};
use super::crop::{Crop, shrunk};
use super::pack::Pack;
use qudi_core::Light;
use qudi_core::random::{Domain, Streams, uniform};
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::{Defects, Sensor};
use qudi_core::{Camera, Error, Frame, Result, RollingShutter, Size};
use qudi_sim::scene::{Procedural, ProceduralScene, StillMotion, still_scene};
use rand::Rng;
use std::f64::consts::TAU;

/// Bounds of mean levels; outside, frames are black or saturated.
const MEAN_LEVELS: [f64; 2] = [0.02, 0.95];

/// Bounds of the factor that a scene is made darker or brighter by, photons unchanged: users do not know the
/// true exposure.
const RESCALING: [f64; 2] = [0.6, 1.5];

/// One burst to learn from.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The clean frames.
    pub truth: Vec<Frame>,
    /// Counts of the sensor, frame by frame.
    pub counts: Vec<Vec<u16>>,
    /// Sensor and light; its seed is the sample's own.
    pub acquisition: Acquisition,
}

/// Draws samples. Clones share the pack.
#[derive(Clone, Debug)]
pub struct Dataset {
    config: DataConfig,
    pack: Option<Pack>,
    sensors: Vec<Sensor>,
    /// Clips of the pack that belong to each source.
    clips: Vec<Vec<usize>>,
}

impl Dataset {
    /// Makes a dataset of `config` from `pack`, which sources with files need.
    ///
    /// # Errors
    /// [`Error`] if a sensor is unknown, or the pack lacks a source or holds clips that are too small.
    pub fn new(config: &DataConfig, pack: Option<Pack>) -> Result<Self> {
        let sensors = config.sensor.iter().map(super::SensorMix::load).collect::<Result<_>>()?;
        let clips = config.source.iter().map(|source| clips_of(config, source, pack.as_ref()));
        let clips = clips.collect::<Result<_>>()?;
        Ok(Self { config: config.clone(), pack, sensors, clips })
    }

    /// Returns the digest of the pack that samples are drawn from, if there is one.
    pub(crate) fn pack_sha256(&self) -> Option<String> {
        self.pack.as_ref().map(|pack| pack.sha256().to_owned())
    }

    /// Draws sample `number` of `seed`.
    ///
    /// # Errors
    /// [`Error`] if a sensor cannot be used.
    pub fn sample(&self, seed: u64, number: u64) -> Result<Sample> {
        let mut rng = Streams::new(seed).row(Domain::Training, number, 0);
        let weights: Vec<f64> = self.config.source.iter().map(|source| source.weight).collect();
        let at = pick(&weights, uniform(&mut rng));
        let (frames, mean_level) = match self.config.source[at].kind {
            SourceKind::Clips => self.clip(at, &mut rng),
            SourceKind::Stills => self.still(at, &mut rng),
            SourceKind::Scenes => self.scene(at, &mut rng),
        };
        let (frames, mean_level) = rescaled(frames, mean_level, uniform(&mut rng));
        let weights: Vec<f64> = self.config.sensor.iter().map(|mix| mix.weight).collect();
        let at = pick(&weights, uniform(&mut rng));
        let sensor = self.sensors[at].clone();
        let light = Light { ppp: self.config.sensor[at].ppp.at(uniform(&mut rng)), mean_level };
        let seed = rng.next_u64();
        // A crop may lie anywhere on the sensor: no pattern of defects is to be learnt.
        let defects = Defects { seed, ..sensor.defects.clone() };
        let exposed = Sensor { defects, ..sensor.clone() };
        let mut camera = Camera::new(&exposed, frames[0].size, light, seed)?;
        let mut shutter = RollingShutter::new(&sensor);
        let (mut truth, mut counts) = (Vec::new(), Vec::new());
        for (t, frame) in (0..).zip(&frames) {
            let seen = shutter.roll(std::slice::from_ref(frame)).swap_remove(0);
            counts.push(camera.expose(t, &[&seen])?);
            truth.push(seen);
        }
        let acquisition = acquisition(&sensor, light.ppp, mean_level)?.with_seed(seed);
        Ok(Sample { truth, counts, acquisition })
    }

    /// Cuts frames from a clip, and returns the clip's mean, too.
    fn clip(&self, source: usize, rng: &mut impl Rng) -> (Vec<Frame>, f64) {
        let pack = self.pack.as_ref().expect("checked at the start");
        let number = self.clips[source][below(self.clips[source].len(), rng)];
        let clip = &pack.clips()[number];
        let steps = self.config.frames - 1;
        let longest = self.config.source[source].stride.min((clip.frames - 1) / steps.max(1));
        let stride = 1 + below(longest.max(1), rng);
        let first = below(clip.frames - steps * stride, rng);
        let backward = rng.next_u64() & 1 == 1;
        let factor = self.config.source[source].factor(rng);
        let crop = cut(clip.size, enlarged(self.config.crop, factor), rng);
        let mut frames = Vec::with_capacity(steps + 1);
        for i in 0..=steps {
            let frame = crop.of(pack.frame(number, first + i * stride));
            frames.push(shrunk(frame, square(self.config.crop)));
        }
        if backward {
            frames.reverse();
        }
        (frames, pack.mean(number))
    }

    fn still(&self, source: usize, rng: &mut impl Rng) -> (Vec<Frame>, f64) {
        let pack = self.pack.as_ref().expect("checked at the start");
        let number = self.clips[source][below(self.clips[source].len(), rng)];
        let clip = &pack.clips()[number];
        let (side, frames) = (self.config.crop, self.config.frames);
        let (angle, speed) = (TAU * uniform(rng), self.config.source[source].speed * uniform(rng));
        let mut motion = StillMotion {
            pan: [speed * angle.cos(), speed * angle.sin()],
            rotate: 1.5 * (uniform(rng) - 0.5),
            zoom: 1.0 + 0.02 * (uniform(rng) - 0.5),
            layers: below(4, rng) as u32,
        };
        let static_fraction = self.config.source[source].static_fraction;
        if static_fraction > 0.0 && uniform(rng) < static_fraction {
            motion = StillMotion::default();
        }
        // The scene shows the middle of the image: the part around the crop, with the way that it goes.
        let way = (speed * frames as f64 / 2.0).ceil() as usize + 4;
        let part = (side + 2 * way).min(clip.size.height).min(clip.size.width);
        let factor = self.config.source[source].factor(rng);
        let crop = cut(clip.size, enlarged(part, factor), rng);
        let image = shrunk(crop.of(pack.frame(number, 0)), square(part));
        let scene = still_scene(image, motion, square(side), rng.next_u64());
        (rendered(&scene, frames), pack.mean(number))
    }

    fn scene(&self, source: usize, rng: &mut impl Rng) -> (Vec<Frame>, f64) {
        let SourceConfig { from, speed, .. } = &self.config.source[source];
        let name = &from[below(from.len(), rng)];
        let size = square(self.config.crop);
        let kind = ProceduralScene::by_name(name).expect("checked with the recipe");
        let speed = speed * uniform(rng);
        let scene = Procedural { kind, size, seed: rng.next_u64(), speed }.scene();
        let frames = rendered(&scene, self.config.frames);
        let mean = frames.iter().map(Frame::mean).sum::<f64>() / frames.len() as f64;
        (frames, mean)
    }
}

/// Returns what is known of a capture, as `restore` and `eval` know it: cross-talk and afterpulses counted as
/// light, a pedestal as dark electrons.
///
/// # Errors
/// [`Error`] if the sensor has no gain at this light.
pub(crate) fn acquisition(sensor: &Sensor, ppp: f64, mean_level: f64) -> Result<Acquisition> {
    let above_pedestal = Sensor { offset: 0.0, ..sensor.clone() };
    let acquisition = Acquisition::new(above_pedestal, ppp, mean_level)?;
    acquisition.without_echoes()?.with_pedestal(sensor.offset)
}

fn square(side: usize) -> Size {
    Size { height: side, width: side }
}

/// Returns the side that `factor` downscales to `side`.
fn enlarged(side: usize, factor: f64) -> usize {
    (side as f64 * factor).round() as usize
}

/// Draws a square of an image of `size`, with `side` or the largest that fits, and its orientation.
fn cut(size: Size, side: usize, rng: &mut impl Rng) -> Crop {
    let side = side.min(size.height).min(size.width);
    Crop {
        left: below(size.width - side + 1, rng),
        top: below(size.height - side + 1, rng),
        side,
        turn: (rng.next_u64() & 7) as u8,
    }
}

/// Returns the clips of the pack that belong to a source, all large enough.
fn clips_of(config: &DataConfig, source: &SourceConfig, pack: Option<&Pack>) -> Result<Vec<usize>> {
    if source.kind == SourceKind::Scenes {
        return Ok(Vec::new());
    }
    let Some(pack) = pack else {
        let what = format!("source `{}` needs files", source.name);
        return Err(Error::request(what, "data.source", "give the data folder, or a pack"));
    };
    let mine = pack.clips().iter().enumerate().filter(|(_, clip)| clip.source == source.name);
    let list: Vec<usize> = mine.map(|(number, _)| number).collect();
    if list.is_empty() {
        let what = format!("the pack holds nothing of source `{}`", source.name);
        let help = "make the pack again from this recipe";
        return Err(Error::data(what, pack.path(), help));
    }
    let frames = if source.kind == SourceKind::Clips { config.frames } else { 1 };
    for &number in &list {
        let clip = &pack.clips()[number];
        let small = clip.size.height.min(clip.size.width) < config.crop;
        if small || clip.frames < frames {
            return Err(Error::data(
                format!(
                    "`{}` has {} frames of {}, samples have {frames} of {} x {}",
                    clip.name, clip.frames, clip.size, config.crop, config.crop
                ),
                pack.path(),
                "lower data.crop or data.frames, or leave the clip out",
            ));
        }
    }
    Ok(list)
}

/// Multiplies frames and their mean level by a factor, drawn with `u`, that takes no value beyond white.
fn rescaled(mut truth: Vec<Frame>, mean_level: f64, u: f64) -> (Vec<Frame>, f64) {
    let mean_level = mean_level.clamp(MEAN_LEVELS[0], MEAN_LEVELS[1]);
    let values = truth.iter().flat_map(|frame| &frame.data);
    let brightest = f64::from(values.fold(1e-3f32, |most, &value| most.max(value)));
    let most = RESCALING[1].min(1.0 / brightest).min(MEAN_LEVELS[1] / mean_level);
    let factor = RESCALING[0] * (most / RESCALING[0]).powf(u);
    for value in truth.iter_mut().flat_map(|frame| &mut frame.data) {
        *value *= factor as f32;
    }
    (truth, mean_level * factor)
}

/// Renders frames around time 0.
fn rendered(scene: &qudi_sim::scene::Scene, frames: usize) -> Vec<Frame> {
    let middle = (frames / 2) as f64;
    (0..frames).map(|k| scene.render(k as f64 - middle)).collect()
}

/// Draws a number below `count`, which is positive.
fn below(count: usize, rng: &mut impl Rng) -> usize {
    ((uniform(rng) * count as f64) as usize).min(count - 1)
}

/// Returns the interval that `u` in [0, 1) falls into, among intervals of these lengths.
fn pick(weights: &[f64], u: f64) -> usize {
    let mut rest = u * weights.iter().sum::<f64>();
    for (i, weight) in weights.iter().enumerate() {
        rest -= weight;
        if rest < 0.0 {
            return i;
        }
    }
    weights.len() - 1
}
