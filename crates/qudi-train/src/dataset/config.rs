//! What samples are drawn from, as recipes write it down.

use super::pack_index::PackedSource;
use qudi_core::random::uniform;
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Result};
use qudi_sim::scene::{PROCEDURAL, ProceduralScene};
use rand::Rng;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The `[data]` part of a recipe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Frames of a drawn burst.
    pub frames: usize,
    /// Side of its square in pixels.
    pub crop: usize,
    /// Sensors, with their light levels.
    pub sensor: Vec<SensorMix>,
    /// Where scenes come from.
    pub source: Vec<SourceConfig>,
}

/// A sensor that samples are taken with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SensorMix {
    /// A preset's name or a sensor file.
    pub name: String,
    /// Incident photons per pixel and output frame: `{ from, to }`, log-uniform, or a list.
    pub ppp: LightRange,
    /// Binary frames summed into an output frame, if not as the sensor says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames_summed: Option<u32>,
    /// Share of the samples, relative to the others'.
    #[serde(default = "one")]
    pub weight: f64,
}

/// Light levels of samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum LightRange {
    /// Log-uniform between two values.
    Between {
        /// The least.
        from: f64,
        /// The most.
        to: f64,
    },
    /// One of these.
    Of(Vec<f64>),
}

/// A source of scenes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SourceConfig {
    /// Its name in packs, reports and model cards.
    pub name: String,
    /// Kind of the scenes.
    pub kind: SourceKind,
    /// Files and folders below the data folder, or names of procedural scenes.
    pub from: Vec<String>,
    /// Share of the samples, relative to the others'.
    #[serde(default = "one")]
    pub weight: f64,
    /// Factor by which clips and stills are downscaled when they are packed: packs get smaller, and noise and
    /// traces of compression of the source, too.
    #[serde(default = "one")]
    pub shrink: f64,
    /// Largest step through a clip, in its frames: with 2, motion is also twice as fast.
    #[serde(default = "one_frame")]
    pub stride: usize,
    /// Largest factor by which packed clips and stills are downscaled; each sample draws one log-uniformly
    /// from 1 to it.
    #[serde(default = "one")]
    pub max_downscale: f64,
    /// Fastest motion given to stills and procedural scenes, in pixels per frame.
    #[serde(default = "usual_speed")]
    pub speed: f64,
    /// Fraction of the samples from stills without motion.
    #[serde(default)]
    pub static_fraction: f64,
}

/// Kind of a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SourceKind {
    /// Videos, and folders of frames.
    Clips,
    /// Images that are panned, rotated and zoomed, with cut-outs that move in front.
    Stills,
    /// Procedural scenes, without files: `dead-leaves`, `text`, `gratings`, `chart`.
    Scenes,
}

fn one() -> f64 {
    1.0
}

fn one_frame() -> usize {
    1
}

fn usual_speed() -> f64 {
    4.0
}

impl SourceConfig {
    /// Returns true if its scenes come from files.
    pub fn reads_files(&self) -> bool {
        self.kind != SourceKind::Scenes
    }

    /// Draws the factor by which a sample is downscaled.
    pub(super) fn factor(&self, random: &mut impl Rng) -> f64 {
        if self.max_downscale > 1.0 { self.max_downscale.powf(uniform(random)) } else { 1.0 }
    }
}

impl LightRange {
    /// Returns the lowest and the highest level.
    pub fn bounds(&self) -> [f64; 2] {
        match self {
            Self::Between { from, to } => [*from, *to],
            Self::Of(values) => values
                .iter()
                .fold([f64::INFINITY, 0.0], |[low, high], &v| [low.min(v), high.max(v)]),
        }
    }

    /// Returns the level at a uniform number in [0, 1).
    pub(super) fn at(&self, u: f64) -> f64 {
        match self {
            Self::Between { from, to } => from * (to / from).powf(u),
            Self::Of(values) => values[(u * values.len() as f64) as usize],
        }
    }
}

impl SensorMix {
    /// Loads the sensor, as it is used.
    ///
    /// # Errors
    /// [`Error`] if there is none of that name, or it cannot exist.
    pub fn load(&self) -> Result<Sensor> {
        let mut sensor = Sensor::load(&self.name)?;
        if let Some(frames) = self.frames_summed {
            sensor.frames_summed = frames;
            sensor.validate()?;
        }
        refuse_dark_map(&sensor, "data.sensor")?;
        Ok(sensor.as_read())
    }
}

/// Refuses a sensor with a map of dark rates: what is drawn has a size of its own, and no place on the
/// sensor.
///
/// # Errors
/// [`Error`] that names `key`, if there is a map.
pub(crate) fn refuse_dark_map(sensor: &Sensor, key: &str) -> Result<()> {
    match &sensor.defects.dark_map {
        None => Ok(()),
        Some(map) => Err(Error::request(
            format!("the sensor `{}` has a map of dark rates, {map}", sensor.name),
            key,
            "leave `dark_map` out of a copy of its file; `dark_spread` and `hot_fraction` draw rates",
        )),
    }
}

impl DataConfig {
    /// Returns the sensors by name; sums of binary frames as `name x frames`.
    pub(crate) fn sensor_names(&self) -> Vec<String> {
        let name = |mix: &SensorMix| match mix.frames_summed {
            None => mix.name.clone(),
            Some(frames) => format!("{} x {frames}", mix.name),
        };
        self.sensor.iter().map(name).collect()
    }

    /// Returns the fewest and the most photons per pixel and frame of all sensors.
    pub(crate) fn light(&self) -> [f64; 2] {
        let bounds = self.sensor.iter().map(|mix| mix.ppp.bounds());
        bounds.fold([f64::INFINITY, 0.0], |[low, high], [from, to]| [low.min(from), high.max(to)])
    }

    /// Returns the names of all sources.
    pub(crate) fn source_names(&self) -> Vec<String> {
        self.source.iter().map(|source| source.name.clone()).collect()
    }

    /// Returns the configuration, if samples can be drawn from it.
    ///
    /// # Errors
    /// [`Error::Request`] with the key that is wrong.
    pub fn checked(self) -> Result<Self> {
        let fault = |key: &str, what: String, help: &str| {
            Err(Error::request(format!("{key} {what}"), key, help))
        };
        if !(3..=1000).contains(&self.frames) {
            return fault(
                "data.frames",
                format!("is {}", self.frames),
                "use 3 to 1000; the paper has 11",
            );
        }
        if !(16..=4096).contains(&self.crop) {
            return fault("data.crop", format!("is {}", self.crop), "use 16 to 4096 pixels");
        }
        if self.sensor.is_empty() || self.source.is_empty() {
            let key = if self.sensor.is_empty() { "data.sensor" } else { "data.source" };
            return fault(key, "is missing".into(), "name at least one");
        }
        let weight = |w: f64| w.is_finite() && w > 0.0;
        for mix in &self.sensor {
            let [low, high] = mix.ppp.bounds();
            if !(low > 0.0 && low <= high && high <= 1e6) {
                let what = format!("of `{}` reaches from {low} to {high}", mix.name);
                return fault("data.sensor.ppp", what, "give photons per pixel and frame above 0");
            }
            if !weight(mix.weight) {
                return fault(
                    "data.sensor.weight",
                    format!("is {}", mix.weight),
                    "use a number above 0",
                );
            }
        }
        for (i, source) in self.source.iter().enumerate() {
            let key = format!("data.source `{}`", source.name);
            if source.name.is_empty() || source.name.contains(['/', '\\', '"']) {
                return fault(&key, "has no usable name".into(), "use letters and digits");
            }
            if self.source[..i].iter().any(|other| other.name == source.name) {
                return fault(&key, "comes twice".into(), "give every source its own name");
            }
            if source.from.is_empty() || !weight(source.weight) || source.stride == 0 {
                return fault(
                    &key,
                    "wants `from`, a weight above 0 and a stride of 1 or more".into(),
                    "correct the recipe",
                );
            }
            if !(0.0..=100.0).contains(&source.speed) {
                return fault(
                    &key,
                    format!("has a speed of {}", source.speed),
                    "use 0 to 100 pixels per frame",
                );
            }
            if !(0.0..=1.0).contains(&source.static_fraction) {
                let what = format!("has a static_fraction of {}", source.static_fraction);
                return fault(&key, what, "use a fraction from 0 to 1");
            }
            if !(1.0..=4.0).contains(&source.max_downscale) {
                let what = format!("has a max_downscale of {}", source.max_downscale);
                return fault(&key, what, "use a factor from 1 to 4");
            }
            if !(1.0..=8.0).contains(&source.shrink) {
                let what = format!("has a shrink of {}", source.shrink);
                return fault(&key, what, "use a factor from 1 to 8");
            }
            if source.kind == SourceKind::Scenes {
                for name in &source.from {
                    if ProceduralScene::by_name(name).is_none() {
                        let names: Vec<_> = PROCEDURAL.iter().map(|kind| kind.name()).collect();
                        let help = format!("there are {}", names.join(", "));
                        return fault(&key, format!("names an unknown scene, `{name}`"), &help);
                    }
                }
            }
        }
        Ok(self)
    }

    /// Returns the sources that read files, as a pack holds them.
    pub fn packed_sources(&self) -> Vec<PackedSource> {
        let files = self.source.iter().filter(|source| source.reads_files());
        files
            .map(|source| PackedSource {
                name: source.name.clone(),
                kind: source.kind,
                from: source.from.clone(),
                shrink: source.shrink,
                lossless: None,
            })
            .collect()
    }
}
