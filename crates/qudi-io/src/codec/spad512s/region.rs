//! Regions of interest: the row width of a read-out that is not a whole array.

use super::ARRAY;
use qudi_core::{Error, Result, Size};
use std::path::Path;

/// Step of row widths in pixels.
const WIDTH_STEP: usize = 8;

/// Largest number of samples that are compared.
const MAX_SAMPLES: usize = 1 << 20;

/// Standard errors by which rows of one width must fit better than of others.
const Z_SCORE_THRESHOLD: f64 = 6.0;

/// Returns the size of frames, where files hold `frame_bytes(size)` for every frame: the whole array, or the
/// region of interest that `samples` (from the start of a file) show. `body` is the number of frame bytes in
/// the first file.
pub(super) fn frame_size(
    samples: &[f32],
    body: u64,
    frame_bytes: impl Fn(Size) -> u64,
    path: &Path,
) -> Result<Size> {
    let fits = |size: &Size| body > 0 && body.is_multiple_of(frame_bytes(*size));
    let seen = row_width(samples).map(|width| Size { height: ARRAY.height, width });
    // Only whole rows are compared; an incomplete frame has an error of its own.
    if seen == Some(ARRAY) || fits(&ARRAY) && seen.is_none() {
        return Ok(ARRAY);
    }
    if let Some(size) = seen.filter(fits) {
        return Ok(size);
    }
    let regions =
        (1..=ARRAY.width / WIDTH_STEP).rev().map(|n| Size { width: n * WIDTH_STEP, ..ARRAY });
    let mut possible: Vec<String> =
        regions.filter(fits).take(6).map(|size| size.to_string()).collect();
    if let Some(Size { width, .. }) = seen {
        let rows = (1..=ARRAY.height).rev().map(|height| Size { height, width });
        possible = rows.filter(fits).take(6).map(|size| size.to_string()).collect();
    }
    Err(Error::data(
        match seen {
            Some(size) => format!("{body} bytes of frames with rows of {} pixels", size.width),
            None => format!("{body} bytes of frames of unsure size"),
        },
        path,
        if possible.is_empty() {
            "a region of interest: give its height and width, as in `size 512x256`".to_owned()
        } else {
            format!(
                "a region of interest: give its height and width, as in `size {}`; possible are {}",
                possible[0],
                possible.join(", ")
            )
        },
    ))
}

/// Returns the row length at which vertical neighbours fit best, if one does clearly better than the lengths
/// around it.
fn row_width(samples: &[f32]) -> Option<usize> {
    let samples = &samples[..samples.len().min(MAX_SAMPLES)];
    if samples.len() < 4 * ARRAY.width {
        return None;
    }
    // Groups of 8 pixels are averaged to reduce noise.
    let eights: Vec<f32> =
        samples.chunks_exact(WIDTH_STEP).map(|eight| eight.iter().sum()).collect();
    let most = ARRAY.width / WIDTH_STEP;
    let pairs = eights.len() - most;
    let difference = |lag: usize| -> (f64, f64) {
        let squares = (0..pairs).map(|i| f64::from(eights[i] - eights[i + lag]).powi(2));
        let (sum, square) = squares.fold((0.0, 0.0), |(s, q), d| (s + d, q + d * d));
        let mean = sum / pairs as f64;
        (mean, ((square / pairs as f64 - mean * mean).max(0.0) / pairs as f64).sqrt())
    };
    let all: Vec<(f64, f64)> = (1..=most).map(difference).collect();
    let (at, best) = all.iter().enumerate().skip(1).min_by(|a, b| a.1.0.total_cmp(&b.1.0))?;
    // Multiples of the row length fit as well: the shortest counts.
    let alike = |d: &(f64, f64)| d.0 <= best.0 + 3.0 * d.1.max(best.1);
    let at = (1..at).find(|&i| (at + 1).is_multiple_of(i + 1) && alike(&all[i])).unwrap_or(at);
    let neighbours = [at.checked_sub(1), Some(at + 1)].into_iter().flatten();
    let beside = neighbours.filter_map(|i| all.get(i));
    let clear = beside.clone().count() > 0
        && beside.into_iter().all(|d| d.0 - all[at].0 > Z_SCORE_THRESHOLD * d.1.max(all[at].1));
    clear.then_some((at + 1) * WIDTH_STEP)
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::random::{Domain, Streams, uniform};

    fn noisy(size: Size, frames: usize, light: impl Fn(usize, usize) -> f64) -> Vec<f32> {
        let mut rng = Streams::new(5).row(Domain::Pattern, 0, 0);
        let mut values = Vec::new();
        for _ in 0..frames {
            for i in 0..size.pixels() {
                let mean = light(i / size.width, i % size.width);
                values.push((mean + mean.sqrt() * 3.4 * (uniform(&mut rng) - 0.5)) as f32);
            }
        }
        values
    }

    #[test]
    fn rows_show_their_width() {
        let ramp = |_: usize, x: usize| 20.0 * (1.0 + x as f64 / 128.0);
        for width in [256, 128, 512, 96] {
            let size = Size { height: 512, width };
            assert_eq!(row_width(&noisy(size, 2, ramp)), Some(width));
        }
        let flat = noisy(ARRAY, 2, |_, _| 20.0);
        assert_eq!(row_width(&flat), None);
    }

    #[test]
    fn sizes_fit_the_file_or_are_asked_for() {
        let path = Path::new("roi.bin");
        let bytes = |size: Size| size.pixels() as u64;
        let size = |samples: &[f32], body: u64| frame_size(samples, body, bytes, path);
        let half = Size { height: 512, width: 256 };
        let ramp = noisy(half, 3, |_, x| 20.0 * (1.0 + x as f64 / 128.0));
        assert_eq!(size(&ramp, 6 * 512 * 256).unwrap(), half);
        assert_eq!(size(&ramp, 5 * 512 * 256).unwrap(), half);
        let flat = noisy(half, 3, |_, _| 20.0);
        assert_eq!(size(&flat, 3 * 512 * 512).unwrap(), ARRAY);
        let unsure = size(&flat, 5 * 512 * 256).unwrap_err();
        assert!(unsure.help().unwrap_or_default().contains("512 x 256"), "{unsure:?}");
    }
}
