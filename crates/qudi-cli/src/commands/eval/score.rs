//! Figures of methods: of a frame, of a clip, of all clips. What needs a truth is absent without one.

use super::appearance::Appearance;
use qudi_core::Frame;
use qudi_core::metrics::Statistics;
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
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) chi_square: Option<f64>,
}

/// A figure of a frame.
pub(crate) type Figure = fn(&FrameScore) -> Option<f64>;

/// What a method took.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cost {
    pub(crate) seconds_per_frame: f64,
    /// PeakMemory resident memory above what was held before, where the system tells.
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
    pub(crate) ppp: f64,
    /// One per clip.
    pub(crate) scores: Vec<Score>,
}

impl Row {
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

    /// The flow that flicker was measured along.
    pub(crate) fn flow(&self) -> Option<FlowKind> {
        self.scores.first().and_then(|score| score.flow)
    }

    fn statistics(&self, value: impl Fn(&Score) -> Option<f64>) -> Option<Statistics> {
        let known: Option<Vec<f64>> = self.scores.iter().map(value).collect();
        Statistics::of(&known?)
    }
}
