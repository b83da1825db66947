//! What was found out about single frames of a capture.

use serde::Serialize;

/// Frames of one kind that are listed by number.
const MAX_LISTED: usize = 5;

/// Frames that are not like the others, by number, and changes of the scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FrameFindings {
    /// Frames that were looked at.
    pub looked_at: u64,
    /// Frames without a count.
    pub empty: Vec<u64>,
    /// Frames whose pixels nearly all have the largest value.
    pub saturated: Vec<u64>,
    /// Frames far darker or brighter than those before and after.
    pub outlying: Vec<u64>,
    /// Frames that repeat the one before.
    pub repeated: Vec<u64>,
    /// First frames after missing numbers.
    pub missing: Vec<u64>,
    /// How often every frame is stored, if more than once.
    pub stored_times: Option<u64>,
    /// Ratio of the light of every other frame to the light of the rest, if exposures take turns.
    pub alternates: Option<f64>,
    /// First frames of another scene.
    pub cuts: Vec<u64>,
    /// First frames of another light.
    pub light_steps: Vec<u64>,
}

impl FrameFindings {
    /// Returns the frames for which others stand in, in rising order.
    pub(super) fn replaced(&self) -> Vec<u64> {
        let all = [&self.empty, &self.saturated, &self.outlying];
        let mut frames: Vec<u64> = all.into_iter().flatten().copied().collect();
        frames.sort_unstable();
        frames.dedup();
        frames
    }

    /// Gives the frames other numbers; several may get the same one.
    pub(super) fn renumber(&mut self, number: impl Fn(u64) -> u64) {
        let lists = [&mut self.empty, &mut self.saturated, &mut self.outlying, &mut self.repeated];
        let others = [&mut self.cuts, &mut self.light_steps, &mut self.missing];
        for frames in lists.into_iter().chain(others) {
            for frame in frames.iter_mut() {
                *frame = number(*frame);
            }
            frames.dedup();
        }
    }

    /// Describes what was found, a sentence each; `replaced` is true if others stand in for broken frames.
    pub(super) fn notes(&self, replaced: bool) -> Vec<String> {
        let mut notes = Vec::new();
        let mut note = |frames: &[u64], what: &str, effect: &str| {
            if !frames.is_empty() {
                notes.push(format!("{what}: {}{effect}", list(frames)));
            }
        };
        let effect = if replaced {
            "; a good neighbour stands in for each"
        } else {
            "; too many to be exceptions, so that they are read as they are"
        };
        note(&self.empty, "empty frames", effect);
        note(&self.saturated, "frames at one value", effect);
        note(&self.outlying, "frames far from the light of their neighbours", effect);
        note(&self.repeated, "frames that repeat the one before", "");
        let effect = "; nothing is summed, aligned or merged across them";
        note(&self.cuts, "cuts to another scene at frames", effect);
        note(&self.light_steps, "steps of the light at frames", effect);
        if let Some(ratio) = self.alternates {
            notes.push(format!(
                "every other frame is {ratio:.1} times as light as the rest, as if exposures took turns: frames of one exposure belong together"
            ));
        }
        if let Some(times) = self.stored_times {
            notes.push(format!("every frame is stored {times} times: each is read once"));
        }
        notes
    }
}

fn list(frames: &[u64]) -> String {
    let shown = frames.iter().take(MAX_LISTED).map(u64::to_string).collect::<Vec<_>>().join(", ");
    if frames.len() > MAX_LISTED {
        format!("{shown}, ... ({} in all)", frames.len())
    } else {
        shown
    }
}
