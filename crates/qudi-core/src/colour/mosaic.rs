//! Colour filter arrays: the colour of each pixel of a mosaic.

use serde::{Deserialize, Serialize};
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
pub struct MosaicPlane {
    /// Pixels from one to the next, along rows and columns.
    pub step: usize,
    /// The first row.
    pub row: usize,
    /// The first column.
    pub column: usize,
}

/// Letters of colour filters: red, green, blue, white (or clear), cyan, magenta, yellow.
const LETTERS: &str = "rgbwcmy";

impl Mosaic {
    /// Returns the colours of a tile, row by row.
    pub fn pattern(&self) -> &str {
        &self.letters
    }

    /// Returns the number of rows, and of columns, of a tile.
    pub fn side(&self) -> usize {
        if self.letters.len() == 4 { 2 } else { 4 }
    }

    /// Returns the pixels of letter `index` of the pattern, if it has that many.
    pub fn plane(&self, index: usize) -> Option<MosaicPlane> {
        let step = self.side();
        let at = |corner: usize, within: usize| (corner + within) % step;
        (index < self.letters.len()).then(|| MosaicPlane {
            step,
            row: at(self.corner.0, index / step),
            column: at(self.corner.1, index % step),
        })
    }

    /// Returns the letter of the pixel in a row and a column.
    pub fn letter(&self, row: usize, column: usize) -> char {
        let side = self.side();
        let within = |at: usize, corner: usize| (at + side - corner) % side;
        let index = within(row, self.corner.0) * side + within(column, self.corner.1);
        char::from(self.letters.as_bytes()[index])
    }

    /// Writes it as briefly as it can be named: `rggb`, `quad-rggb@0,2`.
    pub fn short(&self) -> String {
        let letters: Vec<char> = self.letters.chars().collect();
        let tile: String = [0, 2, 8, 10].iter().filter_map(|&i| letters.get(i)).collect();
        let letters = if self.side() == 4 && quad(&tile) == self.letters {
            format!("quad-{tile}")
        } else {
            self.letters.clone()
        };
        match self.corner {
            (0, 0) => letters,
            (row, column) => format!("{letters}@{row},{column}"),
        }
    }

    /// Lists the option for each plane, as in "`channel 0` (r), 1 (g)".
    pub fn choices(&self) -> String {
        let each = self.letters.chars().enumerate();
        let each: Vec<_> = each.map(|(i, letter)| format!("{i} ({letter})")).collect();
        format!("`channel {}`", each.join(", "))
    }
}

impl FromStr for Mosaic {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wanted = || {
            format!(
                "expected the colours of a tile of 2 x 2 or 4 x 4 pixels and the row and column where it begins, as in rggb@0,0 or quad-rggb (letters {LETTERS}), or a picture of the filter (.png, .tif); not `{text}`"
            )
        };
        let (letters, corner) = text.split_once('@').unwrap_or((text, "0,0"));
        let letters = letters.to_lowercase();
        let letters = match letters.strip_prefix("quad-") {
            Some(tile) if tile.len() == 4 => quad(tile),
            _ => letters,
        };
        let known = letters.chars().all(|letter| LETTERS.contains(letter));
        let corner = corner.split_once(',').and_then(|(row, column)| {
            Some((row.trim().parse().ok()?, column.trim().parse().ok()?))
        });
        let (Some(corner), true, 4 | 16) = (corner, known, letters.len()) else {
            return Err(wanted());
        };
        let mosaic = Self { letters, corner };
        let side = mosaic.side();
        let Self { letters, corner: (row, column) } = &mosaic;
        if row.max(column) >= &side {
            return Err(format!(
                "a tile of {side} x {side} pixels begins at a row and a column below {side}: {letters}@{row},{column} is {letters}@{},{}",
                row % side,
                column % side
            ));
        }
        Ok(mosaic)
    }
}

/// Returns the letters of a quad pattern, in which every letter of a tile covers 2 x 2 pixels.
fn quad(tile: &str) -> String {
    let letters: Vec<char> = tile.chars().collect();
    (0..16).map(|i| letters[i / 8 * 2 + i % 4 / 2]).collect()
}

impl std::fmt::Display for Mosaic {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}@{},{}", self.letters, self.corner.0, self.corner.1)
    }
}

impl TryFrom<String> for Mosaic {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Mosaic> for String {
    fn from(mosaic: Mosaic) -> Self {
        mosaic.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn letters_repeat_from_the_corner_on() {
        let letters = |text: &str| -> String {
            let mosaic: Mosaic = text.parse().unwrap();
            (0..8).map(|i| mosaic.letter(i / 4, i % 4)).collect()
        };
        assert_eq!(letters("rggb"), "rgrggbgb");
        assert_eq!(letters("rggb@1,0"), "gbgbrgrg");
        assert_eq!(letters("quad-rggb"), "rrggrrgg");
        assert_eq!("quad-rggb".parse::<Mosaic>().unwrap().pattern(), "rrggrrggggbbggbb");
    }

    #[test]
    fn short_names_are_read_back() {
        for text in ["rggb", "gbrg@1,0", "quad-rggb", "quad-bggr@0,3", "wrwgrwgwgwbwgwbw@2,1"] {
            assert_eq!(text.parse::<Mosaic>().unwrap().short(), text);
        }
    }

    #[test]
    fn corners_outside_the_tile_are_named_inside() {
        let words = "rggb@5,7".parse::<Mosaic>().unwrap_err();
        assert!(words.ends_with("rggb@5,7 is rggb@1,1"), "{words}");
    }

    #[test]
    fn rejects_what_is_no_pattern() {
        for text in ["", "rgb", "rgxb", "rggb@2,0", "rggb@0", "rggb@a,b", "rggbrggb", "quad-rgg"] {
            assert!(text.parse::<Mosaic>().is_err(), "{text}");
        }
    }
}
