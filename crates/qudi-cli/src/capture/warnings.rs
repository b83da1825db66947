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

/// Returns the warnings on a capture itself.
pub(crate) fn of_capture(capture: &Capture, summary: &Summary) -> Vec<String> {
    let mut warnings = Vec::new();
    warnings.extend(capture.filter_contradiction().map(str::to_owned));
    warnings.extend(saturation(capture, summary));
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
    if let Some(contrast) = summary.mosaic {
        warnings.push(format!(
            "pixels of a tile of 2 x 2 differ by {:.0} % all over the picture, as behind a colour filter array: name it (--cfa rggb@0,0, or the phase that your camera has), or colours are restored as texture",
            100.0 * contrast
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
fn saturation(capture: &Capture, summary: &Summary) -> Option<String> {
    let max = capture.max_count()?;
    let binary = capture.info().binary;
    let range = summary.mean / f64::from(max);
    let saturated = summary.saturated.unwrap_or(0.0);
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

/// Warns if the chi-square of the counts is outside its usual range.
pub(crate) fn of_chi_square(chi_square: Option<f64>, sensor: &Sensor) -> Option<String> {
    let chi_square = chi_square.filter(|chi_square| !CHI_SQUARE_RANGE.contains(chi_square))?;
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
