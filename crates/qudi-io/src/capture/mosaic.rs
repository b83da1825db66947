//! Captures behind a colour filter array: what of it is read, and the detection of a mosaic.

use crate::description::{CaptureInfo, ReadOptions};
use qudi_core::colour::{ColourFilter, FilterChoice, MosaicPlane};
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
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MosaicContrast {
    /// Rows, and columns, of a tile: 2, or 4 where each colour covers 2 x 2 pixels.
    pub side: usize,
    /// Difference as a share of the mean.
    pub contrast: f64,
}

/// Returns by how much the pixels of tiles differ if the picture `sums` looks like a mosaic, or like one
/// whose colours cover 2 x 2 pixels each (quad Bayer).
pub(super) fn mosaic_contrast(sums: &[u32], size: Size) -> Option<MosaicContrast> {
    if let Some(contrast) = tile_contrast(sums, size, |at| at % 2, |at| at % 2) {
        return Some(MosaicContrast { side: 2, contrast });
    }
    let corners = [(0, 0), (0, 1), (1, 0), (1, 1)].into_iter();
    let contrasts = corners.filter_map(|(row, column)| {
        tile_contrast(sums, size, |y| ((y + row) >> 1) % 2, |x| ((x + column) >> 1) % 2)
    });
    let contrast = contrasts.max_by(f64::total_cmp)?;
    Some(MosaicContrast { side: 4, contrast })
}

/// Returns by how much the four colours of tiles differ, as a share of their mean, if the two diagonals
/// differ everywhere, or rows and columns both. Stripes along one axis come from readout. `row` and `column`
/// return the row and the column in a tile of 2 x 2 colours.
fn tile_contrast(
    sums: &[u32],
    size: Size,
    row: impl Fn(usize) -> usize,
    column: impl Fn(usize) -> usize,
) -> Option<f64> {
    let mut contrasts: [Vec<f64>; 3] = Default::default();
    for top in (0..size.height.saturating_sub(BLOCK_SIDE - 1)).step_by(BLOCK_SIDE) {
        for left in (0..size.width.saturating_sub(BLOCK_SIDE - 1)).step_by(BLOCK_SIDE) {
            let mut phases = [[0.0; 2]; 2];
            for y in top..top + BLOCK_SIDE {
                for x in left..left + BLOCK_SIDE {
                    phases[row(y)][column(x)] += f64::from(sums[y * size.width + x]);
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

/// Contrast of the other two pixels, as a share of the greens', below which the greens are not green.
const MAX_OTHERS: f64 = 0.5;

/// Refuses a Bayer pattern whose two pixels of one colour differ all over the picture, while the other two do
/// not: the tile begins a pixel further.
pub(super) fn check_phase(sums: &[u32], filter: &ColourFilter, cfa: &FilterChoice) -> Result<()> {
    let size = filter.size();
    if filter.tile().is_none_or(|tile| tile.len() != 4) {
        return Ok(());
    }
    let colour = |y: usize, x: usize| filter.colours()[y * size.width + x];
    let diagonals = [[(0, 0), (1, 1)], [(0, 1), (1, 0)]];
    let twins = diagonals.iter().position(|&[a, b]| colour(a.0, a.1) == colour(b.0, b.1));
    let Some(twins) = twins else { return Ok(()) };
    let contrast = |pair: [(usize, usize); 2]| pair_contrast(sums, size, pair);
    let (same, others) = (contrast(diagonals[twins]), contrast(diagonals[1 - twins]));
    let Some(same) = same else { return Ok(()) };
    if others.unwrap_or(0.0) > MAX_OTHERS * same {
        return Ok(());
    }
    let [(y, x), _] = diagonals[twins];
    let help = match cfa {
        FilterChoice::Tile(_) => {
            "the tile begins a pixel further, as in rggb@0,1 instead of rggb@0,0"
        }
        FilterChoice::Picture(_) => "the picture of the filter is shifted by a pixel",
    };
    Err(Error::mismatch(
        format!(
            "the two {} pixels of a tile of {cfa} differ by {:.0} % all over the picture, and the other two do not",
            colour(y, x).name(),
            100.0 * same
        ),
        "cfa",
        help,
    ))
}

/// Returns by how much two pixels of tiles of 2 x 2 differ, as a share of their mean, if they do nearly
/// everywhere.
fn pair_contrast(sums: &[u32], size: Size, pair: [(usize, usize); 2]) -> Option<f64> {
    let mut contrasts = Vec::new();
    for top in (0..size.height.saturating_sub(BLOCK_SIDE - 1)).step_by(BLOCK_SIDE) {
        for left in (0..size.width.saturating_sub(BLOCK_SIDE - 1)).step_by(BLOCK_SIDE) {
            let mut totals = [0.0; 2];
            for (total, (down, across)) in totals.iter_mut().zip(pair) {
                for y in (top + down..top + BLOCK_SIDE).step_by(2) {
                    for x in (left + across..left + BLOCK_SIDE).step_by(2) {
                        *total += f64::from(sums[y * size.width + x]);
                    }
                }
            }
            let [a, b] = totals;
            if a + b > 0.0 {
                contrasts.push(2.0 * (a - b) / (a + b));
            }
        }
    }
    agreed_contrast(contrasts)
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

    /// Measures a picture with gradients and noise, seen through filters.
    fn seen(filters: [[f64; 2]; 2]) -> Option<f64> {
        let seen = seen_at(|y, x| filters[y % 2][x % 2])?;
        assert_eq!(seen.side, 2);
        Some(seen.contrast)
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
        mosaic_contrast(&(0..size.pixels()).map(value).collect::<Vec<_>>(), size)
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
            check_phase(&sums, &filter, &cfa)
        };
        for right in ["rggb", "bggr", "grbg@0,1", "rgbw"] {
            assert!(check(right).is_ok(), "{right}");
        }
        for wrong in ["grbg", "gbrg", "rggb@0,1"] {
            let error = check(wrong).unwrap_err().to_string();
            assert!(error.contains("two green pixels"), "{error}");
        }
    }

    #[test]
    fn quad_mosaics_show_at_any_corner_and_stripes_do_not_count() {
        let rggb = [[0.7, 1.0], [1.0, 0.5]];
        for (row, column) in [(0, 0), (0, 1), (1, 0), (3, 3)] {
            let seen = seen_at(|y, x| rggb[((y + row) >> 1) % 2][((x + column) >> 1) % 2]).unwrap();
            assert_eq!(seen.side, 4, "{row}, {column}");
            assert!((0.4..0.6).contains(&seen.contrast), "{seen:?}");
        }
        assert_eq!(seen_at(|_, x| [1.0, 0.8][x / 2 % 2]), None, "pairs of columns of a readout");
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
}
