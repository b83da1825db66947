//! Scores of methods: of a frame, of a clip, of all clips. Values that need a truth are absent without one.

use super::mark::Mark;
use super::metrics::{Compared, METRICS, Metric};
use crate::error::Result;
use qudi_core::Frame;
use qudi_core::metrics::{OCTAVES, Statistics};
use serde::ser::SerializeMap;
use serde::{Deserialize, Serialize, Serializer};
use serde_json::Value;

/// The values of one frame.
#[derive(Clone, Debug)]
pub(crate) struct FrameScore {
    /// In the order of [`METRICS`].
    values: Vec<Option<f64>>,
    pub(crate) mark: Option<Mark>,
}

impl FrameScore {
    /// Computes all metrics of a restored frame.
    pub(crate) fn of(compared: &Compared<'_>) -> Result<Self> {
        let values = METRICS.iter().map(|metric| (metric.value)(compared));
        Ok(Self { values: values.collect::<Result<_>>()?, mark: Mark::of(compared) })
    }

    /// Reads the values of a frame; none if they are no numbers.
    fn from_json(value: &Value) -> Option<Self> {
        let values = value.as_object()?;
        let mark = values.get("mark").and_then(Value::as_str);
        let values = METRICS.iter().map(|metric| values.get(metric.key).and_then(Value::as_f64));
        Some(Self { values: values.collect(), mark: mark.and_then(Mark::by_name) })
    }

    /// Takes some values; all others are unknown.
    pub(crate) fn of_values(values: &[(&Metric, f64)]) -> Self {
        let value = |metric: &Metric| values.iter().find(|(m, _)| m.key == metric.key);
        let values = METRICS.iter().map(|metric| value(metric).map(|(_, value)| *value));
        Self { values: values.collect(), mark: None }
    }

    /// Returns the value of a metric.
    pub(crate) fn get(&self, metric: &Metric) -> Option<f64> {
        let values = METRICS.iter().zip(&self.values);
        values.into_iter().find(|(m, _)| m.key == metric.key).and_then(|(_, value)| *value)
    }
}

impl Serialize for FrameScore {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let known = METRICS.iter().zip(&self.values).filter(|(_, value)| value.is_some());
        let mut map = serializer.serialize_map(None)?;
        for (metric, value) in known {
            map.serialize_entry(metric.key, value)?;
        }
        if let Some(mark) = self.mark {
            map.serialize_entry("mark", mark.name())?;
        }
        map.end()
    }
}

/// Energy that diffusion steps added to the result of the fewest ones, and energy that the latter missed:
/// root mean squares of a pixel in every octave, finest first.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(crate) struct Added {
    pub(crate) added: [f64; OCTAVES],
    pub(crate) missed: [f64; OCTAVES],
}

/// Cost of a method.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cost {
    pub(crate) seconds_per_frame: f64,
    /// Peak of resident memory above what was held before, where the system tells.
    pub(crate) peak_mib: Option<f64>,
}

/// Origin of the flow that flicker is measured along.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
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
    /// Energy that its steps added, where fewer ones were evaluated as well.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub(crate) added: Option<Added>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) seconds_per_frame: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) peak_mib: Option<f64>,
    /// Range of the values of frames that another program made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) range: Option<[f32; 2]>,
    /// Frames for the page, cut to what it shows; after the best gain where there is a truth.
    #[serde(skip)]
    pub(crate) pictures: Vec<Frame>,
    /// Text after the method's name: ` over 5 frames`, ` (regression) on cpu`.
    #[serde(skip)]
    pub(crate) how: String,
}

impl Score {
    /// Reads the figures of a clip as [`Serialize`] writes them; none if they are no such figures.
    pub(crate) fn from_json(value: &Value) -> Option<Self> {
        let frames = value["frames"].as_array()?.iter().map(FrameScore::from_json);
        let octaves = |key: &str| serde_json::from_value::<[f64; OCTAVES]>(value[key].clone()).ok();
        let added = octaves("added").zip(octaves("missed"));
        Some(Self {
            clip: value["clip"].as_str()?.to_owned(),
            frames: frames.collect::<Option<_>>()?,
            chi_square: value["chi_square"].as_f64(),
            flicker: value["flicker"].as_f64(),
            flow: serde_json::from_value(value["flow"].clone()).ok(),
            added: added.map(|(added, missed)| Added { added, missed }),
            seconds_per_frame: value["seconds_per_frame"].as_f64(),
            peak_mib: value["peak_mib"].as_f64(),
            range: serde_json::from_value(value["range"].clone()).ok(),
            pictures: Vec::new(),
            how: String::new(),
        })
    }

    /// Returns the frames whose truth is not black: a black one says nothing of a method.
    pub(crate) fn lit(&self) -> impl Iterator<Item = &FrameScore> {
        self.frames.iter().filter(|frame| frame.mark != Some(Mark::Black))
    }
}

/// All scores of one method at one light level.
pub(crate) struct Row {
    pub(crate) method: String,
    /// Its weights, if it is a learned method of others that was trained here: their size, and the steps.
    pub(crate) trained: Option<String>,
    /// Its diffusion steps, where several numbers of them are compared.
    pub(crate) steps: Option<usize>,
    pub(crate) ppp: f64,
    /// Reason why it was not run.
    pub(crate) refused: Option<String>,
    /// One per clip.
    pub(crate) scores: Vec<Score>,
}

impl Row {
    /// Makes the row of a method without weights, without scores.
    pub(crate) fn new(method: String, ppp: f64) -> Self {
        Self { method, trained: None, steps: None, ppp, refused: None, scores: Vec::new() }
    }

    /// Returns the method, with its steps where they are compared.
    pub(crate) fn label(&self) -> String {
        let method = &self.method;
        match self.steps {
            None => method.clone(),
            Some(1) => format!("{method}, 1 step"),
            Some(steps) => format!("{method}, {steps} steps"),
        }
    }

    /// Returns the method, with its weights if they were trained here.
    pub(crate) fn name(&self) -> String {
        match &self.trained {
            Some(trained) => format!("{} (trained here: {trained})", self.method),
            None => self.method.clone(),
        }
    }

    /// Returns statistics over clips of the mean over each clip's frames, black ones of the truth aside.
    pub(crate) fn over_clips(&self, metric: &Metric) -> Option<Statistics> {
        let mean = |score: &Score| {
            let values: Option<Vec<f64>> = score.lit().map(|frame| frame.get(metric)).collect();
            Statistics::of(&values?).map(|statistics| statistics.mean)
        };
        self.statistics(mean)
    }

    /// Returns statistics over clips of the frame in the middle.
    pub(crate) fn centre(&self, metric: &Metric) -> Option<Statistics> {
        self.statistics(|score| score.lit().nth(score.lit().count() / 2)?.get(metric))
    }

    /// Returns statistics over all frames of all clips.
    pub(crate) fn over_frames(&self, metric: &Metric) -> Option<Statistics> {
        let all = self.scores.iter().flat_map(Score::lit);
        let all: Option<Vec<f64>> = all.map(|frame| frame.get(metric)).collect();
        Statistics::of(&all?)
    }

    /// Returns the mean over clips, where known.
    pub(crate) fn mean(&self, value: impl Fn(&Score) -> Option<f64>) -> Option<f64> {
        self.statistics(value).map(|statistics| statistics.mean)
    }

    /// Returns the highest memory peak over clips, in MiB.
    pub(crate) fn peak_mib(&self) -> Option<f64> {
        self.scores.iter().filter_map(|score| score.peak_mib).reduce(f64::max)
    }

    /// Returns what its steps added in every octave over what the fewest ones missed there, for all clips.
    pub(crate) fn added(&self) -> Option<[f64; OCTAVES]> {
        let all: Option<Vec<Added>> = self.scores.iter().map(|score| score.added).collect();
        let all = all.filter(|all| !all.is_empty())?;
        let sum = |of: fn(&Added) -> &[f64; OCTAVES], i: usize| -> f64 {
            all.iter().map(|one| of(one)[i].powi(2)).sum()
        };
        Some(std::array::from_fn(|i| (sum(|a| &a.added, i) / sum(|a| &a.missed, i)).sqrt()))
    }

    /// Returns the origin of the flow that flicker was measured along.
    pub(crate) fn flow(&self) -> Option<FlowKind> {
        self.scores.first().and_then(|score| score.flow)
    }

    fn statistics(&self, value: impl Fn(&Score) -> Option<f64>) -> Option<Statistics> {
        let known: Option<Vec<f64>> = self.scores.iter().map(value).collect();
        Statistics::of(&known?)
    }
}
