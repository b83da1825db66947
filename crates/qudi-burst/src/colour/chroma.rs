//! Chroma: the ratios of red, green and blue to luma at every pixel.

use super::guided::{Averages, Guide, guided};
use super::{CountResponse, Evidence, Exposures, MergedColours};
use qudi_core::{Frame, Size};

/// Ratio of the widths of Gaussians for first chroma and for the guided one.
const FIRST_CHROMA_WIDTH: f32 = 0.7;

/// Standard deviation in pixels of the Gaussian that finds the luma and the chroma to begin with.
pub(super) const BLURRED_SIGMA: f32 = 1.5;

/// Largest ratio of a colour to luma.
const MAX_RATIO: f32 = 12.0;

/// Least luma, in units of its mean, that has a colour.
const MIN_LUMA: f32 = 1e-3;

/// The ratios of red, green and blue to luma. The luma of the ratios is 1.
#[derive(Clone, Debug)]
pub(super) struct Chroma {
    pub(super) size: Size,
    pub(super) ratios: [Vec<f32>; 3],
    /// Variances of the errors of ratios.
    pub(super) variances: [Vec<f32>; 3],
}

/// The exposures of a capture, their response, and the mean light of their colours.
pub(super) struct Colours<'a> {
    pub(super) exposures: &'a Exposures<'a>,
    pub(super) response: &'a CountResponse,
    /// Mean light of red, green, blue and white pixels, in image units.
    pub(super) mean: [f32; 4],
    /// Standard deviation in pixels of the Gaussian over which chroma is averaged.
    pub(super) sigma: f32,
}

impl Colours<'_> {
    /// Returns the mean of luma.
    pub(super) fn mean_luma(&self) -> f32 {
        let shares = self.exposures.shares();
        shares.iter().zip(self.mean).map(|(&share, mean)| share as f32 * mean).sum()
    }

    /// Returns the least luma that has a colour.
    pub(super) fn least_luma(&self) -> f32 {
        MIN_LUMA * self.mean_luma()
    }

    /// Returns the ratios of sensor colours to luma over all counts around every pixel.
    pub(super) fn around(&self, merged: &MergedColours, luma: &[f32], sigma: f32) -> [Vec<f32>; 3] {
        let least = self.least_luma();
        let first = std::array::from_fn(|k| {
            let light = merged.light(k, self.response, sigma, self.mean[k]);
            let local = merged.luma(k, luma, sigma);
            light.iter().zip(local).map(|(light, luma)| light / luma.max(least)).collect()
        });
        let evidence = Evidence::new(merged, self.response, luma, &first);
        std::array::from_fn(|k| evidence.around(merged, self.response, k, sigma, &first[k]))
    }

    /// Computes chroma from the counts around every pixel whose luma and chroma are alike.
    pub(super) fn refined(&self, merged: &MergedColours, luma: &Frame) -> Chroma {
        let guide = Guide::new(luma, self.least_luma());
        let sigma = self.first_sigma();
        let around = self.around(merged, &guide.luma, sigma);
        let evidence = Evidence::new(merged, self.response, &guide.luma, &around);
        let first = guided(&guide, &evidence, merged.size, self.sigma, (&around, None));
        let first = self.constrained(merged.size, self.shrunk(merged, &evidence, first));
        let seen = self.seen_ratios(&first);
        let evidence = Evidence::new(merged, self.response, &guide.luma, &seen);
        let second = guided(&guide, &evidence, merged.size, self.sigma, (&seen, Some(&first)));
        self.constrained(merged.size, self.shrunk(merged, &evidence, second))
    }

    /// Returns the ratios of sensor colours to luma.
    pub(super) fn seen_ratios(&self, chroma: &Chroma) -> [Vec<f32>; 3] {
        let efficiency = self.exposures.efficiency();
        std::array::from_fn(|k| {
            chroma.ratios[k].iter().map(|ratio| ratio * efficiency[k]).collect()
        })
    }

    /// Returns the standard deviation in pixels over which a first chroma is averaged.
    pub(super) fn first_sigma(&self) -> f32 {
        (FIRST_CHROMA_WIDTH * self.sigma).max(BLURRED_SIGMA)
    }

    /// Divides ratios of sensor colours to luma by their efficiencies, and scales them so that their luma is
    /// 1.
    pub(super) fn constrained(&self, size: Size, averages: Averages) -> Chroma {
        let weights = self.exposures.luma_weights();
        let efficiency = self.exposures.efficiency();
        let neutral = 1.0 / weights.iter().sum::<f32>();
        let Averages { mut ratios, mut variances } = averages;
        for i in 0..size.pixels() {
            let mut sum = 0.0;
            for k in 0..3 {
                let ratio = (ratios[k][i] / efficiency[k]).clamp(0.0, MAX_RATIO * neutral);
                ratios[k][i] = ratio;
                sum += weights[k] * ratio;
            }
            for k in 0..3 {
                ratios[k][i] = if sum > MIN_LUMA { ratios[k][i] / sum } else { neutral };
                if let Some(variance) = variances[k].get_mut(i) {
                    *variance /= (efficiency[k] * sum.max(MIN_LUMA)).powi(2);
                }
            }
        }
        Chroma { size, ratios, variances }
    }
}

impl Chroma {
    /// Returns what a pixel behind `response` sees of light of luma 1.
    pub(super) fn seen(&self, i: usize, response: [f32; 3]) -> f32 {
        (0..3).map(|k| response[k] * self.ratios[k][i]).sum()
    }

    /// Multiplies the ratios with luma.
    pub(super) fn coloured(&self, luma: &Frame) -> [Frame; 3] {
        std::array::from_fn(|k| {
            let product = self.ratios[k].iter().zip(&luma.data).map(|(ratio, luma)| ratio * luma);
            Frame { size: self.size, data: product.collect() }
        })
    }

    /// Returns the standard deviations of colours from the ones of luma, `sigma`, and of the ratios.
    pub(super) fn uncertainty(&self, luma: &Frame, sigma: &Frame) -> [Frame; 3] {
        std::array::from_fn(|k| {
            let of_pixel = |i: usize| {
                let of_ratio = luma.data[i] * self.variances[k][i].sqrt();
                (self.ratios[k][i] * sigma.data[i]).hypot(of_ratio)
            };
            Frame { size: self.size, data: (0..self.size.pixels()).map(of_pixel).collect() }
        })
    }
}
