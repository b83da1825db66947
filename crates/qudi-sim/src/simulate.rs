//! From scenes to photons: one pass to measure the clip's light, one to expose it.
//!
//! Memory holds one exposure at a time, however long the clip.

use crate::clip::{AssumedWhite, Combs, ExposureSource, Input, MosaicClip, Sampling, decodes};
use qudi_core::Checksum;
use qudi_core::flow::Flow;
use qudi_core::sensor::{PixelMaps, Sensor};
use qudi_core::{Camera, RollingShutter};
use qudi_core::{ClipStatistics, Light, PppDefinition, resolve_light};
use qudi_core::{Error, Result};
use qudi_core::{Frame, Size, Transfer, linear_to_srgb};
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;

/// Complete description of a simulation: the same value gives the same photons.
#[derive(Debug, Serialize, Deserialize)]
pub struct Simulation {
    /// Source of the scene.
    pub input: Input,
    /// Sampling of frames from the source.
    pub sampling: Sampling,
    /// The sensor, gain rule included.
    pub sensor: Sensor,
    /// Photons per pixel, in the sense of `ppp_def`.
    pub ppp: f64,
    /// Meaning of `ppp`.
    pub ppp_def: PppDefinition,
    /// Image value that receives `ppp` photons; the clip's mean if absent.
    #[serde(rename = "exposure")]
    pub mean_level: Option<f64>,
    /// Seed of photons and noise.
    pub seed: u64,
}

impl Simulation {
    /// Opens the clip at its beginning: behind the sensor's colour filter, if it has one.
    fn open(&self) -> Result<Box<dyn ExposureSource>> {
        let colour = self.sensor.colour.as_ref();
        let Some((colour, cfa)) = colour.and_then(|c| Some((c, c.cfa.as_ref()?))) else {
            return self.input.open(&self.sampling);
        };
        if self.sensor.rolling_shutter > 0.0 {
            return Err(Error::request(
                "a rolling shutter behind a colour filter",
                "rolling_shutter",
                "leave one of the two out: the true colours of single rows are not known",
            ));
        }
        Ok(Box::new(MosaicClip::open(&self.input, &self.sampling, cfa, colour)?))
    }
}

/// Progress of a simulation.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// The current pass.
    pub stage: Stage,
    /// Frames done in it.
    pub done: u64,
    /// Frames in all, if known.
    pub total: Option<u64>,
}

/// The two passes over a clip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Measuring the clip's light.
    Measuring,
    /// Exposing it.
    Exposing,
}

/// Properties that are known before the first exposure.
#[derive(Clone, Copy, Debug)]
pub struct Start {
    /// Frame size.
    pub size: Size,
    /// Number of exposures.
    pub frames: u64,
}

/// One exposed frame with its number and its truth.
#[derive(Debug)]
pub struct Exposed<'a> {
    /// Its number.
    pub index: u64,
    /// The counts, `[height * width]`.
    pub counts: &'a [u16],
    /// The scene in the middle of the exposure; of each row's exposure for a rolling shutter. Behind a colour
    /// filter, what every pixel sees of it.
    pub truth: &'a Frame,
    /// Red, green and blue of the scene in the middle of the exposure, behind a colour filter.
    pub colour: Option<&'a [Frame; 3]>,
}

/// Receiver of exposed frames.
pub trait Sink {
    /// Starts the output; called once, before the first frame.
    fn start(&mut self, start: Start) -> Result<()>;

    /// Receives one frame; `flow` computes the true motion to the next frame of a synthetic scene (`None` for
    /// recorded clips and after the last frame).
    fn frame(&mut self, exposed: Exposed<'_>, flow: &dyn Fn() -> Option<Flow>) -> Result<()>;
}

/// Results of a simulation.
#[derive(Clone, Debug)]
pub struct Summary {
    /// Frame size.
    pub size: Size,
    /// Frames exposed.
    pub frames: u64,
    /// The light.
    pub light: Light,
    /// Gain in DN/e-.
    pub gain: f64,
    /// Mean image value of the clip.
    pub clip_mean: f64,
    /// CRC-32 of the clip's values.
    pub clip_crc32: u32,
    /// Mean count per pixel.
    pub mean_count: f64,
    /// Share of pixels at full scale.
    pub saturated: f64,
    /// Hot and dead pixels of the array.
    pub hot_and_dead: (usize, usize),
    /// What makes the clip doubtful.
    pub notes: Vec<String>,
}

/// Runs a simulation. `on` is called for every frame and may stop it.
///
/// # Errors
/// [`Error`] of the input, the sensor, the light or the sink; [`Error::Interrupted`] if `on`
/// breaks.
pub fn simulate(
    simulation: &Simulation,
    sink: &mut dyn Sink,
    on: &mut dyn FnMut(Progress) -> ControlFlow<()>,
) -> Result<Summary> {
    let mut progress = |stage, done, total| match on(Progress { stage, done, total }) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(Error::Interrupted),
    };
    let Simulation { input, sampling, sensor, .. } = simulation;
    sensor.validate()?;

    let mut source = simulation.open()?;
    let info = source.info();
    let (mut clip, mut combs) = (ClipStatistics::default(), Combs::default());
    let mut frames = 0;
    while let Some(exposure) = source.next()? {
        exposure.instants.iter().for_each(|frame| clip.add(&frame.data));
        combs.add(exposure.truth());
        frames += 1;
        progress(Stage::Measuring, frames, info.frames)?;
    }
    if frames == 0 {
        return Err(Error::request(
            format!("the clip is too short for one exposure of {} frames", sampling.instants),
            input.place(),
            "lower `instants`, or check `frames`",
        ));
    }

    let coloured = simulation.sensor.colour.as_ref().is_some_and(|colour| colour.cfa.is_some());
    let decoded = coloured && decodes(input, sampling.transfer);
    let transfer = if decoded { Transfer::Srgb } else { sampling.transfer };
    let mut notes = check_white(input, transfer, clip.largest(), info.assumed_white)?;
    if !coloured && !matches!(input, Input::Procedural(_) | Input::Still { .. }) {
        notes.extend(combs.note(&input.place()));
    }
    if clip.largest() <= 0.0 && simulation.mean_level.is_none() {
        return Err(Error::request(
            "the clip is black: there is no light to distribute photons over",
            input.place(),
            "leave it out, or give the image value that receives PPP photons, `exposure`",
        ));
    }
    let maps = PixelMaps::draw(sensor, info.size)?;
    let mean_dark = maps.mean_dark(sensor)?;
    let light = resolve_light(
        sensor,
        simulation.ppp_def,
        simulation.ppp,
        simulation.mean_level,
        &clip,
        mean_dark,
    )?;
    let mut camera = Camera::with_maps(sensor, maps, info.size, light, simulation.seed)?;
    sink.start(Start { size: info.size, frames })?;

    let mut source = simulation.open()?;
    let (mut sum, mut saturated) = (0u64, 0u64);
    let mut again = Checksum::default();
    let mut shutter = RollingShutter::new(sensor);
    for index in 0..frames {
        let Some(exposure) = source.next()? else {
            return Err(changed(input));
        };
        exposure.instants.iter().for_each(|frame| again.add(&frame.data));
        let rolled = shutter.rolls().then(|| shutter.roll(&exposure.instants));
        let (instants, truth) = match &rolled {
            Some(rolled) => (rolled, &rolled[rolled.len() / 2]),
            None => (&exposure.instants, exposure.truth()),
        };
        let instants: Vec<&Frame> = instants.iter().collect();
        let counts = camera.expose(index, &instants)?;
        sum += counts.iter().map(|&c| u64::from(c)).sum::<u64>();
        saturated += counts.iter().filter(|&&c| c == sensor.max_count()).count() as u64;
        let flow = || if index + 1 < frames { source.flow(index) } else { None };
        let colour = exposure.colour_truth();
        sink.frame(Exposed { index, counts: &counts, truth, colour }, &flow)?;
        progress(Stage::Exposing, index + 1, Some(frames))?;
    }
    if again.crc32() != clip.crc32() {
        return Err(changed(input));
    }
    let pixels = (frames * info.size.pixels() as u64) as f64;
    Ok(Summary {
        size: info.size,
        frames,
        light,
        gain: camera.gain(),
        clip_mean: clip.mean(),
        clip_crc32: clip.crc32(),
        mean_count: sum as f64 / pixels,
        saturated: saturated as f64 / pixels,
        hot_and_dead: (camera.maps().hot.len(), camera.maps().dead.len()),
        notes,
    })
}

/// Share of white that a clip exceeds somewhere, if its white is right: 12 bits in 16 reach a sixteenth.
const MIN_BRIGHTEST: f32 = 0.0625;

/// Share of white that 14 bits in 16 do not exceed.
const FOURTEEN_BITS: f32 = 0.25;

/// Refuses a clip of deep samples whose white is assumed and cannot be right, and describes other dark ones.
fn check_white(
    input: &Input,
    transfer: Transfer,
    largest: f32,
    assumed: AssumedWhite,
) -> Result<Vec<String>> {
    // As it is stored.
    let largest = if transfer.decodes() { linear_to_srgb(largest) } else { largest };
    let Some(full) = assumed.filter(|_| largest > 0.0 && largest <= FOURTEEN_BITS) else {
        let dark = largest > 0.0 && largest < MIN_BRIGHTEST;
        let note = || format!("the clip never exceeds {largest:.3} of white: {}", input.place());
        return Ok(dark.then(note).into_iter().collect());
    };
    let brightest = (largest * full).round();
    let bits = (brightest + 1.0).log2().ceil();
    let what =
        format!("the brightest value is {brightest} of {full}, as in samples of {bits} bits");
    if largest > MIN_BRIGHTEST {
        return Ok(vec![format!("{what}: give the value of white if it is not {full}")]);
    }
    let white = 2f32.powf(bits) - 1.0;
    let help =
        format!("give the value of white: `white {white}`, or {full} if the clip is that dark");
    Err(Error::request(what, input.place(), help))
}

fn changed(input: &Input) -> Error {
    Error::request(
        "the clip changed between the measuring and the exposing pass",
        input.place(),
        "let nothing write to the input, then run again",
    )
}
