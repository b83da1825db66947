//! Figures of methods: of a frame, of a clip, of all clips. What needs a truth is absent without one.

use super::appearance::Appearance;
use qudi_core::Frame;
use qudi_core::metrics::{OCTAVES, Statistics};
use serde::Serialize;

/// Figures of one frame.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(crate) struct FrameScore {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) psnr_a: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) psnr: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) ssim: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) ssim_g: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) lpips_alex: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) lpips_vgg: Option<f64>,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub(crate) appearance: Option<Appearance>,
    /// Root mean square of errors over that of their predicted sigma.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) error_over_sigma: Option<f64>,
    /// The same in the flattest quarter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) error_over_sigma_flat: Option<f64>,
    /// The same in the most textured quarter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) error_over_sigma_textured: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) chi_square: Option<f64>,
}

/// A figure of a frame.
pub(crate) type Figure = fn(&FrameScore) -> Option<f64>;

/// How a figure is called, and shown.
pub(crate) struct Named {
    pub(crate) key: &'static str,
    pub(crate) title: &'static str,
    pub(crate) figure: Figure,
    /// Digits after the point in tables.
    pub(crate) digits: usize,
}

const fn named(key: &'static str, title: &'static str, figure: Figure, digits: usize) -> Named {
    Named { key, title, figure, digits }
}

/// How frames look, in the order in which it is shown.
pub(crate) const LOOKS: [Named; 10] = [
    named("lpips_alex", "lpips-alex", |f| f.lpips_alex, 3),
    named("lpips_vgg", "lpips-vgg", |f| f.lpips_vgg, 3),
    named("gmsd", "gmsd", |f| f.appearance.map(|a| a.gmsd), 4),
    named("ssimulacra2", "ssimulacra2", |f| f.appearance.map(|a| a.ssimulacra2), 2),
    named("butteraugli", "butteraugli", |f| f.appearance.map(|a| a.butteraugli), 2),
    named("detail_flat", "detail flat", |f| f.appearance?.detail_flat, 2),
    named("detail_textured", "detail textured", |f| f.appearance?.detail_textured, 2),
    named("error_over_sigma", "error/sigma", |f| f.error_over_sigma, 2),
    named("error_over_sigma_flat", "flat", |f| f.error_over_sigma_flat, 2),
    named("error_over_sigma_textured", "textured", |f| f.error_over_sigma_textured, 2),
];

/// What a number of diffusion steps added to the result of the fewest ones, and what that one missed: root mean
/// squares of a pixel in every octave, finest first.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(crate) struct Added {
    pub(crate) added: [f64; OCTAVES],
    pub(crate) missed: [f64; OCTAVES],
}

/// What a method took.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cost {
    pub(crate) seconds_per_frame: f64,
    /// Peak of resident memory above what was held before, where the system tells.
    pub(crate) peak_mib: Option<f64>,
}

/// Where the flow that flicker is measured along comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum FlowKind {
    /// The scene is synthetic.
    True,
    /// Estimated on the truth's own frames.
    Estimated,
}

/// Figures of one method on one clip.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Score {
    pub(crate) clip: String,
    pub(crate) frames: Vec<FrameScore>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) chi_square: Option<f64>,
    /// Root mean square change along the flow beyond the truth's own, after the best gain.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) flicker: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) flow: Option<FlowKind>,
    /// What its steps added, where fewer were evaluated beside them.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub(crate) added: Option<Added>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) seconds_per_frame: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) peak_mib: Option<f64>,
    /// The middle frame; after the best gain where there is a truth.
    #[serde(skip)]
    pub(crate) picture: Frame,
    /// How the method made it, after its name: ` over 5 frames`, ` (regression) on cpu`.
    #[serde(skip)]
    pub(crate) how: String,
}

/// All scores of one method at one light level.
pub(crate) struct Row {
    pub(crate) method: String,
    /// Its weights, if it is a learned method of others that was trained here: their size, and the steps.
    pub(crate) trained: Option<String>,
    /// Its diffusion steps, where several numbers of them are compared.
    pub(crate) steps: Option<usize>,
    pub(crate) ppp: f64,
    /// Why it was not run, if it was not.
    pub(crate) refused: Option<String>,
    /// One per clip.
    pub(crate) scores: Vec<Score>,
}

impl Row {
    /// The row of a method without weights of its own, without scores.
    pub(crate) fn new(method: String, ppp: f64) -> Self {
        Self { method, trained: None, steps: None, ppp, refused: None, scores: Vec::new() }
    }

    /// The method, and its steps where they are compared.
    pub(crate) fn label(&self) -> String {
        let method = &self.method;
        match self.steps {
            None => method.clone(),
            Some(1) => format!("{method}, 1 step"),
            Some(steps) => format!("{method}, {steps} steps"),
        }
    }

    /// The method, and what its weights are if they were trained here.
    pub(crate) fn name(&self) -> String {
        match &self.trained {
            Some(trained) => format!("{} (trained here: {trained})", self.method),
            None => self.method.clone(),
        }
    }

    /// Statistics over clips of the mean over each clip's frames.
    pub(crate) fn over_clips(&self, figure: Figure) -> Option<Statistics> {
        let mean = |score: &Score| {
            let values: Option<Vec<f64>> = score.frames.iter().map(figure).collect();
            Statistics::of(&values?).map(|statistics| statistics.mean)
        };
        self.statistics(mean)
    }

    /// Statistics over clips of the frame in the middle.
    pub(crate) fn centre(&self, figure: Figure) -> Option<Statistics> {
        self.statistics(|score| figure(score.frames.get(score.frames.len() / 2)?))
    }

    /// Statistics over all frames of all clips.
    pub(crate) fn over_frames(&self, figure: Figure) -> Option<Statistics> {
        let all: Option<Vec<f64>> =
            self.scores.iter().flat_map(|score| &score.frames).map(figure).collect();
        Statistics::of(&all?)
    }

    /// Mean over clips, where known.
    pub(crate) fn mean(&self, value: impl Fn(&Score) -> Option<f64>) -> Option<f64> {
        self.statistics(value).map(|statistics| statistics.mean)
    }

    /// The highest memory peak over clips, in MiB.
    pub(crate) fn peak_mib(&self) -> Option<f64> {
        self.scores.iter().filter_map(|score| score.peak_mib).reduce(f64::max)
    }

    /// Means over clips of what its steps added in every octave, over what the fewest ones missed there.
    pub(crate) fn added(&self) -> Option<[f64; OCTAVES]> {
        let all: Option<Vec<Added>> = self.scores.iter().map(|score| score.added).collect();
        let all = all.filter(|all| !all.is_empty())?;
        let sum = |of: fn(&Added) -> &[f64; OCTAVES], i: usize| -> f64 {
            all.iter().map(|one| of(one)[i].powi(2)).sum()
        };
        Some(std::array::from_fn(|i| (sum(|a| &a.added, i) / sum(|a| &a.missed, i)).sqrt()))
    }

    /// The flow that flicker was measured along.
    pub(crate) fn flow(&self) -> Option<FlowKind> {
        self.scores.first().and_then(|score| score.flow)
    }

    fn statistics(&self, value: impl Fn(&Score) -> Option<f64>) -> Option<Statistics> {
        let known: Option<Vec<f64>> = self.scores.iter().map(value).collect();
        Statistics::of(&known?)
    }
}
