//! Robust merge of aligned patches: a Wiener filter over time in the frequency domain. Coefficients that
//! differ from the reference get little weight (Hasinoff et al. 2016, section 5; Ma et al. 2020, section
//! 5.2).

use super::dft16::{Spectrum, forward, inverse};
use crate::patch::{Patch, SIDE};
use multiversion::multiversion;

/// The patch of a block of frames, aligned with the reference.
#[derive(Clone, Debug)]
pub(crate) struct AlignedPatch {
    /// Mean counts, warped onto the reference.
    pub(crate) patch: Patch,
    /// Number of frames in the block.
    pub(crate) frames: f32,
    /// Noise variance of the patch, in units of the variance of one frame's counts.
    pub(crate) noise: f32,
}

/// Merges `patches`, the reference first. Counts of single frames have the given `variance`. A coefficient
/// gets half its weight where its squared difference is `wiener_c` times the expected squared difference of
/// noise. Returns the patch and its noise variance, in units of the variance of one frame's counts.
pub(crate) fn merge(patches: &[AlignedPatch], variance: f32, wiener_c: f32) -> (Patch, f32) {
    let spectra = spectra(patches.iter().map(|aligned| &aligned.patch));
    merge_spectra(patches, &spectra, &spectra, variance, wiener_c)
}

/// Merges `patches` like [`merge`], but computes the weights of the coefficients on `shown`, estimates of the
/// same patches with less noise.
pub(crate) fn merge_by_reference(
    patches: &[AlignedPatch],
    shown: &[Patch],
    variance: f32,
    wiener_c: f32,
) -> (Patch, f32) {
    let (spectra, shown) =
        (spectra(patches.iter().map(|aligned| &aligned.patch)), spectra(shown.iter()));
    merge_spectra(patches, &spectra, &shown, variance, wiener_c)
}

/// Computes the spectra of patches in place: moving them would take as long as half a transform.
fn spectra<'a>(patches: impl ExactSizeIterator<Item = &'a Patch>) -> Vec<Spectrum> {
    let mut spectra = vec![Spectrum::ZERO; patches.len()];
    for (patch, spectrum) in patches.zip(&mut spectra) {
        forward(patch, spectrum);
    }
    spectra
}

/// Merges the `spectra` of `patches`. The weight of each coefficient follows from the difference between its
/// `criterion` and the reference's.
#[multiversion(targets("x86_64+avx2"))]
fn merge_spectra(
    patches: &[AlignedPatch],
    spectra: &[Spectrum],
    criterion: &[Spectrum],
    variance: f32,
    wiener_c: f32,
) -> (Patch, f32) {
    let reference = &spectra[0];
    let total: f32 = patches.iter().map(|aligned| aligned.frames).sum();
    let share = patches[0].frames / total;
    let mut sum = reference.clone();
    for row in sum.re.iter_mut().chain(&mut sum.im).flatten() {
        *row *= share;
    }
    // For each coefficient: the reference's share, and the noise of the others.
    let mut own = [[share; SIDE]; SIDE];
    let mut noise = [[0.0f32; SIDE]; SIDE];
    for (k, aligned) in patches.iter().enumerate().skip(1) {
        let share = aligned.frames / total;
        let Spectrum { re, im } = &spectra[k];
        let powers = powers(&criterion[k], &criterion[0]);
        let expected =
            wiener_c * (SIDE * SIDE) as f32 * variance * (patches[0].noise + aligned.noise);
        for y in 0..SIDE {
            for x in 0..SIDE {
                let (dr, di) = (re[y][x] - reference.re[y][x], im[y][x] - reference.im[y][x]);
                let power = powers[y][x];
                let rejected = power / (power + expected).max(f32::MIN_POSITIVE);
                let kept = share * (1.0 - rejected);
                sum.re[y][x] += share * reference.re[y][x] + kept * dr;
                sum.im[y][x] += share * reference.im[y][x] + kept * di;
                own[y][x] += share - kept;
                noise[y][x] += kept * kept * aligned.noise;
            }
        }
    }
    let left = own.iter().flatten().zip(noise.iter().flatten());
    let left: f32 = left.map(|(own, others)| own * own * patches[0].noise + others).sum();
    (inverse(sum), left / (SIDE * SIDE) as f32)
}

/// Returns the squared magnitudes of the coefficients of `a - b`.
#[inline(always)]
fn powers(a: &Spectrum, b: &Spectrum) -> Patch {
    let mut powers = [[0.0; SIDE]; SIDE];
    for y in 0..SIDE {
        for x in 0..SIDE {
            let (dr, di) = (a.re[y][x] - b.re[y][x], a.im[y][x] - b.im[y][x]);
            powers[y][x] = dr * dr + di * di;
        }
    }
    powers
}

#[cfg(test)]
mod tests {
    use super::*;

    fn aligned(patch: &Patch) -> AlignedPatch {
        AlignedPatch { patch: *patch, frames: 1.0, noise: 1.0 }
    }

    fn texture(seed: usize) -> Patch {
        std::array::from_fn(|y| {
            std::array::from_fn(|x| ((x * 13 + y * 29 + seed * (x + 3) * (y + 7)) % 23) as f32)
        })
    }

    #[test]
    fn merges_equal_patches_into_themselves() {
        let (merged, noise) = merge(&vec![aligned(&texture(1)); 7], 0.5, 4.0);
        for (a, b) in merged.iter().flatten().zip(texture(1).iter().flatten()) {
            assert!((a - b).abs() < 1e-4);
        }
        assert!((noise - 1.0 / 7.0).abs() < 1e-4, "a mean of seven: {noise}");
    }

    #[test]
    fn leaves_out_what_does_not_fit() {
        let other = texture(5).map(|row| row.map(|v| 40.0 - 3.0 * v));
        let (merged, noise) = merge(&[aligned(&texture(1)), aligned(&other)], 1e-4, 4.0);
        for (a, b) in merged.iter().flatten().zip(texture(1).iter().flatten()) {
            assert!((a - b).abs() < 0.05, "{a} {b}");
        }
        assert!(noise > 0.95, "{noise}");
        // With noise this large, both could be the same.
        let (_, noise) = merge(&[aligned(&texture(1)), aligned(&other)], 1e4, 4.0);
        assert!(noise < 0.55, "{noise}");
    }

    /// Checks that patches are merged if their estimates agree, however much the patches themselves differ.
    #[test]
    fn reference_patches_decide_what_fits() {
        let other = texture(5).map(|row| row.map(|v| 40.0 - 3.0 * v));
        let pair = [aligned(&texture(1)), aligned(&other)];
        let (_, alike) = merge_by_reference(&pair, &[texture(2), texture(2)], 1e-4, 4.0);
        assert!((alike - 0.5).abs() < 1e-4, "{alike}");
        let (_, apart) = merge_by_reference(&pair, &[texture(2), texture(9)], 1e-4, 4.0);
        assert!(apart > 0.9, "{apart}");
    }

    #[test]
    fn merges_patches_without_noise_or_light() {
        let black = [[0.0; SIDE]; SIDE];
        let (merged, _) = merge(&[aligned(&black), aligned(&black)], 0.0, 4.0);
        assert!(merged.iter().flatten().all(|v| *v == 0.0));
    }
}
