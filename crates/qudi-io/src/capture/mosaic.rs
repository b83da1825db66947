//! Captures behind a colour filter array: what of it is read, and the detection of a mosaic.

mod neighbours;

use crate::description::{CaptureInfo, ReadOptions};
use neighbours::{Difference, NeighbourDifferences, same_colour};
use qudi_core::colour::{ColourFilter, FilterChoice, Mosaic, MosaicPlane};
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Result, Size};

/// The part of a mosaic that is read.
pub(super) enum MosaicPart {
    /// Every pixel, each with its colour.
    Whole(FilterChoice),
    /// The pixels of one letter.
    Plane(MosaicPlane),
}

/// Returns the part of a mosaic that is read; `None` for captures without one, as with full planes. The
/// filter is the user's, the file's, or the sensor's.
pub(super) fn mosaic_part(
    info: &mut CaptureInfo,
    options: &ReadOptions,
    sensor: Option<&Sensor>,
) -> Result<Option<MosaicPart>> {
    if info.full_colour {
        return Ok(None);
    }
    let of_sensor = || {
        let sensor = sensor.or(info.sensor.as_ref())?;
        sensor.colour.as_ref()?.cfa.clone()
    };
    let Some(choice) = options.cfa.clone().or(info.cfa.clone()).or_else(of_sensor) else {
        return Ok(None);
    };
    info.cfa = Some(choice.clone());
    let Some(index) = options.channel else { return Ok(Some(MosaicPart::Whole(choice))) };
    let FilterChoice::Tile(mosaic) = choice else {
        return Err(Error::request(
            format!("channel {index} of the filter {choice}, which is a picture"),
            "channel",
            "leave it out: all pixels are read with their colours",
        ));
    };
    let plane = mosaic.plane(index).map(MosaicPart::Plane);
    if plane.is_none() {
        return Err(Error::request(
            format!("channel {index} of the mosaic {mosaic}"),
            "channel",
            format!("it has {}", mosaic.choices()),
        ));
    }
    Ok(plane)
}

/// Side of the blocks that are tested for a mosaic.
const BLOCK_SIDE: usize = 32;

/// Least number of lit blocks for an answer.
const MIN_BLOCKS: usize = 12;

/// Least share of the blocks that agree on which pixels are brighter.
const MIN_AGREEMENT: f64 = 0.9;

/// Least contrast between the pixels of a tile; uneven readout has less.
const MIN_CONTRAST: f64 = 0.02;

/// A difference between the pixels of tiles all over the picture.
#[derive(Clone, Debug, PartialEq)]
pub struct MosaicContrast {
    /// Rows, and columns, of a tile: 2, or 4.
    pub side: usize,
    /// Difference as a share of the mean.
    pub contrast: f64,
    /// Filters that the picture fits, if it fits a Bayer pattern: red and blue look alike.
    pub patterns: Option<[Mosaic; 2]>,
}

/// Bayer patterns that differ in more than red and blue. The second of a pair has these exchanged.
const BAYER: [[&str; 2]; 2] = [["rggb@0,0", "bggr@0,0"], ["grbg@0,0", "gbrg@0,0"]];

/// A picture, and where its pixels are stored: filters are named by the stored frame.
pub(super) struct PlacedSums<'a> {
    pub(super) sums: &'a [u32],
    pub(super) size: Size,
    /// Stored pixel of each pixel; `None` if they are the same.
    pub(super) from: Option<&'a [u32]>,
    /// Columns of the stored frame.
    pub(super) stored_width: usize,
}

impl PlacedSums<'_> {
    /// Returns the pattern of the stored frame that is `seen` in the picture, among the Bayer patterns.
    fn stored(&self, seen: &Mosaic) -> Option<Mosaic> {
        let Some(from) = self.from else { return Some(seen.clone()) };
        let mut letters = [None; 16];
        for (i, &place) in from.iter().enumerate() {
            let (row, column) =
                (place as usize / self.stored_width, place as usize % self.stored_width);
            let letter = seen.letter(i / self.size.width, i % self.size.width);
            letters[row % 4 * 4 + column % 4] = Some(letter);
        }
        let fits = |pattern: &Mosaic| {
            (0..16).all(|i| letters[i].is_none_or(|letter| pattern.letter(i / 4, i % 4) == letter))
        };
        bayer_names().flatten().filter_map(|name| name.parse().ok()).find(fits)
    }
}

/// Returns by how much the pixels of tiles differ if the picture looks like a mosaic.
pub(super) fn mosaic_contrast(picture: &PlacedSums<'_>) -> Option<MosaicContrast> {
    let &PlacedSums { sums, size, .. } = picture;
    let differences = NeighbourDifferences::new(sums, size);
    let gray = [[true; 16]; 4];
    let found = differences.as_ref().and_then(|all| Some((all, all.within_colours(&gray)?)));
    if let Some((differences, Difference { contrast, .. })) = found {
        let patterns = bayer_patterns(differences, picture);
        let side = patterns.as_ref().map_or(4, |[pattern, _]| pattern.side());
        return Some(MosaicContrast { side, contrast, patterns });
    }
    let contrast = tile_contrast(sums, size)?;
    Some(MosaicContrast { side: 2, contrast, patterns: None })
}

/// Returns the names of all Bayer patterns, of single pixels or of 2 x 2, in pairs that differ in red and
/// blue.
fn bayer_names() -> impl Iterator<Item = [String; 2]> {
    let quads = (0..8).map(|i| {
        let corner = format!("@{},{}", i / 4, i % 4);
        ["quad-rggb", "quad-bggr"].map(|letters| format!("{letters}{corner}"))
    });
    BAYER.into_iter().map(|pair| pair.map(str::to_owned)).chain(quads)
}

/// Returns the Bayer pattern that fits the differences between neighbours best, and the one with red and blue
/// exchanged, by the stored frame.
fn bayer_patterns(
    differences: &NeighbourDifferences,
    picture: &PlacedSums<'_>,
) -> Option<[Mosaic; 2]> {
    let fitting = bayer_names().filter_map(|pair| {
        let pair = pair.map(|text| text.parse::<Mosaic>().ok());
        let [Some(first), Some(second)] = pair else { return None };
        let same = same_colour(|row, column| first.letter(row, column));
        Some((differences.z_score(&same)?, [first, second]))
    });
    let (_, [first, second]) = fitting.max_by(|a, b| a.0.total_cmp(&b.0))?;
    Some([picture.stored(&first)?, picture.stored(&second)?])
}

/// Returns by how much the four colours of tiles differ, as a share of their mean, if the two diagonals
/// differ everywhere, or rows and columns both. Stripes along one axis come from readout.
fn tile_contrast(sums: &[u32], size: Size) -> Option<f64> {
    let mut contrasts: [Vec<f64>; 3] = Default::default();
    for top in (0..size.height.saturating_sub(BLOCK_SIDE - 1)).step_by(BLOCK_SIDE) {
        for left in (0..size.width.saturating_sub(BLOCK_SIDE - 1)).step_by(BLOCK_SIDE) {
            let mut phases = [[0.0; 2]; 2];
            for y in top..top + BLOCK_SIDE {
                for x in left..left + BLOCK_SIDE {
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

/// Compares neighbours behind one colour of a tile: where they differ all over the picture, its phase or its
/// kind is wrong.
///
/// Refuses it if another pattern fits. Returns a warning otherwise, since static scenes of fine texture look
/// so, too, and where the capture records the filter.
pub(super) fn check_pattern(
    picture: &PlacedSums<'_>,
    filter: &ColourFilter,
    cfa: &FilterChoice,
    is_recorded: bool,
) -> Result<Option<String>> {
    let size = filter.size();
    if filter.tile().is_none() {
        return Ok(None);
    }
    let letter = |row: usize, column: usize| filter.colours()[row * size.width + column].letter();
    let Some(differences) = NeighbourDifferences::new(picture.sums, size) else { return Ok(None) };
    let Some(found) = differences.within_colours(&same_colour(letter)) else { return Ok(None) };
    let what = format!(
        "neighbouring pixels that are {} behind {} differ by {:.0} % all over the picture",
        filter.colours()[found.at.0 * size.width + found.at.1].name(),
        cfa.tile().map_or_else(|| cfa.to_string(), Mosaic::short),
        100.0 * found.contrast
    );
    let patterns = bayer_patterns(&differences, picture);
    let Some([first, second]) = patterns.filter(|_| !is_recorded) else {
        return Ok(Some(format!(
            "{what}: its kind or phase is wrong, or the scene has static texture as fine as its tiles"
        )));
    };
    Err(Error::mismatch(
        what,
        "cfa",
        format!(
            "the counts fit {} or {}: name the filter of this camera, and where its tile begins",
            first.short(),
            second.short()
        ),
    ))
}

/// Returns the median of the contrasts, if nearly all have the same sign and it is large enough.
fn agreed_contrast(mut contrasts: Vec<f64>) -> Option<f64> {
    let positive = contrasts.iter().filter(|&&contrast| contrast > 0.0).count();
    let agree =
        positive.max(contrasts.len() - positive) as f64 >= MIN_AGREEMENT * contrasts.len() as f64;
    if contrasts.len() < MIN_BLOCKS || !agree {
        return None;
    }
    contrasts.sort_unstable_by(f64::total_cmp);
    let median = contrasts[contrasts.len() / 2].abs();
    (median > MIN_CONTRAST).then_some(median)
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::random::{Domain, Streams, uniform};

    fn placed(sums: &[u32], size: Size) -> PlacedSums<'_> {
        PlacedSums { sums, size, from: None, stored_width: size.width }
    }

    #[test]
    fn patterns_are_named_by_the_stored_frame() {
        // A part of 8 x 8 of a frame of 10 x 12, from row 1 and column 0 on, mirrored.
        let size = Size { height: 8, width: 8 };
        let from: Vec<u32> = (0..64).map(|i| (i / 8 + 1) * 12 + 7 - i % 8).collect();
        let picture = PlacedSums { sums: &[], size, from: Some(&from), stored_width: 12 };
        let stored = |seen: &str| picture.stored(&seen.parse().unwrap()).unwrap().short();
        // Its stored columns alternate blue and green from the second row of rggb on.
        assert_eq!(stored("bggr"), "rggb");
        assert_eq!(stored("rggb"), "bggr");
        assert_eq!(stored("quad-rggb@1,2"), "quad-bggr@0,2");
    }

    #[test]
    fn recorded_filters_and_textures_that_fit_no_pattern_are_warned_of() {
        let size = Size { height: 64, width: 96 };
        let filter = ColourFilter::tiled(&"rggb".parse().unwrap(), size).unwrap();
        let cfa: FilterChoice = "rggb".parse().unwrap();
        let sums = |rates: [[u32; 2]; 2]| -> Vec<u32> {
            (0..size.pixels()).map(|i| rates[i / size.width % 2][i % size.width % 2]).collect()
        };
        let phase = sums([[100, 60], [40, 100]]);
        let check = |sums: &[u32], is_recorded| {
            check_pattern(&placed(sums, size), &filter, &cfa, is_recorded)
        };
        assert!(check(&phase, false).is_err());
        assert!(check(&phase, true).unwrap().unwrap().contains("differ by"));
        // All four differ.
        let texture = sums([[100, 60], [20, 128]]);
        assert!(check(&texture, false).unwrap().unwrap().contains("static texture"));
    }

    /// Measures a picture with gradients and noise, seen through filters.
    fn seen(filters: [[f64; 2]; 2]) -> Option<MosaicContrast> {
        let seen = seen_at(|y, x| filters[y % 2][x % 2])?;
        assert_eq!(seen.side, 2);
        Some(seen)
    }

    /// Measures the picture through the filter that `filter` returns for a row and a column.
    fn seen_at(filter: impl Fn(usize, usize) -> f64) -> Option<MosaicContrast> {
        let size = Size { height: 128, width: 160 };
        let mut rng = Streams::new(5).row(Domain::Photons, 0, 0);
        let value = |i: usize| {
            let (x, y) = (i % size.width, i / size.width);
            let light = 20.0 + 0.1 * x as f64 + 15.0 * (0.3 * y as f64).sin().powi(2);
            let noise = 1.0 + 0.4 * (uniform(&mut rng) - 0.5);
            (light * noise * filter(y, x)) as u32
        };
        mosaic_contrast(&placed(&(0..size.pixels()).map(value).collect::<Vec<_>>(), size))
    }

    #[test]
    fn a_phase_that_the_picture_contradicts_is_refused() {
        let size = Size { height: 128, width: 160 };
        let mut rng = Streams::new(6).row(Domain::Photons, 0, 0);
        let rates = [[60.0, 100.0], [100.0, 40.0]];
        let sums: Vec<u32> = (0..size.pixels())
            .map(|i| {
                let noise = 1.0 + 0.4 * (uniform(&mut rng) - 0.5);
                (rates[i / size.width % 2][i % size.width % 2] * noise) as u32
            })
            .collect();
        let check = |text: &str| {
            let cfa: FilterChoice = text.parse().unwrap();
            let filter = ColourFilter::tiled(cfa.tile().unwrap(), size).unwrap();
            check_pattern(&placed(&sums, size), &filter, &cfa, false)
        };
        for right in ["rggb", "bggr", "grbg@0,1", "rgbw"] {
            assert_eq!(check(right).unwrap(), None, "{right}");
        }
        for wrong in ["grbg", "gbrg", "rggb@0,1", "quad-rggb", "wrwgrwgwgwbwgwbw"] {
            let error = check(wrong).unwrap_err();
            assert!(error.to_string().contains("differ by"), "{error}");
            assert!(error.help().unwrap().contains("fit rggb or bggr"), "{error}");
        }
    }

    #[test]
    fn quad_mosaics_show_at_any_corner_and_stripes_do_not_count() {
        let rggb = [[0.7, 1.0], [1.0, 0.5]];
        for (row, column) in [(0, 0), (0, 1), (1, 0), (3, 3)] {
            let seen = seen_at(|y, x| rggb[((y + row) >> 1) % 2][((x + column) >> 1) % 2]).unwrap();
            assert_eq!(seen.side, 4, "{row}, {column}");
            assert!((0.4..0.8).contains(&seen.contrast), "{seen:?}");
            let corner = format!("@{},{}", (4 - row) % 4, (4 - column) % 4);
            let expected: Mosaic = format!("quad-rggb{corner}").parse().unwrap();
            let patterns = seen.patterns.unwrap();
            let letters = |mosaic: &Mosaic| -> String {
                (0..16).map(|i| mosaic.letter(i / 4, i % 4)).collect()
            };
            assert!(patterns.iter().any(|p| letters(p) == letters(&expected)), "{patterns:?}");
        }
        assert_eq!(seen_at(|_, x| [1.0, 0.8][x / 2 % 2]), None, "pairs of columns of a readout");
    }

    #[test]
    fn mosaics_show_in_the_picture_and_stripes_do_not_count() {
        assert_eq!(seen([[1.0, 1.0], [1.0, 1.0]]), None);
        assert_eq!(seen([[1.0, 0.8], [1.0, 0.8]]), None, "columns of a readout");
        let rggb = seen([[0.7, 1.0], [1.0, 0.5]]).unwrap();
        assert!((0.2..0.5).contains(&rggb.contrast), "{rggb:?}");
        assert_eq!(rggb.patterns.unwrap()[0].to_string(), "rggb@0,0");
        // Diagonals alike.
        assert!(seen([[1.0, 0.9], [0.7, 0.6]]).is_some());
    }
}
