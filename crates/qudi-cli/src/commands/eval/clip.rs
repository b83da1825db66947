//! The clips of an evaluation, and how each is exposed.

use super::exposed_clip::{ExposedClip, Motion, Photons, burst_name};
use super::exposing::Exposing;
use super::plan::Plan;
use crate::error::{CliError, Result};
use crate::interrupt;
use qudi_burst::motion::estimate_flow;
use qudi_core::fitting_mean_level;
use qudi_core::flow::Flow;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::Sensor;
use qudi_core::{Error, USUAL_MEAN_LEVEL};
use qudi_io::sidecar::{BurstLayout, ClipDigest, Record, VERSION, beside};
use qudi_io::writer::{BurstFormat, BurstWriter};
use qudi_sim::simulate;
use std::cell::OnceCell;
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// A clip by name, and what to give [`Input::parse`](qudi_sim::clip::Input::parse).
pub(crate) struct Clip {
    name: String,
    place: String,
    /// Estimated once: the truth is the same at every light level.
    estimated_flow: OnceCell<Rc<Vec<Flow>>>,
}

impl Clip {
    /// Finds the clips of `data`: itself, or the clips in the folder.
    pub(crate) fn find(data: &str) -> Result<Vec<Self>> {
        let path = Path::new(data);
        if !path.is_dir() {
            let name = match data.strip_prefix("scene:") {
                Some(name) => name.to_owned(),
                None => stem(path),
            };
            if beside(path).is_file() {
                return Err(CliError::new(
                    "a burst of counts (its record lies next to it), and clips are pictures",
                    data,
                    "measure on it without truth with --capture, or name the clip that it was made of",
                ));
            }
            return Ok(vec![Self::new(name, data.to_owned())]);
        }
        let io = |e| Error::io("list the folder", path, e);
        let mut inside = Vec::new();
        for entry in std::fs::read_dir(path).map_err(io)? {
            inside.push(entry.map_err(io)?.path());
        }
        inside.sort();
        let is_clip = |path: &PathBuf| {
            let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            path.is_dir()
                || ["gif", "y4m", "npy", "mp4", "mkv", "avi", "mov", "webm"]
                    .contains(&extension.as_str())
        };
        let clips: Vec<_> = inside.into_iter().filter(is_clip).collect();
        let clips = if clips.is_empty() { vec![path.to_owned()] } else { clips };
        let named = clip_names(&clips).into_iter().zip(&clips);
        Ok(named.map(|(name, path)| Self::new(name, path.display().to_string())).collect())
    }

    /// Selects the clips that have one of these names, in the order of `clips`; all without names.
    ///
    /// # Errors
    /// [`CliError`] if no clip has one of the names.
    pub(crate) fn only(clips: Vec<Self>, names: &[String], data: &str) -> Result<Vec<Self>> {
        if names.is_empty() {
            return Ok(clips);
        }
        if let Some(name) = names.iter().find(|name| !clips.iter().any(|clip| &clip.name == *name))
        {
            let all: Vec<_> = clips.iter().map(|clip| clip.name.as_str()).collect();
            let what = format!("no clip named `{name}` in {data}");
            return Err(CliError::new(what, "--clips", format!("there are {}", all.join(", "))));
        }
        Ok(clips.into_iter().filter(|clip| names.contains(&clip.name)).collect())
    }

    /// Returns its name.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    fn new(name: String, place: String) -> Self {
        Self { name, place, estimated_flow: OnceCell::new() }
    }

    /// Exposes the clip; the same photons for the same seed, name, sensor and light.
    pub(crate) fn expose(&self, plan: &Plan, exposing: &Exposing, ppp: f64) -> Result<ExposedClip> {
        let sensor = &exposing.sensor;
        let seed = exposing.seed.wrapping_add(u64::from(name_digest(&self.name)) << 20);
        let simulation = exposing.simulation(&self.place, ppp, seed)?;
        let mut photons = Photons::default();
        let summary = simulate(&simulation, &mut photons, &mut |_| interrupt::check())?;
        let size = summary.size;
        if let Some(folder) = &plan.export_photons {
            let format = BurstFormat::npy(sensor.max_count(), true);
            let path = folder.join(format!("{}.npy", burst_name(&self.name, ppp)));
            let mut writer =
                BurstWriter::create(&path, format, size, sensor.max_count(), plan.overwrite)?;
            photons.counts.iter().try_for_each(|counts| writer.push(counts))?;
            let record = Record {
                version: VERSION,
                program: format!("qudi {}", env!("CARGO_PKG_VERSION")),
                burst: BurstLayout::new(format, summary.frames, size, sensor),
                light: summary.light,
                gain: summary.gain,
                clip: ClipDigest { mean: summary.clip_mean, crc32: summary.clip_crc32 },
                simulation,
            };
            let bytes = serde_json::to_vec_pretty(&record)
                .map_err(|e| CliError::new(e, path.display(), "report this as a bug"))?;
            writer.finish(&bytes, plan.overwrite)?;
        }
        let above_pedestal = Sensor { offset: 0.0, ..sensor.clone() };
        let acquisition = Acquisition::new(above_pedestal, summary.light.ppp, USUAL_MEAN_LEVEL)?;
        let mut acquisition = acquisition.with_seed(exposing.seed);
        acquisition.gain = summary.gain;
        acquisition = acquisition.without_echoes()?.with_pedestal(sensor.offset)?;
        acquisition.mean_level = if let Some(mean_level) = plan.mean_level {
            mean_level
        } else {
            let read = |frame: u64| Ok(photons.counts[frame as usize].clone());
            fitting_mean_level(size, photons.counts.len() as u64, &acquisition, read)?
        };
        let motion = if photons.flow.is_empty() {
            let estimate = || {
                let pairs = photons.truth.windows(2);
                Rc::new(pairs.map(|pair| estimate_flow(&pair[0], &pair[1])).collect())
            };
            Motion::Estimated(Rc::clone(self.estimated_flow.get_or_init(estimate)))
        } else {
            Motion::True(std::mem::take(&mut photons.flow))
        };
        Ok(ExposedClip {
            name: self.name.clone(),
            size,
            ppp,
            seed,
            photons,
            motion,
            acquisition,
            perceptual: plan.perceptual.clone(),
            appearance: plan.appearance,
            notes: summary.notes,
            shown: 0..0,
        })
    }
}

/// Returns the files and folders of the clips in `data`; none for a scene, or where there are none.
pub(crate) fn clip_places(data: &str) -> Vec<PathBuf> {
    let clips =
        if data.starts_with("scene:") { Vec::new() } else { Clip::find(data).unwrap_or_default() };
    clips.into_iter().map(|clip| PathBuf::from(clip.place)).collect()
}

/// Returns the name of a clip: of a file without its extension, of a folder as it is, dots and all.
pub(crate) fn stem(path: &Path) -> String {
    if path.is_dir() {
        return full_name(path);
    }
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Returns the names of clips: of files without the extension, of folders in full, since `run.1` and `run.2`
/// are two clips. Files that differ in the extension alone keep it.
fn clip_names(clips: &[PathBuf]) -> Vec<String> {
    let mut names: Vec<String> = clips.iter().map(|path| stem(path)).collect();
    // A name in full may be another clip's short one.
    loop {
        let is_unique = |name: &String| names.iter().filter(|other| *other == name).count() == 1;
        let name = |(path, name): (&PathBuf, &String)| {
            if is_unique(name) { name.clone() } else { full_name(path) }
        };
        let unique: Vec<String> = clips.iter().zip(&names).map(name).collect();
        if unique == names {
            return names;
        }
        names = unique;
    }
}

fn full_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Computes FNV-1a: the seed of a clip must not depend on other clips in its folder.
fn name_digest(name: &str) -> u32 {
    name.bytes().fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}
