//! Chroma: the ratios of red, green and blue to luma at every pixel.

use super::guided::{Guide, guided};
use super::{CountResponse, MergedColours};
use qudi_core::colour::{Colour, ColourFilter};
use qudi_core::{Frame, Size};

/// Standard deviation in pixels of the Gaussian that finds a first luma: as noisy as its use allows, since
/// the counts of a pixel decide where they tell enough.
const FIRST_LUMA_SIGMA: f32 = 1.5;

/// Ratio of the widths of Gaussians for first chroma and for the guided one.
const FIRST_CHROMA_WIDTH: f32 = 0.7;

/// Largest ratio of a colour to luma.
const MAX_RATIO: f32 = 12.0;

/// Least luma, in units of its mean, that has a colour.
const MIN_LUMA: f32 = 1e-3;

/// The ratios of red, green and blue to luma. The luma of the ratios is 1.
#[derive(Clone, Debug)]
pub(super) struct Chroma {
    pub(super) size: Size,
    pub(super) ratios: [Vec<f32>; 3],
}

/// The filter, its response, and the mean light of its colours.
pub(super) struct Colours<'a> {
    pub(super) filter: &'a ColourFilter,
    pub(super) response: &'a CountResponse,
    /// Mean light of red, green, blue and white pixels, in image units.
    pub(super) mean: [f32; 4],
    /// Standard deviation in pixels of the Gaussian over which chroma is averaged.
    pub(super) sigma: f32,
}

impl Colours<'_> {
    /// Returns the mean of luma.
    pub(super) fn mean_luma(&self) -> f32 {
        let shares = self.filter.shares();
        shares.iter().zip(self.mean).map(|(&share, mean)| share as f32 * mean).sum()
    }

    /// Computes luma and chroma from the counts around every pixel.
    pub(super) fn first(&self, merged: &MergedColours) -> (Frame, Chroma) {
        let size = merged.size;
        let mut luma = vec![0.0; size.pixels()];
        for (colour, share) in self.filter.shares().into_iter().enumerate() {
            if share > 0.0 {
                let mean = self.mean[colour];
                let light = merged.light(colour, self.response, FIRST_LUMA_SIGMA, mean);
                for (luma, light) in luma.iter_mut().zip(light) {
                    *luma += share as f32 * light;
                }
            }
        }
        let least = MIN_LUMA * self.mean_luma();
        for luma in &mut luma {
            *luma = luma.max(least);
        }
        let sigma = (FIRST_CHROMA_WIDTH * self.sigma).max(FIRST_LUMA_SIGMA);
        let ratios = std::array::from_fn(|k| {
            let light = merged.light(k, self.response, sigma, self.mean[k]);
            let local = merged.luma(k, &luma, sigma);
            light.iter().zip(local).map(|(light, luma)| light / luma.max(least)).collect()
        });
        (Frame { size, data: luma }, self.constrained(size, ratios))
    }

    /// Computes chroma from the counts around every pixel whose luma and chroma are alike.
    pub(super) fn refined(&self, merged: &MergedColours, luma: &Frame) -> Chroma {
        let least = MIN_LUMA * self.mean_luma();
        let guide = Guide::new(merged, luma, least);
        let first = self.constrained(merged.size, guided(&guide, self.response, self.sigma, None));
        let second = guided(&guide, self.response, self.sigma, Some(&first));
        self.constrained(merged.size, second)
    }

    /// Divides ratios of sensor colours to luma by their efficiencies, and scales them so that their luma is
    /// 1.
    fn constrained(&self, size: Size, mut ratios: [Vec<f32>; 3]) -> Chroma {
        let weights = self.filter.luma_weights().map(|weight| weight as f32);
        let efficiency = self.filter.efficiency().map(|efficiency| efficiency as f32);
        let neutral = 1.0 / weights.iter().sum::<f32>();
        for i in 0..size.pixels() {
            let mut sum = 0.0;
            for k in 0..3 {
                let ratio = (ratios[k][i] / efficiency[k]).clamp(0.0, MAX_RATIO * neutral);
                ratios[k][i] = ratio;
                sum += weights[k] * ratio;
            }
            for ratios in &mut ratios {
                ratios[i] = if sum > MIN_LUMA { ratios[i] / sum } else { neutral };
            }
        }
        Chroma { size, ratios }
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
}

/// Returns the response of every colour.
pub(super) fn responses(filter: &ColourFilter) -> [[f32; 3]; 4] {
    Colour::ALL.map(|colour| filter.response(colour).map(|weight| weight as f32))
}
