//! Numbered files: names of another pattern are no frames, and missing numbers are named.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Files of the usual pattern, from which on others are strangers.
const MIN_FILES: usize = 3;

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
    /// Files before which numbers are missing.
    pub(crate) gaps: Vec<usize>,
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

/// Describes the numbers that are missing between the first and the last, and returns the files after them.
fn missing(files: &[PathBuf]) -> Option<(String, Vec<usize>)> {
    let numbers: Option<Vec<(String, u64)>> = files.iter().map(|file| pattern(file).1).collect();
    let numbers = numbers?;
    let before = &numbers.first()?.0;
    // Another number counts, too: nothing is known of the order.
    if numbers.iter().any(|(other, _)| other != before) {
        return None;
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
    if gaps.is_empty() || 4 * gaps.len() > numbers.len() {
        return None;
    }
    let more = if gaps.len() > MAX_LISTED { ", and more" } else { "" };
    let list = gaps[..gaps.len().min(MAX_LISTED)].join(", ");
    Some((format!("numbers {list}{more} are missing: the scene jumps there"), after))
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
        assert_eq!((kept.len(), notes.len(), gaps), (25, 1, vec![9]));
        assert!(notes[0].starts_with("numbers 9 to 13 are missing"), "{notes:?}");
        let mut files: Vec<_> = names(0..30).collect();
        files.push(PathBuf::from("mean.png"));
        let Numbered { files: kept, notes, .. } = numbered(files);
        assert_eq!(kept.len(), 30);
        assert!(notes[0].contains("`mean.png`"), "{notes:?}");
        for plain in [["a.png", "b.png", "c.png"], ["f0.png", "f10.png", "f20.png"]] {
            let files: Vec<_> = plain.iter().map(PathBuf::from).collect();
            assert_eq!(numbered(files.clone()), Numbered { files, ..Numbered::default() });
        }
    }
}
