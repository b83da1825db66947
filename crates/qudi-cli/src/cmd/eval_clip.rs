//! One clip, exposed once, scored for every method.

use crate::args::{Eval, External};
use crate::cmd::eval_exposing::Exposing;
use crate::cmd::eval_html::Pictures;
use crate::cmd::eval_score::{Cost, FlowKind, FrameScore, Score};
use crate::cmd::methods::method;
use crate::error::{Fault, Result};
use crate::interrupt;
use crate::memory::Peak;
use qudi_burst::motion::{estimate_flow, warping_error};
use qudi_core::atomic_file::Overwrite;
use qudi_core::auto_exposure::fitting_exposure;
use qudi_core::flow::Flow;
use qudi_core::metrics::Consistency;
use qudi_core::metrics::{best_gain, gain_aligned_psnr, gaussian_ssim, psnr, ssim};
use qudi_core::npy::read_clip;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::windows::Windows;
use qudi_core::{Camera, Frame, Light, SimError, Size, USUAL_EXPOSURE};
use qudi_io::capture::Capture;
use qudi_io::restore::{RestoreSink, run as run_method};
use qudi_io::sidecar::{BurstLayout, ClipDigest, Record, VERSION, beside};
use qudi_io::writer::{BurstFormat, BurstWriter};
use qudi_sim::clip::{Input, Sampling};
use qudi_sim::{Exposed, Sink, Start, simulate};
use std::cell::OnceCell;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Instant;

/// A clip by name, and what to give [`Input::parse`].
pub(crate) struct Clip {
    name: String,
    place: String,
    /// Estimated once: the truth is the same at every light level.
    estimated_flow: OnceCell<Rc<Vec<Flow>>>,
}

impl Clip {
    /// The clips of `data`: itself, or what lies in the folder.
    pub(crate) fn find(data: &str) -> Result<Vec<Self>> {
        let path = Path::new(data);
        if !path.is_dir() {
            let name = match data.strip_prefix("scene:") {
                Some(name) => name.to_owned(),
                None => stem(path),
            };
            if beside(path).is_file() {
                return Err(Fault::new(
                    "a burst of counts (its record lies beside it), and clips are pictures",
                    data,
                    "measure on it without truth with --capture, or name the clip that it was made of",
                ));
            }
            return Ok(vec![Self::new(name, data.to_owned())]);
        }
        let io = |e| SimError::io("list the folder", path, e);
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

    /// The clips' files and folders; none of a scene.
    pub(crate) fn places(data: &str) -> Result<Vec<PathBuf>> {
        let clips = if data.starts_with("scene:") { Vec::new() } else { Self::find(data)? };
        Ok(clips.into_iter().map(|clip| PathBuf::from(clip.place)).collect())
    }

    fn new(name: String, place: String) -> Self {
        Self { name, place, estimated_flow: OnceCell::new() }
    }

    /// Exposes the clip; the same photons for the same seed, name, sensor and light.
    pub(crate) fn expose(
        &self,
        args: &Eval,
        exposing: &Exposing,
        ppp: f64,
        overwrite: Overwrite,
    ) -> Result<ExposedClip> {
        let sensor = &exposing.sensor;
        let seed = exposing.seed.wrapping_add(u64::from(name_digest(&self.name)) << 20);
        let simulation = exposing.simulation(&self.place, ppp, seed)?;
        let mut kept = Kept::default();
        let summary = simulate(&simulation, &mut kept, &mut |_| interrupt::check())?;
        let size = summary.size;
        if let Some(folder) = &args.export_photons {
            let format = BurstFormat::npy(sensor.max_count(), true);
            let path = folder.join(format!("{}.npy", burst_name(&self.name, ppp)));
            let mut writer =
                BurstWriter::create(&path, format, size, sensor.max_count(), overwrite)?;
            kept.counts.iter().try_for_each(|counts| writer.push(counts))?;
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
                .map_err(|e| Fault::new(e, path.display(), "report this as a bug"))?;
            writer.finish(&bytes, overwrite)?;
        }
        let mut acquisition = Acquisition {
            seed: exposing.seed,
            first_frame: 0,
            ppp: summary.light.ppp,
            exposure: USUAL_EXPOSURE,
            sensor: sensor.clone(),
            gain: summary.gain,
            dark: None,
        };
        acquisition.exposure = if let Some(exposure) = args.exposure {
            exposure
        } else {
            let read = |frame: u64| Ok(kept.counts[frame as usize].clone());
            fitting_exposure(size, kept.counts.len() as u64, &acquisition, read)?
        };
        let motion = if kept.flow.is_empty() {
            let estimate = || {
                let pairs = kept.truth.windows(2);
                Rc::new(pairs.map(|pair| estimate_flow(&pair[0], &pair[1])).collect())
            };
            Motion::Estimated(Rc::clone(self.estimated_flow.get_or_init(estimate)))
        } else {
            Motion::True(std::mem::take(&mut kept.flow))
        };
        Ok(ExposedClip { name: self.name.clone(), size, ppp, seed, kept, motion, acquisition })
    }
}

/// From each frame of the truth to the next.
enum Motion {
    /// Known, since the scene is synthetic.
    True(Vec<Flow>),
    /// Found in the clean frames.
    Estimated(Rc<Vec<Flow>>),
}

/// Name of a clip at a light level, as in `dog-ppp9_75`: no dot, so that a folder may have it.
fn burst_name(clip: &str, ppp: f64) -> String {
    format!("{clip}-ppp{}", ppp.to_string().replace('.', "_"))
}

/// Name of a clip: a file's without its extension, a folder's as it is, dots and all.
pub(crate) fn stem(path: &Path) -> String {
    if path.is_dir() {
        return full_name(path);
    }
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Names of clips: of files without the extension, of folders in full, since `run.1` and `run.2` are two clips. Files
/// that differ in the extension alone keep it.
fn clip_names(clips: &[PathBuf]) -> Vec<String> {
    let names: Vec<String> = clips.iter().map(|path| stem(path)).collect();
    let is_unique = |name: &String| names.iter().filter(|other| *other == name).count() == 1;
    let name = |(path, name): (&PathBuf, &String)| {
        if is_unique(name) { name.clone() } else { full_name(path) }
    };
    clips.iter().zip(&names).map(name).collect()
}

fn full_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// FNV-1a: the seed of a clip must not depend on what else lies beside it.
fn name_digest(name: &str) -> u32 {
    name.bytes().fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}

/// Photons and truth of a clip.
#[derive(Default)]
struct Kept {
    counts: Vec<Vec<u16>>,
    truth: Vec<Frame>,
    /// From each frame to the next, where the scene is synthetic.
    flow: Vec<Flow>,
}

impl Sink for Kept {
    fn start(&mut self, _: Start) -> qudi_core::Result<()> {
        Ok(())
    }

    fn frame(
        &mut self,
        exposed: Exposed<'_>,
        flow: &dyn Fn() -> Option<Flow>,
    ) -> qudi_core::Result<()> {
        self.counts.push(exposed.counts.to_vec());
        self.truth.push(exposed.truth.clone());
        self.flow.extend(flow());
        Ok(())
    }
}

/// A clip exposed at one light level.
pub(crate) struct ExposedClip {
    name: String,
    size: Size,
    ppp: f64,
    seed: u64,
    kept: Kept,
    motion: Motion,
    acquisition: Acquisition,
}

impl ExposedClip {
    pub(crate) fn score_method(&self, name: &str, args: &Eval) -> Result<Score> {
        let sensor = &self.acquisition.sensor;
        let mut capture =
            Capture::in_memory(&self.name, self.size, self.kept.counts.clone(), sensor)?;
        let peak = Peak::start();
        let start = Instant::now();
        let (mut restorer, how) = method(name, &mut capture, &self.acquisition, &args.network)?;
        let windows = Windows::new(capture.frames(), restorer.window() as u64, args.overlap)?;
        let mut sink = Collected::default();
        let all = 0..capture.frames();
        run_method(
            restorer.as_mut(),
            &mut capture,
            &windows,
            all,
            &self.acquisition,
            &mut sink,
            &mut |_, _| interrupt::check(),
        )?;
        let cost = Cost {
            seconds_per_frame: start.elapsed().as_secs_f64() / sink.0.len() as f64,
            peak_mib: peak.grown_mib(),
        };
        self.score(&sink.0, Some(cost), how)
    }

    /// The protocol of QUIVER's public code, seeded: every window of 11 frames, one frame apart, is
    /// exposed anew with its own mean at `ppp`, and its middle frame judged.
    pub(crate) fn score_windows(&self, name: &str, args: &Eval) -> Result<Score> {
        const WINDOW: usize = 11;
        let truth = &self.kept.truth;
        if truth.len() < WINDOW {
            return Err(Fault::new(
                format!("{} frames, where a window has {WINDOW}", truth.len()),
                &self.name,
                "use longer clips, or --protocol strict",
            ));
        }
        let sensor = &self.acquisition.sensor;
        let (mut frames, mut middles) = (Vec::new(), Vec::new());
        let (mut seconds, mut highest, mut how) = (0.0, None::<f64>, String::new());
        let windows = truth.len() - WINDOW + 1;
        for first in 0..windows {
            if interrupt::check().is_break() {
                return Err(Fault::Interrupted);
            }
            let scene = &truth[first..first + WINDOW];
            let mean = scene.iter().map(Frame::mean).sum::<f64>() / WINDOW as f64;
            let light = Light { ppp: self.acquisition.ppp, exposure: mean.max(1e-4) };
            let seed = self.seed.wrapping_add(first as u64);
            let mut camera = Camera::new(sensor, self.size, light, seed)?;
            let mut counts = Vec::with_capacity(WINDOW);
            for (t, frame) in scene.iter().enumerate() {
                counts.push(camera.expose(t as u64, &[frame])?);
            }
            let acquisition = Acquisition { gain: camera.gain(), ..self.acquisition.clone() };
            let peak = Peak::start();
            let start = Instant::now();
            let mut capture = Capture::in_memory(&self.name, self.size, counts.clone(), sensor)?;
            let (mut restorer, chosen) = method(name, &mut capture, &acquisition, &args.network)?;
            how = chosen;
            let burst = BurstView { size: self.size, frames: &counts };
            let restored = restorer.restore(burst, &acquisition)?.frames.swap_remove(WINDOW / 2);
            seconds += start.elapsed().as_secs_f64();
            highest = [highest, peak.grown_mib()].into_iter().flatten().reduce(f64::max);
            frames.push(self.score_frame(&restored, &scene[WINDOW / 2])?);
            middles.push(restored);
        }
        let middle = windows / 2;
        let picture = aligned(&middles[middle], &truth[middle + WINDOW / 2]);
        Ok(Score {
            clip: self.name.clone(),
            frames,
            chi_square: None,
            flicker: None,
            flow: None,
            seconds_per_frame: Some(seconds / (windows * WINDOW) as f64),
            peak_mib: highest,
            picture,
            how,
        })
    }

    fn score_frame(&self, image: &Frame, truth: &Frame) -> Result<FrameScore> {
        let small = || {
            Fault::new(
                format!("frames of {} are smaller than SSIM's window of 11 x 11", self.size),
                &self.name,
                "use larger frames",
            )
        };
        Ok(FrameScore {
            psnr_a: Some(gain_aligned_psnr(image, truth)),
            psnr: Some(psnr(image, truth)),
            ssim: Some(ssim(image, truth).ok_or_else(small)?),
            ssim_g: Some(gaussian_ssim(image, truth).ok_or_else(small)?),
            chi_square: None,
        })
    }

    /// Frames that another program made of the exported photons.
    pub(crate) fn score_external(&self, external: &External) -> Result<Score> {
        let name = burst_name(&self.name, self.ppp);
        let array = external.folder.join(format!("{name}.npy"));
        let (place, frames) = if array.is_file() {
            let frames = read_clip(&array, usize::MAX)?;
            (array, frames)
        } else {
            let place = external.folder.join(name);
            let input = Input::parse(&place.display().to_string(), None, None, 1, 0.0)?;
            let mut source = input.open(&Sampling::default())?;
            let mut frames = Vec::new();
            while let Some(exposure) = source.next()? {
                frames.push(exposure.truth().clone());
            }
            (place, frames)
        };
        let expected = self.kept.truth.len();
        if frames.len() != expected || frames.iter().any(|frame| frame.size != self.size) {
            return Err(Fault::new(
                format!(
                    "{} frames, where {expected} of {} are to be scored",
                    frames.len(),
                    self.size
                ),
                place.display(),
                "restore every frame of the burst that --export-photons wrote",
            ));
        }
        self.score(&frames, None, " (another program)".to_owned())
    }

    fn score(&self, restored: &[Frame], cost: Option<Cost>, how: String) -> Result<Score> {
        let mut consistency = Consistency::new(self.size, &self.acquisition);
        let mut frames = Vec::with_capacity(restored.len());
        for ((image, truth), counts) in restored.iter().zip(&self.kept.truth).zip(&self.kept.counts)
        {
            let chi_square = Some(consistency.add(image, counts, &self.acquisition)?);
            frames.push(FrameScore { chi_square, ..self.score_frame(image, truth)? });
        }
        Ok(Score {
            clip: self.name.clone(),
            frames,
            chi_square: consistency.chi_square(),
            flicker: self.flicker(restored),
            flow: match &self.motion {
                _ if restored.len() < 2 => None,
                Motion::True(_) => Some(FlowKind::True),
                Motion::Estimated(_) => Some(FlowKind::Estimated),
            },
            seconds_per_frame: cost.map(|cost| cost.seconds_per_frame),
            peak_mib: cost.and_then(|cost| cost.peak_mib),
            picture: aligned(&restored[restored.len() / 2], &self.kept.truth[restored.len() / 2]),
            how,
        })
    }
}

impl ExposedClip {
    /// What the middle frame looks like, and what was seen of it.
    pub(crate) fn pictures(&self) -> Pictures {
        let middle = self.kept.truth.len() / 2;
        let full = f32::from(self.acquisition.sensor.max_count());
        let counts = self.kept.counts[middle].iter().map(|&count| f32::from(count) / full);
        let counts = Frame { size: self.size, data: counts.collect() };
        let truth = self.kept.truth[middle].clone();
        Pictures::new(self.name.clone(), self.ppp, counts, Some(truth))
    }

    fn flicker(&self, restored: &[Frame]) -> Option<f64> {
        let mut excess = Vec::new();
        let flow = match &self.motion {
            Motion::True(flow) => flow,
            Motion::Estimated(flow) => flow.as_ref(),
        };
        for (t, flow) in flow.iter().enumerate() {
            let truth = &self.kept.truth;
            // One gain for both frames: flicker of brightness counts.
            let gain = best_gain(&restored[t], &truth[t]);
            let own = warping_error(&truth[t], &truth[t + 1], flow)?;
            excess.push(
                warping_error(&scaled(&restored[t], gain), &scaled(&restored[t + 1], gain), flow)?
                    - own,
            );
        }
        let n = excess.len() as f64;
        (n > 0.0).then(|| (excess.iter().sum::<f64>() / n).max(0.0).sqrt())
    }
}

#[derive(Default)]
struct Collected(Vec<Frame>);

impl RestoreSink for Collected {
    fn frame(&mut self, _: u64, restored: &Frame, _: &[u16]) -> qudi_core::Result<()> {
        self.0.push(restored.clone());
        Ok(())
    }
}

/// A restored frame after the gain that brings it closest to the truth.
fn aligned(image: &Frame, truth: &Frame) -> Frame {
    scaled(image, best_gain(image, truth))
}

fn scaled(image: &Frame, gain: f64) -> Frame {
    let data = image.data.iter().map(|v| (v * gain as f32).clamp(0.0, 1.0)).collect();
    Frame { size: image.size, data }
}
