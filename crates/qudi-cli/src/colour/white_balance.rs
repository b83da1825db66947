//! White balance: the gains that make gray things gray.

use qudi_core::restorer::Acquisition;
use qudi_io::capture::{Capture, Summary};
use std::str::FromStr;

/// Side of the blocks whose colours are measured.
const BLOCK: usize = 8;

/// Share of the blocks, the brightest unsaturated ones, that are taken for gray.
const GRAY_SHARE: f64 = 0.01;

/// Least number of those blocks.
const MIN_BLOCKS: usize = 8;

/// Share of full scale beyond which a block counts as saturated.
const SATURATION: f64 = 0.8;

/// Range of guessed gains.
const GAIN_RANGE: [f64; 2] = [0.1, 10.0];

/// Gains of red, green and blue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Gains(pub(crate) [f64; 3]);

impl FromStr for Gains {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Vec<f64> = text.split(',').flat_map(|part| part.trim().parse()).collect();
        let possible = |gain: &f64| (1e-3..=1e3).contains(gain);
        match *numbers.as_slice() {
            [red, green, blue] if text.split(',').count() == 3 && numbers.iter().all(possible) => {
                Ok(Self([red, green, blue]))
            }
            _ => Err("expected the gains of red, green and blue, as in 1.9,1,1.6".to_owned()),
        }
    }
}

/// Guesses the gains: the brightest unsaturated blocks of the measured frames are taken for gray.
pub(super) fn guessed_gains(
    capture: &Capture,
    summary: &Summary,
    acquisition: &Acquisition,
) -> Gains {
    let (Some(filter), size) = (capture.filter(), capture.size()) else { return Gains([1.0; 3]) };
    let across = size.width.div_ceil(BLOCK);
    let mut blocks = vec![[(0u64, 0u64); 3]; across * size.height.div_ceil(BLOCK)];
    for (i, (&sum, &colour)) in summary.sums.iter().zip(filter.colours()).enumerate() {
        let (y, x) = (i / size.width, i % size.width);
        if let Some(of) = blocks[y / BLOCK * across + x / BLOCK].get_mut(colour as usize) {
            *of = (of.0 + u64::from(sum), of.1 + 1);
        }
    }
    let sensor = &acquisition.sensor;
    let dark = sensor.dark_per_frame().unwrap_or(0.0);
    let frames = summary.sampled as f64;
    let most = SATURATION * f64::from(sensor.max_count());
    let light = |block: &[(u64, u64); 3]| -> Option<[f64; 3]> {
        let mut light = [0.0; 3];
        for (k, &(sum, pixels)) in block.iter().enumerate() {
            let mean = sum as f64 / (pixels as f64 * frames);
            if pixels == 0 || mean > most {
                return None;
            }
            let flux = sensor.estimate_flux(mean, 1, acquisition.gain, dark);
            light[k] = flux / filter.efficiency()[k];
        }
        Some(light)
    };
    let mut measured: Vec<[f64; 3]> = blocks.iter().filter_map(light).collect();
    measured.sort_by(|a, b| b.iter().sum::<f64>().total_cmp(&a.iter().sum()));
    let gray = ((GRAY_SHARE * measured.len() as f64).ceil() as usize).max(MIN_BLOCKS);
    let mut sum = [0.0; 3];
    for light in measured.iter().take(gray) {
        for (sum, light) in sum.iter_mut().zip(light) {
            *sum += light;
        }
    }
    let gain = |value: f64| {
        let gain = if value > 0.0 { sum[1] / value } else { 1.0 };
        gain.clamp(GAIN_RANGE[0], GAIN_RANGE[1])
    };
    Gains(if sum[1] > 0.0 { sum.map(gain) } else { [1.0; 3] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gains_are_three_positive_numbers() {
        assert_eq!("1.9, 1,1.6".parse(), Ok(Gains([1.9, 1.0, 1.6])));
        for text in ["", "1,2", "1,2,3,4", "1,0,1", "1,x,2", "1,inf,1", "1,x,1,1"] {
            assert!(text.parse::<Gains>().is_err(), "{text}");
        }
    }
}
