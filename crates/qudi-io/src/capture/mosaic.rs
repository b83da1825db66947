//! Colour filter arrays: which pixels of a mosaic see which colour.

use super::info::CaptureInfo;
use super::options::ReadOptions;
use qudi_core::{Error, Result, Size};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::str::FromStr;

/// The pattern of a colour filter array, and where its first tile begins: `rggb@0,0`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Mosaic {
    /// Colours of a tile, row by row, in lower case.
    letters: String,
    /// Row and column of the first tile's corner, below the side of a tile.
    corner: (usize, usize),
}

/// The pixels of one letter of the pattern: every `step`-th, from a row and a column on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MosaicPlane {
    pub(crate) step: usize,
    pub(crate) row: usize,
    pub(crate) column: usize,
}

/// Letters of colour filters: red, green, blue, white (or clear), cyan, magenta, yellow.
const LETTERS: &str = "rgbwcmy";

impl Mosaic {
    /// The colours of a tile, row by row.
    pub fn pattern(&self) -> &str {
        &self.letters
    }

    /// Rows and columns of a tile.
    pub fn side(&self) -> usize {
        if self.letters.len() == 4 { 2 } else { 4 }
    }

    /// The pixels behind letter `index` of the pattern, if it has that many.
    pub(crate) fn plane(&self, index: usize) -> Option<MosaicPlane> {
        let step = self.side();
        let at = |corner: usize, within: usize| (corner + within) % step;
        (index < self.letters.len()).then(|| MosaicPlane {
            step,
            row: at(self.corner.0, index / step),
            column: at(self.corner.1, index % step),
        })
    }

    /// What to type for each plane, as in "`channel 0` (r), 1 (g)".
    pub(crate) fn choices(&self) -> String {
        let each = self.letters.chars().enumerate();
        let each: Vec<_> = each.map(|(i, letter)| format!("{i} ({letter})")).collect();
        format!("`channel {}`", each.join(", "))
    }
}

impl FromStr for Mosaic {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let wanted = || {
            format!(
                "expected the colours of a tile of 2 x 2 or 4 x 4 pixels and the row and column where it begins, as in rggb@0,0 (letters {LETTERS}); not `{text}`"
            )
        };
        let (letters, corner) = text.split_once('@').unwrap_or((text, "0,0"));
        let letters = letters.to_lowercase();
        let known = letters.chars().all(|letter| LETTERS.contains(letter));
        let corner = corner.split_once(',').and_then(|(row, column)| {
            Some((row.trim().parse().ok()?, column.trim().parse().ok()?))
        });
        let (Some(corner), true, 4 | 16) = (corner, known, letters.len()) else {
            return Err(wanted());
        };
        let mosaic = Self { letters, corner };
        let side = mosaic.side();
        if corner.0 >= side || corner.1 >= side { Err(wanted()) } else { Ok(mosaic) }
    }
}

impl std::fmt::Display for Mosaic {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}@{},{}", self.letters, self.corner.0, self.corner.1)
    }
}

impl TryFrom<String> for Mosaic {
    type Error = String;

    fn try_from(text: String) -> std::result::Result<Self, String> {
        text.parse()
    }
}

impl From<Mosaic> for String {
    fn from(mosaic: Mosaic) -> Self {
        mosaic.to_string()
    }
}

/// The pixels of a mosaic that are read; `None` where there is none.
pub(super) fn mosaic_plane(
    info: &mut CaptureInfo,
    options: &ReadOptions,
    path: &Path,
) -> Result<Option<MosaicPlane>> {
    let Some(mosaic) = options.cfa.clone().or(info.cfa.take()) else { return Ok(None) };
    info.cfa = Some(mosaic.clone());
    let letters = mosaic.pattern();
    let index = match options.channel {
        Some(index) => index,
        None if options.cfa.is_some() => {
            let first = letters.chars().next().unwrap_or_default();
            info.notes.push(format!(
                "one colour of the mosaic {mosaic} is read, the first ({first}); all are {}",
                mosaic.choices()
            ));
            0
        }
        None => {
            return Err(Error::data(
                format!("a capture behind a colour filter array ({})", letters.to_uppercase()),
                path,
                format!("read one of its colours as gray: {}", mosaic.choices()),
            ));
        }
    };
    let plane = mosaic.plane(index);
    if plane.is_none() {
        return Err(Error::request(
            format!("channel {index} of the mosaic {mosaic}"),
            "channel",
            format!("it has {}", mosaic.choices()),
        ));
    }
    Ok(plane)
}

/// Side of the blocks that are asked whether they show a mosaic.
const BLOCK: usize = 32;

/// Blocks that must be lit for an answer.
const LEAST_BLOCKS: usize = 12;

/// Share of the blocks that must agree on which pixels are the brighter ones.
const AGREED: f64 = 0.9;

/// Contrast between the pixels of a tile that is more than uneven readout.
const CONTRAST: f64 = 0.02;

/// By how much the pixels of tiles of 2 x 2 differ all over the picture `sums`, as a share of their mean, if it
/// looks like that of a colour filter array: the two diagonals differ, or rows and columns both. Stripes along
/// one axis are readout.
pub(crate) fn mosaic_contrast(sums: &[u32], size: Size) -> Option<f64> {
    let mut contrasts: [Vec<f64>; 3] = Default::default();
    for top in (0..size.height.saturating_sub(BLOCK - 1)).step_by(BLOCK) {
        for left in (0..size.width.saturating_sub(BLOCK - 1)).step_by(BLOCK) {
            let mut phases = [[0.0; 2]; 2];
            for y in top..top + BLOCK {
                for x in left..left + BLOCK {
                    phases[y % 2][x % 2] += f64::from(sums[y * size.width + x]);
                }
            }
            let [[a, b], [c, d]] = phases;
            let total = a + b + c + d;
            if total > 0.0 {
                let of_block = [a + d - b - c, a + b - c - d, a + c - b - d];
                for (all, contrast) in contrasts.iter_mut().zip(of_block) {
                    all.push(2.0 * contrast / total);
                }
            }
        }
    }
    let [diagonal, rows, columns] = contrasts.map(agreed_contrast);
    diagonal.or(rows.and(columns))
}

/// The median of contrasts that nearly all have the same sign and are large enough.
fn agreed_contrast(mut contrasts: Vec<f64>) -> Option<f64> {
    let positive = contrasts.iter().filter(|&&contrast| contrast > 0.0).count();
    let agree = positive.max(contrasts.len() - positive) as f64 >= AGREED * contrasts.len() as f64;
    if contrasts.len() < LEAST_BLOCKS || !agree {
        return None;
    }
    contrasts.sort_unstable_by(f64::total_cmp);
    let median = contrasts[contrasts.len() / 2].abs();
    (median > CONTRAST).then_some(median)
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::random::{Domain, Streams, uniform};

    /// A picture with gradients and noise, seen through filters.
    fn seen(filters: [[f64; 2]; 2]) -> Option<f64> {
        let size = Size { height: 128, width: 160 };
        let mut rng = Streams::new(5).row(Domain::Photons, 0, 0);
        let value = |i: usize| {
            let (x, y) = (i % size.width, i / size.width);
            let light = 20.0 + 0.1 * x as f64 + 15.0 * (0.3 * y as f64).sin().powi(2);
            let noise = 1.0 + 0.4 * (uniform(&mut rng) - 0.5);
            (light * noise * filters[y % 2][x % 2]) as u32
        };
        mosaic_contrast(&(0..size.pixels()).map(value).collect::<Vec<_>>(), size)
    }

    #[test]
    fn mosaics_show_in_the_picture_and_stripes_do_not_count() {
        assert_eq!(seen([[1.0, 1.0], [1.0, 1.0]]), None);
        assert_eq!(seen([[1.0, 0.8], [1.0, 0.8]]), None, "columns of a readout");
        let rggb = seen([[0.7, 1.0], [1.0, 0.5]]).unwrap();
        assert!((0.4..0.6).contains(&rggb), "{rggb}");
        // Diagonals alike.
        assert!(seen([[1.0, 0.9], [0.7, 0.6]]).is_some());
    }

    #[test]
    fn planes_begin_where_the_pattern_says() {
        let plane = |text: &str, index| text.parse::<Mosaic>().unwrap().plane(index);
        let at = |row, column| Some(MosaicPlane { step: 2, row, column });
        assert_eq!(plane("rggb", 0), at(0, 0));
        assert_eq!(plane("rggb@0,0", 3), at(1, 1));
        assert_eq!(plane("RGGB@0,1", 0), at(0, 1));
        assert_eq!(plane("rggb@1,1", 3), at(0, 0));
        assert_eq!(plane("rggb", 4), None);
        assert_eq!(
            plane("wgwrbwgwwrwbgwrw@3,0", 15).map(|p| (p.step, p.row, p.column)),
            Some((4, 2, 3))
        );
    }

    #[test]
    fn rejects_what_is_no_pattern() {
        for text in ["", "rgb", "rgxb", "rggb@2,0", "rggb@0", "rggb@a,b", "rggbrggb"] {
            assert!(text.parse::<Mosaic>().is_err(), "{text}");
        }
    }
}
