//! Numbered files: names of another pattern are no frames, and missing numbers are named.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Files of the usual pattern, from which on others are strangers.
const MIN_FILES: usize = 3;

/// Missing frames of a gap across which nothing is known.
const LONG_GAP: u64 = 1 << 32;

/// Gaps that are listed.
const MAX_LISTED: usize = 4;

/// Returns the pattern of a name, in which `#` stands for numbers, and the last number.
fn pattern(path: &Path) -> (String, Option<(String, u64)>) {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let (mut pattern, mut last, mut before) = (String::new(), None, String::new());
    let mut rest = &*name;
    while let Some(start) = rest.find(|c: char| c.is_ascii_digit()) {
        let digits = rest[start..].len()
            - rest[start..].trim_start_matches(|c: char| c.is_ascii_digit()).len();
        let number = &rest[start..start + digits];
        pattern += &rest[..start];
        pattern.push('#');
        before += &rest[..start];
        last = number.parse().ok().map(|number| (before.clone(), number));
        before += number;
        rest = &rest[start + digits..];
    }
    (pattern + rest, last)
}

/// Files that belong together.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Numbered {
    pub(crate) files: Vec<PathBuf>,
    /// Notes on missing numbers, and on files that were skipped.
    pub(crate) notes: Vec<String>,
    /// Files before which numbers are missing, and how many.
    pub(crate) gaps: Vec<(usize, u64)>,
}

/// Drops files whose names are of another pattern than most.
pub(crate) fn numbered(files: Vec<PathBuf>) -> Numbered {
    let mut patterns: BTreeMap<String, usize> = BTreeMap::new();
    for file in &files {
        *patterns.entry(pattern(file).0).or_default() += 1;
    }
    let usual = patterns.iter().max_by_key(|(_, count)| **count);
    let Some((usual, count)) = usual.map(|(usual, count)| (usual.clone(), *count)) else {
        return Numbered { files, ..Numbered::default() };
    };
    if count < MIN_FILES || 2 * count <= files.len() || !usual.contains('#') {
        return Numbered { files, ..Numbered::default() };
    }
    let mut notes = Vec::new();
    let (kept, strangers): (Vec<_>, Vec<_>) =
        files.into_iter().partition(|file| pattern(file).0 == usual);
    let name = |file: &PathBuf| file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if let (Some(stranger), Some(first)) = (strangers.first(), kept.first()) {
        notes.push(format!(
            "{} files whose names are unlike {} were skipped, `{}` among them",
            strangers.len(),
            name(first),
            name(stranger)
        ));
    }
    let (note, gaps) = missing(&kept).unzip();
    notes.extend(note);
    Numbered { files: kept, notes, gaps: gaps.unwrap_or_default() }
}

/// Describes the numbers that are missing between the first and the last, and returns the files after them,
/// each with how many are missing.
fn missing(files: &[PathBuf]) -> Option<(String, Vec<(usize, u64)>)> {
    let numbers: Option<Vec<(String, u64)>> = files.iter().map(|file| pattern(file).1).collect();
    let numbers = numbers?;
    let before = &numbers.first()?.0;
    if numbers.iter().any(|(other, _)| other != before) {
        return sequences(&numbers);
    }
    let numbers: Vec<u64> = numbers.into_iter().map(|(_, number)| number).collect();
    let steps = || numbers.windows(2).map(|pair| pair[1].saturating_sub(pair[0]));
    let step = steps().min().filter(|&step| step > 0)?;
    let after = (1..numbers.len()).filter(|&n| numbers[n] - numbers[n - 1] > step);
    let after: Vec<usize> = after.collect();
    let gap = |&n: &usize| match (numbers[n - 1] + step, numbers[n] - step) {
        (first, last) if first == last => first.to_string(),
        (first, last) => format!("{first} to {last}"),
    };
    let gaps: Vec<String> = after.iter().map(gap).collect();
    // Numbers without any regularity have gaps everywhere.
    if gaps.is_empty() || gaps.len() > 1 && 4 * gaps.len() > numbers.len() {
        return None;
    }
    let more = if gaps.len() > MAX_LISTED { ", and more" } else { "" };
    let list = gaps[..gaps.len().min(MAX_LISTED)].join(", ");
    let missing = |n: usize| (numbers[n] - numbers[n - 1]) / step - 1;
    let after = after.into_iter().map(|n| (n, missing(n))).collect();
    Some((format!("numbers {list}{more} are missing: the scene jumps there"), after))
}

/// Describes sequences that follow each other, where all names of one have the same beginning, and returns
/// the first files of all but the first one: nothing is known of what lies between.
fn sequences(numbers: &[(String, u64)]) -> Option<(String, Vec<(usize, u64)>)> {
    let runs: Vec<_> = numbers.chunk_by(|(one, _), (other, _)| one == other).collect();
    let goes_on = |pair: &[&[(String, u64)]]| {
        pair[0].last().zip(pair[1].first()).is_some_and(|(last, first)| first.1 == last.1 + 1)
    };
    if runs.iter().any(|run| run.len() < MIN_FILES) || runs.windows(2).any(goes_on) {
        return None;
    }
    let firsts = runs.iter().scan(0, |at, run| {
        *at += run.len();
        Some((*at, LONG_GAP))
    });
    let note = format!(
        "names begin with {} to {}: {} sequences are read one after the other, and nothing is followed from one to the next; name a folder with one of them, if they are of several cameras",
        runs[0][0].0,
        runs[runs.len() - 1][0].0,
        runs.len()
    );
    Some((note, firsts.take(runs.len() - 1).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_and_strangers_are_named() {
        let names =
            |range: std::ops::Range<u32>| range.map(|n| PathBuf::from(format!("f_{n:04}.png")));
        let files: Vec<_> = names(0..9).chain(names(14..30)).collect();
        let Numbered { files: kept, notes, gaps } = numbered(files);
        assert_eq!((kept.len(), notes.len(), gaps), (25, 1, vec![(9, 5)]));
        assert!(notes[0].starts_with("numbers 9 to 13 are missing"), "{notes:?}");
        let mut files: Vec<_> = names(0..30).collect();
        files.push(PathBuf::from("mean.png"));
        let Numbered { files: kept, notes, .. } = numbered(files);
        assert_eq!(kept.len(), 30);
        assert!(notes[0].contains("`mean.png`"), "{notes:?}");
        let of_camera = |camera: u32| (0..15).map(move |n| format!("cam{camera}_f{n:03}.png"));
        let files = of_camera(1).chain(of_camera(2)).map(PathBuf::from).collect();
        let Numbered { files: kept, notes, gaps } = numbered(files);
        assert_eq!((kept.len(), gaps), (30, vec![(15, LONG_GAP)]));
        assert!(notes[0].contains("cam1_f to cam2_f: 2 sequences"), "{notes:?}");
        let one_of_three = ["rec_0.tif", "rec_2.tif", "rec_3.tif"].map(PathBuf::from).to_vec();
        assert_eq!(numbered(one_of_three).gaps, [(1, 1)]);
        for plain in [["a.png", "b.png", "c.png"], ["f0.png", "f10.png", "f20.png"]] {
            let files: Vec<_> = plain.iter().map(PathBuf::from).collect();
            assert_eq!(numbered(files.clone()), Numbered { files, ..Numbered::default() });
        }
    }
}
