//! Patches of all blocks, aligned, become one: a Wiener filter over time in the frequency domain that
//! distrusts what does not fit the reference (Hasinoff et al. 2016, section 5; Ma et al. 2020,
//! section 5.2).

use super::dft::{Patch, SIDE, Spectrum, forward, inverse};

/// The patch of one block of frames.
#[derive(Clone, Debug)]
pub(crate) struct Member {
    /// Mean counts, warped onto the reference.
    pub(crate) patch: Patch,
    /// Frames behind it.
    pub(crate) frames: f32,
    /// Variance of its noise, in the variance of one frame's counts.
    pub(crate) noise: f32,
    /// An estimate of what it shows, if there is one: then that is what must fit.
    pub(crate) pilot: Option<Patch>,
}

/// Merges `members`, the reference first, whose frames have counts of `variance`. `trust` is the
/// squared difference, in that which noise makes, at which a member counts half. Returns the patch and the
/// variance of its noise, in that of one frame.
pub(crate) fn merge(members: &[Member], variance: f32, trust: f32) -> (Patch, f32) {
    let reference = forward(&members[0].patch);
    let pilot = members[0].pilot.as_ref().map(forward);
    let total: f32 = members.iter().map(|member| member.frames).sum();
    let share = members[0].frames / total;
    let mut sum = Spectrum { re: reference.re, im: reference.im };
    for row in sum.re.iter_mut().chain(&mut sum.im).flatten() {
        *row *= share;
    }
    // Of each coefficient: how much of it is the reference's, and the noise of the others.
    let mut own = [[share; SIDE]; SIDE];
    let mut noise = [[0.0f32; SIDE]; SIDE];
    for member in &members[1..] {
        let share = member.frames / total;
        let Spectrum { re, im } = forward(&member.patch);
        let powers = match (&pilot, &member.pilot) {
            (Some(pilot), Some(other)) => powers(&forward(other), pilot),
            _ => powers(&Spectrum { re, im }, &reference),
        };
        let expected = trust * (SIDE * SIDE) as f32 * variance * (members[0].noise + member.noise);
        for y in 0..SIDE {
            for x in 0..SIDE {
                let (dr, di) = (re[y][x] - reference.re[y][x], im[y][x] - reference.im[y][x]);
                let power = powers[y][x];
                let distrust = power / (power + expected).max(f32::MIN_POSITIVE);
                let kept = share * (1.0 - distrust);
                sum.re[y][x] += share * reference.re[y][x] + kept * dr;
                sum.im[y][x] += share * reference.im[y][x] + kept * di;
                own[y][x] += share - kept;
                noise[y][x] += kept * kept * member.noise;
            }
        }
    }
    let left = own.iter().flatten().zip(noise.iter().flatten());
    let left: f32 = left.map(|(own, others)| own * own * members[0].noise + others).sum();
    (inverse(sum), left / (SIDE * SIDE) as f32)
}

/// Powers of the difference's coefficients.
fn powers(a: &Spectrum, b: &Spectrum) -> Patch {
    std::array::from_fn(|y| {
        std::array::from_fn(|x| {
            let (dr, di) = (a.re[y][x] - b.re[y][x], a.im[y][x] - b.im[y][x]);
            dr * dr + di * di
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn member(patch: &Patch) -> Member {
        Member { patch: *patch, frames: 1.0, noise: 1.0, pilot: None }
    }

    fn texture(seed: usize) -> Patch {
        std::array::from_fn(|y| {
            std::array::from_fn(|x| ((x * 13 + y * 29 + seed * (x + 3) * (y + 7)) % 23) as f32)
        })
    }

    #[test]
    fn equal_patches_merge_into_themselves() {
        let (merged, noise) = merge(&vec![member(&texture(1)); 7], 0.5, 4.0);
        for (a, b) in merged.iter().flatten().zip(texture(1).iter().flatten()) {
            assert!((a - b).abs() < 1e-4);
        }
        assert!((noise - 1.0 / 7.0).abs() < 1e-4, "a mean of seven: {noise}");
    }

    #[test]
    fn what_does_not_fit_is_left_out() {
        let other = texture(5).map(|row| row.map(|v| 40.0 - 3.0 * v));
        let (merged, noise) = merge(&[member(&texture(1)), member(&other)], 1e-4, 4.0);
        for (a, b) in merged.iter().flatten().zip(texture(1).iter().flatten()) {
            assert!((a - b).abs() < 0.05, "{a} {b}");
        }
        assert!(noise > 0.95, "{noise}");
        // With noise that large they could be the same.
        let (_, noise) = merge(&[member(&texture(1)), member(&other)], 1e4, 4.0);
        assert!(noise < 0.55, "{noise}");
    }

    /// However much the patches differ, if their pilots agree: that was noise.
    #[test]
    fn pilots_decide_what_fits() {
        let pair = |pilots: [Patch; 2]| {
            let [a, b] = pilots.map(Some);
            let other = texture(5).map(|row| row.map(|v| 40.0 - 3.0 * v));
            [Member { pilot: a, ..member(&texture(1)) }, Member { pilot: b, ..member(&other) }]
        };
        let (_, alike) = merge(&pair([texture(2), texture(2)]), 1e-4, 4.0);
        assert!((alike - 0.5).abs() < 1e-4, "{alike}");
        let (_, apart) = merge(&pair([texture(2), texture(9)]), 1e-4, 4.0);
        assert!(apart > 0.9, "{apart}");
    }

    #[test]
    fn members_without_noise_or_light_are_no_trouble() {
        let black = [[0.0; SIDE]; SIDE];
        let (merged, _) = merge(&[member(&black), member(&black)], 0.0, 4.0);
        assert!(merged.iter().flatten().all(|v| *v == 0.0));
    }
}
