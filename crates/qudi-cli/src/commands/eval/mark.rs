//! Frames whose scores say little of a method, and are named.

use super::metrics::Compared;
use super::score::{Row, Score};
use qudi_core::metrics::{MAX_PSNR, gain_aligned_psnr};

/// Frames of one kind that are listed by number.
const MAX_LISTED: usize = 5;

/// What is special about a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mark {
    /// The truth is black: no exposure follows from it, and means leave it out.
    Black,
    /// The restored frame is the truth, but for its exposure: it counts [`MAX_PSNR`].
    Equal,
}

impl Mark {
    /// Returns the mark of a restored frame.
    pub(super) fn of(compared: &Compared<'_>) -> Option<Self> {
        if compared.truth.data.iter().all(|value| *value <= 0.0) {
            return Some(Self::Black);
        }
        let is_equal = gain_aligned_psnr(compared.image, compared.truth) >= MAX_PSNR;
        is_equal.then_some(Self::Equal)
    }

    /// Returns the mark of a name.
    pub(crate) fn by_name(name: &str) -> Option<Self> {
        [Self::Black, Self::Equal].into_iter().find(|mark| mark.name() == name)
    }

    /// Returns its name in CSV and JSON.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Black => "black",
            Self::Equal => "equal",
        }
    }
}

/// Describes all marked frames, a sentence each.
pub(super) fn remarks(rows: &[Row]) -> Vec<String> {
    let mut remarks = Vec::new();
    // The truth is the same for all methods and light levels.
    if let Some(row) = rows.iter().find(|row| !row.scores.is_empty()) {
        for (count, list) in row.scores.iter().filter_map(|score| marked(score, Mark::Black)) {
            remarks.push(format!(
                "black frames of the truth of {list}, {count} in all, are left out of all means"
            ));
        }
    }
    for row in rows {
        for (count, list) in row.scores.iter().filter_map(|score| marked(score, Mark::Equal)) {
            remarks.push(format!(
                "frames of {} at {} PPP that equal the truth, {count} in all, count {MAX_PSNR} dB: {list}",
                row.label(),
                row.ppp
            ));
        }
    }
    remarks
}

/// Returns how many frames of a clip have a mark, with the clip's name and their numbers.
fn marked(score: &Score, mark: Mark) -> Option<(usize, String)> {
    let numbers = score.frames.iter().enumerate().filter(|(_, frame)| frame.mark == Some(mark));
    let numbers: Vec<String> = numbers.map(|(number, _)| number.to_string()).collect();
    let shown = numbers.iter().take(MAX_LISTED).map(String::as_str).collect::<Vec<_>>().join(", ");
    let more = if numbers.len() > MAX_LISTED { ", ..." } else { "" };
    (!numbers.is_empty()).then(|| (numbers.len(), format!("{} ({shown}{more})", score.clip)))
}
