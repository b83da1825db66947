//! Captures behind a colour filter array: the plane that is read, and the detection of a mosaic.

use crate::description::{CaptureInfo, MosaicPlane, ReadOptions};
use qudi_core::{Error, Result, Size};
use std::path::Path;

/// Returns the pixels of the mosaic that are read; `None` for captures without one.
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

/// Side of the blocks that are tested for a mosaic.
const BLOCK_SIDE: usize = 32;

/// Least number of lit blocks for an answer.
const MIN_BLOCKS: usize = 12;

/// Least share of the blocks that agree on which pixels are brighter.
const MIN_AGREEMENT: f64 = 0.9;

/// Least contrast between the pixels of a tile; uneven readout has less.
const MIN_CONTRAST: f64 = 0.02;

/// Returns by how much the pixels of tiles of 2 x 2 differ, as a share of their mean, if the picture `sums`
/// looks like a mosaic: the two diagonals differ everywhere, or rows and columns both. Stripes along one axis
/// come from readout.
pub(super) fn mosaic_contrast(sums: &[u32], size: Size) -> Option<f64> {
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
}
