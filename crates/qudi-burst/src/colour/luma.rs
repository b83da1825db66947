//! Luma from the counts of all colours, and its corrections by them.

use super::MergedColours;
use super::chroma::{BLURRED_SIGMA, Chroma, Colours};
use super::gray_counts::MIN_SEEN;
use super::guided::{Averages, gaussian};
use qudi_core::Frame;

/// Number of corrections of the first luma.
const CORRECTIONS: usize = 3;

/// Standard deviation in pixels of the Gaussian over which those are averaged: as noisy as its use allows,
/// since the counts of a pixel decide where they tell enough, and lost detail would be lost in them too.
const CORRECTION_SIGMA: f32 = 0.7;

/// Standard deviation in pixels of the Gaussian over which the correction of a restored luma is averaged.
const RESIDUAL_SIGMA: f32 = 1.0;

/// Part of that correction that is made: the rest is noise.
const RESIDUAL_PART: f32 = 0.4;

/// Range of a correction in units of luma.
const RANGE: [f32; 2] = [0.25, 4.0];

impl Colours<'_> {
    /// Computes luma and chroma from the counts around every pixel.
    pub(super) fn first(&self, merged: &MergedColours) -> (Frame, Chroma) {
        let size = merged.size;
        let mut luma = vec![0.0; size.pixels()];
        for (colour, share) in self.exposures.shares().into_iter().enumerate() {
            if share > 0.0 {
                let mean = self.mean[colour];
                let light = merged.light(colour, self.response, BLURRED_SIGMA, mean);
                for (luma, light) in luma.iter_mut().zip(light) {
                    *luma += share as f32 * light;
                }
            }
        }
        let least = self.least_luma();
        for luma in &mut luma {
            *luma = luma.max(least);
        }
        let ratios = self.around(merged, &luma, self.first_sigma());
        let chroma = self.constrained(size, Averages { ratios, variances: Default::default() });
        let mut luma = Frame { size, data: luma };
        for _ in 0..CORRECTIONS {
            luma = self.corrected(merged, luma, &chroma, CORRECTION_SIGMA, 1.0);
        }
        (luma, chroma)
    }

    /// Corrects a restored luma by what the counts tell beyond it.
    pub(super) fn completed(&self, merged: &MergedColours, luma: Frame, chroma: &Chroma) -> Frame {
        self.corrected(merged, luma, chroma, RESIDUAL_SIGMA, RESIDUAL_PART)
    }

    /// Corrects luma by the counts around every pixel, each of which tells as much as its law lets it: a step
    /// of Newton's method towards the most likely luma, of which `part` is made.
    fn corrected(
        &self,
        merged: &MergedColours,
        luma: Frame,
        chroma: &Chroma,
        sigma: f32,
        part: f32,
    ) -> Frame {
        let size = merged.size;
        let (evidence, information) = self.luma_score(merged, &luma, chroma);
        let evidence = gaussian(&evidence, size, sigma);
        let information = gaussian(&information, size, sigma);
        let least = self.least_luma();
        let value = |(i, &luma): (usize, &f32)| {
            let step = part * evidence[i] / information[i].max(f32::MIN_POSITIVE);
            (luma + step).clamp(RANGE[0] * luma.max(0.0), RANGE[1] * luma.max(0.0)).max(least)
        };
        Frame { size, data: luma.data.iter().enumerate().map(value).collect() }
    }

    /// Returns the score of luma over the counts of all colours, and its information (Fisher's), whose root
    /// is the standard deviation of the score.
    pub(super) fn luma_score(
        &self,
        merged: &MergedColours,
        luma: &Frame,
        chroma: &Chroma,
    ) -> (Vec<f32>, Vec<f32>) {
        let pixels = luma.size.pixels();
        let (mut score, mut information) = (vec![0.0; pixels], vec![0.0; pixels]);
        for (colour, seen) in self.exposures.responses().into_iter().enumerate() {
            for (i, &weight) in merged.weights[colour].iter().enumerate() {
                if weight > 0.0 {
                    let share = chroma.seen(i, seen).max(MIN_SEEN);
                    let own = self.response.at(share * luma.data[i], self.response.dark);
                    let told = share * own.slope / own.variance;
                    score[i] += told * (merged.counts[colour][i] - weight * own.mean);
                    information[i] += told * share * own.slope * weight;
                }
            }
        }
        (score, information)
    }
}
