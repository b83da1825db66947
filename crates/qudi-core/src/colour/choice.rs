//! Filters by name: a pattern, or a picture of the filter.

use super::mosaic::Mosaic;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// A colour filter array as users name it: `rggb@0,0`, or a picture of it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum FilterChoice {
    /// A tile that repeats.
    Tile(Mosaic),
    /// A PNG or TIFF of pure red, green, blue and white pixels.
    Picture(PathBuf),
}

impl FilterChoice {
    /// Returns the tile, unless the filter is a picture.
    pub fn tile(&self) -> Option<&Mosaic> {
        match self {
            Self::Tile(mosaic) => Some(mosaic),
            Self::Picture(_) => None,
        }
    }

    /// Returns true for the name of a picture.
    pub(crate) fn is_picture(text: &str) -> bool {
        let extension = Path::new(text).extension().unwrap_or_default().to_string_lossy();
        ["png", "tif", "tiff"].iter().any(|known| extension.eq_ignore_ascii_case(known))
    }
}

impl FromStr for FilterChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if Self::is_picture(text) {
            return Ok(Self::Picture(PathBuf::from(text)));
        }
        text.parse().map(Self::Tile)
    }
}

impl std::fmt::Display for FilterChoice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Tile(mosaic) => mosaic.fmt(f),
            Self::Picture(path) => path.display().fmt(f),
        }
    }
}

impl TryFrom<String> for FilterChoice {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<FilterChoice> for String {
    fn from(choice: FilterChoice) -> Self {
        choice.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_files_are_pictures() {
        let choice = |text: &str| text.parse::<FilterChoice>();
        assert_eq!(choice("a/rgbw.PNG"), Ok(FilterChoice::Picture("a/rgbw.PNG".into())));
        assert_eq!(choice("GRBG").map(|c| c.to_string()), Ok("grbg@0,0".to_owned()));
        assert!(choice("rggb.jpg").is_err());
    }
}
