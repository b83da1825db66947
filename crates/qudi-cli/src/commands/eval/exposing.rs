//! How `qudi eval` exposes clips: the settings of `qudi simulate`, the flags of `eval` over them.

use super::args::Protocol;
use super::plan::Plan;
use crate::error::{CliError, Result};
use crate::settings::Settings;
use qudi_core::sensor::Sensor;
use qudi_core::{PppDefinition, Size};
use qudi_sim::Simulation;
use qudi_sim::clip::{Input, Sampling};
use qudi_sim::scene::StillMotion;

/// Default number of frames of a clip.
pub(crate) const FRAMES: u64 = 33;

/// Default seed.
pub(crate) const SEED: u64 = 1;

/// Everything that determines the photons of a clip, except the clip and its light.
pub(crate) struct Exposing {
    pub(crate) sensor: Sensor,
    pub(crate) seed: u64,
    sampling: Sampling,
    ppp_def: PppDefinition,
    mean_level: Option<f64>,
    motion: Option<StillMotion>,
    size: Option<Size>,
    scene_seed: u64,
    speed: f64,
}

impl Exposing {
    /// Reads flags and settings.
    pub(crate) fn new(plan: &Plan, settings: &Settings) -> Result<Self> {
        if plan.protocol == Protocol::Quiver {
            let unused = ["simulate.instants", "simulate.exposure"];
            settings.refuse(&unused, "by --protocol quiver, which exposes windows anew")?;
        }
        let name = match &plan.sensor {
            Some(name) => name.clone(),
            None => settings.get("simulate.sensor")?,
        };
        let frames = match plan.frames {
            Some(frames) => frames,
            None => settings.given("simulate.frames")?.unwrap_or(FRAMES),
        };
        let seed = match plan.seed {
            Some(seed) => seed,
            None => settings.given("simulate.seed")?.unwrap_or(SEED),
        };
        let mut sensor = settings.sensor(&name)?;
        if let Some(cfa) = sensor.colour.as_ref().and_then(|colour| colour.cfa.as_ref()) {
            return Err(CliError::new(
                format!("clips behind the colour filter {cfa}"),
                "sensor.colour.cfa",
                "methods are compared on gray: expose with `qudi simulate --cfa`, and score colours with `qudi eval TRUTH --restored FILE`",
            ));
        }
        if let Some(sum) = plan.read.sum {
            sensor.frames_summed = sum;
            sensor.validate()?;
        }
        Ok(Self {
            sensor: sensor.as_read(),
            seed,
            sampling: Sampling {
                frames: Some(frames),
                instants: settings.get("simulate.instants")?,
                frames_per_image: settings.get("simulate.frames_per_image")?,
                transfer: settings.get("simulate.transfer")?,
                white: settings.get("simulate.white")?,
            },
            ppp_def: match plan.ppp_def {
                Some(definition) => definition,
                None => settings.get("simulate.ppp_def")?,
            },
            mean_level: settings.get("simulate.exposure")?,
            motion: settings.parse("simulate.motion")?,
            size: match plan.read.size {
                Some(size) => Some(size),
                None => settings.parse("simulate.size")?,
            },
            scene_seed: settings.get("simulate.scene_seed")?,
            speed: settings.get("simulate.speed")?,
        })
    }

    /// Returns the simulation of the clip at `place`.
    pub(crate) fn simulation(&self, place: &str, ppp: f64, seed: u64) -> Result<Simulation> {
        let (motion, size) = (self.motion, self.size);
        Ok(Simulation {
            input: Input::parse(place, motion, size, self.scene_seed, self.speed)?,
            sampling: self.sampling,
            sensor: self.sensor.clone(),
            ppp,
            ppp_def: self.ppp_def,
            mean_level: self.mean_level,
            seed,
        })
    }
}
