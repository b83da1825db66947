//! Pictures of counts: pixel values that are means of binary frames, scaled to full scale.

/// Largest number of levels; more look like an ordinary picture.
const MAX_LEVELS: u16 = 64;

/// Returns N if the distinct `values` (rising) are multiples of `full / N`, rounded or truncated.
pub(crate) fn infer_levels(values: &[u16], full: u16) -> Option<u16> {
    let nonzero: Vec<u16> = values.iter().copied().filter(|&v| v > 0).collect();
    let smallest = *nonzero.first()?;
    let fits = |n: u16| {
        nonzero.iter().all(|&v| {
            let step = f64::from(full) / f64::from(n);
            let k = (f64::from(v) / step).round();
            let exact = k * step;
            (f64::from(v) - exact).abs() <= 0.5 || f64::from(v) == exact.floor()
        })
    };
    let most = MAX_LEVELS.min(full.div_ceil(4));
    // A single level is full scale, that is, binary; several must fill the ladder.
    (1..=most)
        .filter(|&n| f64::from(smallest) > 0.9 * f64::from(full) / f64::from(n))
        .find(|&n| fits(n) && nonzero.len() * 3 >= usize::from(n))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ladder(n: u16, upto: u16, full: u16) -> Vec<u16> {
        (0..=upto).map(|k| (f64::from(k) * f64::from(full) / f64::from(n)).round() as u16).collect()
    }

    #[test]
    fn means_of_few_frames_are_recognised() {
        assert_eq!(infer_levels(&[0, 255], 255), Some(1));
        assert_eq!(infer_levels(&[0, 65535], 65535), Some(1));
        assert_eq!(infer_levels(&ladder(4, 4, 255), 255), Some(4));
        assert_eq!(infer_levels(&ladder(7, 6, 255), 255), Some(7));
        assert_eq!(infer_levels(&ladder(15, 15, 255), 255), Some(15));
        assert_eq!(infer_levels(&ladder(16, 12, 255), 255), Some(16));
        assert_eq!(infer_levels(&ladder(64, 36, 65535), 65535), Some(64));
        assert_eq!(infer_levels(&ladder(64, 36, 255), 255), Some(64));
    }

    #[test]
    fn distinguishes_counts_from_pictures() {
        assert_eq!(infer_levels(&[0], 255), None);
        assert_eq!(infer_levels(&[0, 1], 255), None);
        assert_eq!(infer_levels(&[0, 1, 2, 3, 4, 5, 6, 7], 255), None);
        assert_eq!(infer_levels(&(0..=255).collect::<Vec<_>>(), 255), None);
        assert_eq!(infer_levels(&[0, 3, 5, 9, 20, 31], 255), None);
    }
}
