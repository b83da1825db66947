//! One clip, exposed at one light level, scored for every method.

use super::args::External;
use super::external::ExternalFrames;
use super::html::Pictures;
use super::metrics::{Compared, aligned, scaled};
use super::perceptual::Perceptual;
use super::plan::{Contender, Plan};
use super::score::{Added, Cost, FlowKind, FrameScore, Score};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::memory::PeakMemory;
use crate::report::middle::cut;
use crate::report::player::counts_frame;
use qudi_burst::motion::warping_error;
use qudi_core::flow::Flow;
use qudi_core::metrics::{Consistency, OCTAVES, best_gain, octave_energies};
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::windows::Windows;
use qudi_core::{Camera, Frame, Light, Size};
use qudi_io::capture::Capture;
use qudi_io::restore::{RestoreSink, Schedule, run as run_method};
use qudi_sim::{Exposed, Sink, Start};
use std::ops::Range;
use std::rc::Rc;
use std::time::Instant;

/// From each frame of the truth to the next.
pub(super) enum Motion {
    /// Known, since the scene is synthetic.
    True(Vec<Flow>),
    /// Found in the clean frames.
    Estimated(Rc<Vec<Flow>>),
}

/// Returns the name of a clip at a light level, as in `dog-ppp9_75`: no dot, so that a folder may have it.
pub(super) fn burst_name(clip: &str, ppp: f64) -> String {
    format!("{clip}-ppp{}", ppp.to_string().replace('.', "_"))
}

/// Photons and truth of a clip.
#[derive(Default)]
pub(super) struct Photons {
    pub(super) counts: Vec<Vec<u16>>,
    pub(super) truth: Vec<Frame>,
    /// From each frame to the next, where the scene is synthetic.
    pub(super) flow: Vec<Flow>,
}

impl Sink for Photons {
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
pub(super) struct ExposedClip {
    pub(super) name: String,
    pub(super) size: Size,
    pub(super) ppp: f64,
    pub(super) seed: u64,
    pub(super) photons: Photons,
    pub(super) motion: Motion,
    pub(super) acquisition: Acquisition,
    pub(super) perceptual: Option<Rc<Perceptual>>,
    /// True if appearance is measured.
    pub(super) appearance: bool,
    /// What makes the clip doubtful.
    pub(super) notes: Vec<String>,
    /// Frames that the page shows.
    pub(super) shown: Range<usize>,
}

impl ExposedClip {
    /// Scores a method, and returns its frames. `fewest` are the frames of the fewest steps, if there
    /// are any.
    pub(super) fn score_method(
        &self,
        contender: &Contender,
        plan: &Plan,
        fewest: Option<&[Frame]>,
    ) -> Result<(Score, Vec<Frame>)> {
        let sensor = &self.acquisition.sensor;
        let mut capture =
            Capture::in_memory(&self.name, self.size, self.photons.counts.clone(), sensor)?;
        let peak = PeakMemory::start();
        let start = Instant::now();
        let Contender { method, network, .. } = contender;
        let (mut restorer, how) = method.restorer(&mut capture, &self.acquisition, network)?;
        let windows = Windows::of(restorer.as_ref(), capture.frames(), plan.overlap)?;
        let mut sink = Collected::default();
        let all = 0..capture.frames();
        run_method(
            restorer.as_mut(),
            &mut capture,
            &Schedule::all(windows),
            all,
            &self.acquisition,
            &mut sink,
            &mut |_, _| interrupt::check(),
        )?;
        let cost = Cost {
            seconds_per_frame: start.elapsed().as_secs_f64() / sink.frames.len() as f64,
            peak_mib: peak.grown_mib(),
        };
        let mut score = self.score(&sink.frames, &sink.sigmas, Some(cost), how)?;
        if self.appearance {
            score.added = fewest.and_then(|fewest| self.added(&sink.frames, fewest));
        }
        Ok((score, sink.frames))
    }

    /// Scores a method under the protocol of QUIVER's public code, seeded: every window of 11 frames, one
    /// frame apart, is exposed anew with its own mean at `ppp`, and its middle frame scored.
    pub(super) fn score_windows(&self, contender: &Contender) -> Result<Score> {
        const WINDOW: usize = 11;
        let truth = &self.photons.truth;
        if truth.len() < WINDOW {
            return Err(CliError::new(
                format!("{} frames, where a window has {WINDOW}", truth.len()),
                &self.name,
                "use longer clips, or --protocol strict",
            ));
        }
        let sensor = &self.acquisition.sensor;
        let (mut frames, mut middles) = (Vec::new(), Vec::new());
        let (mut seconds, mut highest, mut how) = (0.0, None::<f64>, String::new());
        let windows = truth.len() - WINDOW + 1;
        // Networks choose nothing for a window: their weights are read once.
        let mut loaded = None;
        for first in 0..windows {
            if interrupt::check().is_break() {
                return Err(CliError::Interrupted);
            }
            let scene = &truth[first..first + WINDOW];
            let mean = scene.iter().map(Frame::mean).sum::<f64>() / WINDOW as f64;
            let light = Light { ppp: self.acquisition.ppp, mean_level: mean.max(1e-4) };
            let seed = self.seed.wrapping_add(first as u64);
            let mut camera = Camera::new(sensor, self.size, light, seed)?;
            let mut counts = Vec::with_capacity(WINDOW);
            for (t, frame) in scene.iter().enumerate() {
                counts.push(camera.expose(t as u64, &[frame])?);
            }
            let acquisition = Acquisition { gain: camera.gain(), ..self.acquisition.clone() };
            let peak = PeakMemory::start();
            let start = Instant::now();
            let mut capture = Capture::in_memory(&self.name, self.size, counts.clone(), sensor)?;
            let Contender { method, network, .. } = contender;
            let (mut restorer, chosen) = match loaded.take() {
                Some(loaded) => loaded,
                None => method.restorer(&mut capture, &acquisition, network)?,
            };
            how.clone_from(&chosen);
            let burst = BurstView { size: self.size, frames: &counts };
            let restored = restorer.restore(burst, &acquisition)?.frames.swap_remove(WINDOW / 2);
            seconds += start.elapsed().as_secs_f64();
            loaded = method.is_network().then_some((restorer, chosen));
            highest = [highest, peak.grown_mib()].into_iter().flatten().reduce(f64::max);
            frames.push(FrameScore::of(&self.compared(&restored, &scene[WINDOW / 2]))?);
            middles.push(restored);
        }
        // The first window's middle frame is the sixth.
        let shown = self
            .shown
            .clone()
            .filter_map(|t| Some((middles.get(t.checked_sub(WINDOW / 2)?)?, &truth[t])));
        let pictures = shown.map(|(image, truth)| cut(&aligned(image, truth))).collect();
        Ok(Score {
            clip: self.name.clone(),
            frames,
            chi_square: None,
            flicker: None,
            flow: None,
            added: None,
            range: None,
            seconds_per_frame: Some(seconds / (windows * WINDOW) as f64),
            peak_mib: highest,
            pictures,
            how,
        })
    }

    /// Compares a restored frame with the truth.
    fn compared<'a>(&'a self, image: &'a Frame, truth: &'a Frame) -> Compared<'a> {
        Compared {
            perceptual: self.perceptual.as_deref(),
            appearance: self.appearance,
            ..Compared::new(image, truth, &self.name)
        }
    }

    /// Scores frames that another program made of the exported photons.
    pub(super) fn score_external(&self, external: &External) -> Result<Score> {
        let ExternalFrames { frames, place, range: [low, high] } =
            ExternalFrames::read(external, &self.name, self.ppp)?;
        let expected = self.photons.truth.len();
        if frames.len() != expected || frames.iter().any(|frame| frame.size != self.size) {
            return Err(CliError::new(
                format!(
                    "{} frames, where {expected} of {} are to be scored",
                    frames.len(),
                    self.size
                ),
                place.display(),
                "restore every frame of the burst that --export-photons wrote",
            ));
        }
        let how = format!(" (another program, values from {low:.3} to {high:.3})");
        Ok(Score { range: Some([low, high]), ..self.score(&frames, &[], None, how)? })
    }

    /// Scores all frames; `sigmas` are their predicted standard deviations, if there are any.
    fn score(
        &self,
        restored: &[Frame],
        sigmas: &[Frame],
        cost: Option<Cost>,
        how: String,
    ) -> Result<Score> {
        let mut consistency = Consistency::new(self.size, &self.acquisition);
        let mut frames = Vec::with_capacity(restored.len());
        let pairs = self.photons.truth.iter().zip(&self.photons.counts);
        for (t, (image, (truth, counts))) in restored.iter().zip(pairs).enumerate() {
            let chi_square = Some(consistency.add(image, counts, &self.acquisition)?);
            let compared =
                self.compared(image, truth).with_sigma(sigmas.get(t).filter(|_| self.appearance));
            frames.push(FrameScore::of(&Compared { chi_square, ..compared })?);
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
            added: None,
            range: None,
            seconds_per_frame: cost.map(|cost| cost.seconds_per_frame),
            peak_mib: cost.and_then(|cost| cost.peak_mib),
            pictures: self
                .shown
                .clone()
                .map(|t| cut(&aligned(&restored[t], &self.photons.truth[t])))
                .collect(),
            how,
        })
    }
}

impl ExposedClip {
    /// Selects at most `frames` frames around the middle for the page, and returns their truth and counts as
    /// its pictures.
    pub(super) fn show(&mut self, frames: usize) -> Pictures {
        let all = self.photons.truth.len();
        let frames = frames.min(all);
        let first = (all / 2).saturating_sub(frames / 2).min(all - frames);
        self.shown = first..first + frames;
        let full = self.acquisition.sensor.max_count();
        let counts = self.photons.counts[self.shown.clone()].iter();
        let counts: Vec<Frame> =
            counts.map(|counts| counts_frame(self.size, counts, full)).collect();
        let truth = self.photons.truth[self.shown.clone()].iter();
        let numbers = (first as u64..).take(frames).collect();
        Pictures::new(self.name.clone(), self.ppp, numbers, &counts)
            .with_truth(&truth.cloned().collect::<Vec<_>>())
    }

    /// Measures what was added to the frames of the fewest steps, and what the latter missed.
    fn added(&self, restored: &[Frame], fewest: &[Frame]) -> Option<Added> {
        let (mut added, mut missed) = ([0.0; OCTAVES], [0.0; OCTAVES]);
        for ((image, base), truth) in restored.iter().zip(fewest).zip(&self.photons.truth) {
            let (image, base) = (aligned(image, truth), aligned(base, truth));
            for (sum, other) in [(&mut added, &image), (&mut missed, truth)] {
                let pairs = other.data.iter().zip(&base.data);
                let data = pairs.map(|(a, b)| a - b).collect();
                let energies = octave_energies(&Frame { size: self.size, data })?;
                sum.iter_mut().zip(energies).for_each(|(sum, energy)| *sum += energy);
            }
        }
        let root = |sums: [f64; OCTAVES]| sums.map(|sum| (sum / restored.len() as f64).sqrt());
        Some(Added { added: root(added), missed: root(missed) })
    }

    fn flicker(&self, restored: &[Frame]) -> Option<f64> {
        let mut excess = Vec::new();
        let flow = match &self.motion {
            Motion::True(flow) => flow,
            Motion::Estimated(flow) => flow.as_ref(),
        };
        for (t, flow) in flow.iter().enumerate() {
            let truth = &self.photons.truth;
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

/// Restored frames.
#[derive(Default)]
struct Collected {
    frames: Vec<Frame>,
    /// Their predicted sigma, where it predicts it.
    sigmas: Vec<Frame>,
}

impl RestoreSink for Collected {
    fn frame(&mut self, _: u64, restored: &Frame, _: &[u16]) -> qudi_core::Result<()> {
        self.frames.push(restored.clone());
        Ok(())
    }

    fn uncertainty(&mut self, _: u64, uncertainty: &Frame) -> qudi_core::Result<()> {
        self.sigmas.push(uncertainty.clone());
        Ok(())
    }
}
