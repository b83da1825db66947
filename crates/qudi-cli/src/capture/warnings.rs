//! Warnings: what makes a result doubtful, and the remedy.

use qudi_core::colour::Colour;
use qudi_core::sensor::{Response, Sensor};
use qudi_io::capture::{Capture, Summary};

/// Range of chi-square of a result that explains its counts.
const CHI_SQUARE_RANGE: std::ops::RangeInclusive<f64> = 0.5..=2.0;

/// Share of saturated samples beyond which parts of the picture are lower bounds.
const MAX_SATURATED_SHARE: f64 = 0.2;

/// Share of ones among binary frames beyond which they tell little of the light.
const MAX_ONES_SHARE: f64 = 0.9;

/// Share of bad and doubtful pixels beyond which they are more than defects.
const MAX_BAD_SHARE: f64 = 0.01;

/// Range of the ratio between the light of the counts and the recorded light.
const LIGHT_RATIO_RANGE: std::ops::RangeInclusive<f64> = 0.5..=2.0;

/// Returns the warnings on a capture itself; `sensor` knows the largest value where the file does not.
pub(crate) fn of_capture(
    capture: &Capture,
    summary: &Summary,
    sensor: Option<&Sensor>,
) -> Vec<String> {
    let mut warnings = Vec::new();
    warnings.extend(capture.filter_contradiction().map(str::to_owned));
    warnings.extend(summary.filter_doubt.clone());
    warnings.extend(saturation(capture, summary, sensor));
    let bad = capture.bad_pixels();
    let share = (bad.len() + bad.doubtful) as f64 / capture.size().pixels() as f64;
    if share > MAX_BAD_SHARE {
        warnings.push(format!(
            "{} pixels are repaired, and {} more in clumps are doubtful, hot or small bright things ({:.2} % in all): name those of the camera with --mask FILE or --dcr FILE",
            bad.len(),
            bad.doubtful,
            100.0 * share
        ));
    }
    if let Some(mosaic) = &summary.mosaic {
        let (side, percent) = (mosaic.side, 100.0 * mosaic.contrast);
        let names = match &mosaic.patterns {
            Some([first, second]) => format!("--cfa {} or {}", first.short(), second.short()),
            None if side == 4 => "--cfa FILE.png, or the letters of its tile".to_owned(),
            None => "--cfa rggb, or the phase that your camera has".to_owned(),
        };
        warnings.push(format!(
            "pixels of a tile of {side} x {side} differ by {percent:.0} % all over the picture, as behind a colour filter array: name it ({names}), or colours are restored as texture"
        ));
    }
    if let Some(check) = &summary.bit_order
        && let (Some(seen), true) = (check.seen, check.z_score < 0.0)
    {
        warnings.push(format!(
            "the picture says that the bits of a byte are stored {seen}: see --bitorder"
        ));
    }
    if let Some(axes) = summary.likely_axes {
        warnings.push(format!(
            "what was read as frames looks like rows of the scene over time: if frames lie along another axis of the array, say so (as in --axes {} for a NumPy array)",
            axes.name()
        ));
    }
    if let (Some(recorded), Some(found)) = (capture.info().ppp, summary.ppp.incident) {
        let recorded = recorded * f64::from(capture.summed());
        if !LIGHT_RATIO_RANGE.contains(&(found / recorded)) {
            warnings.push(format!(
                "the record says {recorded:.4} photons per pixel and frame, and the counts show {found:.4}: remove the record if it belongs to another burst, or give the light with --ppp"
            ));
        }
    }
    warnings
}

/// Warns if too many samples have their largest value. A single bit has it as often as it is set.
pub(crate) fn saturation(
    capture: &Capture,
    summary: &Summary,
    sensor: Option<&Sensor>,
) -> Option<String> {
    let linear = sensor.filter(|sensor| sensor.response == Response::Linear);
    let max = capture.max_count().or(linear.map(Sensor::max_count))?;
    let binary = capture.info().binary;
    let range = summary.mean / f64::from(max);
    let samples: u64 = summary.histogram.iter().sum();
    let largest = summary.histogram.get(usize::from(max)).copied().unwrap_or(0);
    let saturated = largest as f64 / samples.max(1) as f64;
    let single_bits = binary && max == 1;
    let much = saturated > MAX_SATURATED_SHARE && !single_bits || range > MAX_ONES_SHARE && binary;
    let colour = if single_bits { None } else { saturated_colour(summary) };
    if let (false, Some((colour, share))) = (much, colour) {
        return Some(format!(
            "{:.1} % of the samples behind {} are saturated: bright parts are lower bounds and lose their colour; expose shorter, or weaken the light",
            100.0 * share,
            colour.name()
        ));
    }
    much.then(|| {
        format!(
            "{:.1} % of the samples are saturated ({:.1} % of the range on average): bright parts are lower bounds; expose shorter, or weaken the light",
            100.0 * saturated,
            100.0 * range
        )
    })
}

/// Returns the colour that saturates most, with its share, if that is too much.
fn saturated_colour(summary: &Summary) -> Option<(Colour, f64)> {
    let shares = Colour::ALL.into_iter().zip(summary.saturated_colours?);
    shares.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|&(_, share)| share > MAX_SATURATED_SHARE)
}

/// Warns if the chi-square of the counts is outside its usual range. Saturated samples do not vary, so that
/// a small one says nothing of a `saturated` capture.
pub(crate) fn of_chi_square(
    chi_square: Option<f64>,
    sensor: &Sensor,
    saturated: bool,
) -> Option<String> {
    let chi_square = chi_square.filter(|chi_square| !CHI_SQUARE_RANGE.contains(chi_square))?;
    if saturated && chi_square < 1.0 {
        return None;
    }
    let help = match (chi_square < 1.0, sensor.response) {
        (true, Response::Binary) => {
            "the counts vary less than their light allows: check --bits and --levels, and whether frames were averaged or filtered before"
        }
        (true, Response::Linear) => {
            "the counts vary less than the sensor's noise: check --sensor and its gain, and whether frames were averaged or filtered before"
        }
        (false, _) => {
            "the result does not explain its counts: check --sensor, --gain, --bits and --offset, sum fewer frames (--sum N), or try --method qbp-refined"
        }
    };
    Some(format!("chi-square is {chi_square:.3}, where 0.5 to 2 is usual: {help}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn saturation_explains_a_small_chi_square_alone() {
        let sensor = Sensor::load("qudi-paper").unwrap();
        let warns = |chi_square, saturated| of_chi_square(Some(chi_square), &sensor, saturated);
        assert!(warns(0.1, false).unwrap().contains("vary less"));
        assert_eq!(warns(0.1, true), None);
        assert!(warns(9.0, true).is_some() && warns(1.0, false).is_none());
    }
}
