//! Corrections of restored colours by a network, and what it is told.

use super::chroma::{Chroma, Colours};
use super::guided::gaussian;
use super::{Evidence, MergedColours};
use qudi_core::{Frame, Result, Size};

/// What the counts of a window tell of the colours of one frame, beyond what was restored.
#[derive(Clone, Debug)]
pub struct ColourEvidence {
    /// Size of the frame.
    pub size: Size,
    /// Number of the frame in its window.
    pub frame: usize,
    /// [`ColourEvidence::PLANES`] images, one after the other: luma in units of its mean (1); ratios of red,
    /// green and blue to luma, 1 of gray (3); scores of the ratios, the merged counts of a colour beyond
    /// their mean, in standard deviations (3); the standard deviations by which a score changes when a ratio
    /// changes by 1 (3); standard deviations of the ratios' errors (3); the score of luma over all colours
    /// (1); the standard deviations by which it changes when the logarithm of luma changes by 1 (1).
    pub planes: Vec<f32>,
    /// Weights of red, green and blue in luma; their sum is 1.
    pub weights: [f32; 3],
}

impl ColourEvidence {
    /// Number of images.
    pub const PLANES: usize = 15;
}

/// Corrected colours of one frame.
#[derive(Clone, Debug)]
pub struct CorrectedColours {
    /// Factors of luma.
    pub luma: Vec<f32>,
    /// Ratios of red, green and blue to luma, 1 of gray.
    pub ratios: [Vec<f32>; 3],
}

/// A network that corrects restored colours.
pub trait ColourCorrector: Send + Sync {
    /// Corrects the colours of a frame.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the device fails.
    fn correct(&self, evidence: &ColourEvidence) -> Result<CorrectedColours>;
}

impl Colours<'_> {
    /// Corrects restored colours by `corrector`.
    pub(super) fn corrected_by(
        &self,
        corrector: &dyn ColourCorrector,
        merged: &MergedColours,
        (luma, chroma): (Frame, Chroma),
        frame: usize,
    ) -> Result<(Frame, Chroma)> {
        let evidence = self.colour_evidence(merged, &luma, &chroma, frame);
        let corrected = corrector.correct(&evidence)?;
        let least = self.least_luma();
        let factors = luma.data.iter().zip(&corrected.luma);
        let data = factors.map(|(luma, factor)| (luma * factor).max(least)).collect();
        let neutral = 1.0 / self.exposures.luma_weights().iter().sum::<f32>();
        let kept = share_kept(&chroma.ratios, neutral, luma.size);
        let mut ratios = chroma.ratios;
        for (ratios, corrected) in ratios.iter_mut().zip(&corrected.ratios) {
            for ((ratio, corrected), kept) in ratios.iter_mut().zip(corrected).zip(&kept) {
                *ratio += kept * (neutral * corrected - *ratio);
            }
        }
        Ok((Frame { size: luma.size, data }, Chroma { ratios, ..chroma }))
    }

    /// Compares restored colours with the merged counts.
    fn colour_evidence(
        &self,
        merged: &MergedColours,
        luma: &Frame,
        chroma: &Chroma,
        frame: usize,
    ) -> ColourEvidence {
        let size = luma.size;
        let pixels = size.pixels();
        let weights = self.exposures.luma_weights();
        let total: f32 = weights.iter().sum();
        let efficiency = self.exposures.efficiency();
        let seen = self.seen_ratios(chroma);
        let evidence = Evidence::new(merged, self.response, &luma.data, &seen);
        let mean = self.mean_luma().max(f32::MIN_POSITIVE);
        let mut planes = Vec::with_capacity(ColourEvidence::PLANES * pixels);
        planes.extend(luma.data.iter().map(|luma| luma / mean));
        for ratios in &chroma.ratios {
            planes.extend(ratios.iter().map(|ratio| ratio * total));
        }
        let in_sigmas = |value: f32, variance: f32| {
            if variance > MIN_VARIANCE { value / variance.sqrt() } else { 0.0 }
        };
        let Evidence { counts, slopes, variances } = &evidence;
        for k in 0..3 {
            let excess = |i: usize| counts[k][i] - slopes[k][i] * seen[k][i];
            planes.extend((0..pixels).map(|i| in_sigmas(excess(i), variances[k][i])));
        }
        for k in 0..3 {
            let scale = efficiency[k] / total;
            planes.extend((0..pixels).map(|i| in_sigmas(scale * slopes[k][i], variances[k][i])));
        }
        for variances in &chroma.variances {
            planes.extend(variances.iter().map(|variance| total * variance.max(0.0).sqrt()));
        }
        let (score, information) = self.luma_score(merged, luma, chroma);
        planes.extend(score.iter().zip(&information).map(|(&s, &all)| in_sigmas(s, all)));
        let precision = |(all, luma): (&f32, &f32)| all.max(0.0).sqrt() * luma;
        planes.extend(information.iter().zip(&luma.data).map(precision));
        let weights = weights.map(|weight| weight / total);
        ColourEvidence { size, frame, planes, weights }
    }
}

/// Returns the share of a correction that is made at every pixel: little where the colours around it differ
/// little from the frame's mean, so that a gray scene stays gray. `neutral` is the ratio of gray.
fn share_kept(ratios: &[Vec<f32>; 3], neutral: f32, size: Size) -> Vec<f32> {
    let mut squares = vec![0.0f32; size.pixels()];
    for ratios in ratios {
        let mean = ratios.iter().sum::<f32>() / ratios.len() as f32;
        for (square, ratio) in squares.iter_mut().zip(ratios) {
            *square = square.max(((ratio - mean) / neutral).powi(2));
        }
    }
    let around = gaussian(&squares, size, EVEN_WIDTH);
    let inside = gaussian(&vec![1.0; size.pixels()], size, EVEN_WIDTH);
    let share = |(square, inside): (&f32, &f32)| {
        let square = square / inside;
        square / (square + EVEN * EVEN)
    };
    around.iter().zip(&inside).map(share).collect()
}

/// Root mean square of the ratios' differences from their means, 1 of gray, at which half of a correction is
/// made.
const EVEN: f32 = 0.1;

/// Standard deviation in pixels of the Gaussian over which it is averaged.
const EVEN_WIDTH: f32 = 4.0;

/// Least variance of counts, and least information, that tell anything.
const MIN_VARIANCE: f32 = 1e-9;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrections_of_even_colours_are_not_made() {
        let size = Size { height: 24, width: 32 };
        let even = std::array::from_fn(|_| vec![2.0; size.pixels()]);
        assert!(share_kept(&even, 2.0, size).iter().all(|share| *share == 0.0));
        // One half of the frame is red, the other gray.
        let plane = |of_half: [f32; 2]| -> Vec<f32> {
            (0..size.pixels()).map(|i| of_half[usize::from(i % size.width < 16)]).collect()
        };
        let halves = [plane([2.0, 4.0]), plane([2.0, 1.0]), plane([2.0, 1.0])];
        let share = share_kept(&halves, 2.0, size);
        // Red differs from its mean by half of gray's ratio on either side.
        for share in &share {
            assert!((share - 0.25 / (0.25 + 0.01)).abs() < 1e-4, "{share}");
        }
    }
}
