//! Per-pixel selection of motion. A patch has one motion, but at motion boundaries it contains two. The
//! reference frames around each pixel select among the motions of the surrounding patches.

use super::reference_frames::ReferenceFrames;
use crate::patch::{Patch, PatchMotion, SIDE, inside};
use crate::prepared_burst::PreparedBurst;
use multiversion::multiversion;
use qudi_core::Frame;
use rayon::prelude::*;

/// Radius of the compared squares, in pixels.
const RADIUS: usize = 2;

/// Minimum difference in a component between two distinct motions, in pixels.
const MIN_MOTION_DIFFERENCE: f32 = 0.4;

/// Penalty of any other motion than the patch's own, in units of the noise variance of two pixels'
/// difference. Without it, noise would choose where all motions fit.
const SWITCH_PENALTY: f32 = 0.1;

/// Number of pixels in a square.
const AREA: f32 = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;

/// Warps the counts of frame `k` and its estimate onto the reference, each pixel along the motion that makes
/// the estimates most alike. Candidates are the `motions` of the patch and of the patches around it. The
/// patch's first motion is kept where all fit.
pub(crate) fn per_pixel_selection(
    burst: &PreparedBurst,
    references: &ReferenceFrames,
    reference: usize,
    k: usize,
    motions: [&PatchMotion; 2],
) -> [Frame; 2] {
    let sample = |image: &Frame, i, d| references.sample(burst, image, i, d, reference);
    let estimates = &references.frames;
    let variance = burst.matching_variance(reference, references.error_variance);
    let switch_penalty = AREA * SWITCH_PENALTY * variance;
    let motions = motions.map(|motion| &motion[k]);
    let patch = |i: usize| {
        let here = sample(&estimates[reference], i, [0.0; 2]);
        let around = motions_around(burst, i, motions);
        let mut least = [[f32::INFINITY; SIDE]; SIDE];
        let mut best = [[[0.0; SIDE]; SIDE]; 2];
        for (number, &d) in around.iter().enumerate() {
            let there = sample(&estimates[k], i, d);
            let mut misfit = misfit(&here, &there);
            exclude_outside(burst, &mut misfit, i, d);
            let own = number == 0;
            // Most motions fit no pixel better, and their counts need not be sampled.
            if !own && !fits_anywhere(&mut misfit, switch_penalty, &least) {
                continue;
            }
            let counts = sample(&burst.frames[k], i, d);
            take_better(&misfit, &mut least, [&counts, &there], &mut best, own);
        }
        best
    };
    let patches: Vec<[Patch; 2]> = (0..burst.grid.len()).into_par_iter().map(patch).collect();
    [0, 1].map(|image| burst.blended(|i| &patches[i][image]))
}

/// Adds the `switch_penalty` to a misfit, and returns true if any pixel then fits better than its least
/// misfit so far.
#[multiversion(targets("x86_64+avx2"))]
fn fits_anywhere(misfit: &mut Patch, switch_penalty: f32, least: &Patch) -> bool {
    let mut lowest = [f32::INFINITY; SIDE];
    for y in 0..SIDE {
        for x in 0..SIDE {
            misfit[y][x] += switch_penalty;
            let better = misfit[y][x] < least[y][x];
            lowest[x] = if better { -1.0 } else { lowest[x] };
        }
    }
    lowest.iter().any(|&value| value < 0.0)
}

/// Replaces the pixels that fit better, or all of them if `all` is set.
#[multiversion(targets("x86_64+avx2"))]
fn take_better(
    misfit: &Patch,
    least: &mut Patch,
    [counts, there]: [&Patch; 2],
    best: &mut [Patch; 2],
    all: bool,
) {
    let [best_counts, best_there] = best;
    for y in 0..SIDE {
        for x in 0..SIDE {
            let better = all || misfit[y][x] < least[y][x];
            least[y][x] = if better { misfit[y][x] } else { least[y][x] };
            best_counts[y][x] = if better { counts[y][x] } else { best_counts[y][x] };
            best_there[y][x] = if better { there[y][x] } else { best_there[y][x] };
        }
    }
}

/// Lists the distinct motions of patch `i` and of the patches that touch it, and rest.
fn motions_around(burst: &PreparedBurst, i: usize, motions: [&Vec<[f32; 2]>; 2]) -> Vec<[f32; 2]> {
    let mut distinct: Vec<[f32; 2]> = Vec::with_capacity(20);
    let all = motions.iter().flat_map(|motion| {
        std::iter::once(i).chain(burst.grid.touching(i)).map(|patch| motion[patch])
    });
    for d in all.chain(std::iter::once([0.0; 2])) {
        let known = |m: &[f32; 2]| {
            (m[0] - d[0]).abs() < MIN_MOTION_DIFFERENCE
                && (m[1] - d[1]).abs() < MIN_MOTION_DIFFERENCE
        };
        if !distinct.iter().any(known) {
            distinct.push(d);
        }
    }
    distinct
}

/// Sets the misfit of pixels outside the image to infinity.
fn exclude_outside(burst: &PreparedBurst, misfit: &mut Patch, i: usize, d: [f32; 2]) {
    let corner = burst.grid.corner(i);
    let size = burst.padded_size();
    let columns = inside(corner[0] as f32 + d[0], size.width);
    let rows = inside(corner[1] as f32 + d[1], size.height);
    if columns.len() * rows.len() == SIDE * SIDE {
        return;
    }
    for (y, row) in misfit.iter_mut().enumerate() {
        for (x, value) in row.iter_mut().enumerate() {
            if !rows.contains(&y) || !columns.contains(&x) {
                *value = f32::INFINITY;
            }
        }
    }
}

/// Sums squared differences over the square around each pixel, clipped to the patch.
#[multiversion(targets("x86_64+avx2"))]
fn misfit(a: &Patch, b: &Patch) -> Patch {
    let mut rows = [[0.0f32; SIDE]; SIDE + 2 * RADIUS];
    for y in 0..SIDE {
        let mut squares = [0.0f32; SIDE + 2 * RADIUS];
        for x in 0..SIDE {
            let difference = a[y][x] - b[y][x];
            squares[x + RADIUS] = difference * difference;
        }
        for x in 0..SIDE {
            rows[y + RADIUS][x] = squares[x..=x + 2 * RADIUS].iter().sum();
        }
    }
    let mut sums = [[0.0f32; SIDE]; SIDE];
    for y in 0..SIDE {
        for row in &rows[y..=y + 2 * RADIUS] {
            for (sum, value) in sums[y].iter_mut().zip(row) {
                *sum += value;
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::Size;
    use qudi_core::restorer::{Acquisition, BurstView};
    use qudi_core::sensor::Sensor;

    const SIZE: Size = Size { height: 64, width: 80 };

    /// Returns the mean counts of two textures. The right one is static; the left one is in front and moves
    /// by three pixels per frame.
    fn scene(t: usize) -> Frame {
        Frame::from_fn(SIZE, |x, y| {
            let (x, y) = (x as f32, y as f32);
            let front = x < 20.0 + 3.0 * t as f32;
            let x = if front { x - 3.0 * t as f32 } else { x };
            let phase = if front { 0.0 } else { 1.5 };
            3.0 + (0.7 * x + 0.3 * y + phase).sin() + (0.5 * y - 0.4 * x + 2.0 * phase).cos()
        })
    }

    /// Returns the errors of frame 1 warped onto frame 4 by patches and by pixels, where patches left of
    /// `border` move with the front.
    fn errors(border: usize) -> [f32; 2] {
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        let acquisition = Acquisition::new(sensor, 3.25, 0.45).unwrap_or_else(|e| panic!("{e}"));
        let counts = vec![vec![3; SIZE.pixels()]; 6];
        let view = BurstView { size: SIZE, frames: &counts };
        let burst = PreparedBurst::new(view, &acquisition);
        let frames: Vec<Frame> = (0..6).map(scene).collect();
        let references = ReferenceFrames::new(&burst, frames.clone(), 0.1);
        let motion =
            |i| if burst.grid.corner(i)[0] + SIDE / 2 < border { [-9.0, 0.0] } else { [0.0; 2] };
        let there: Vec<[f32; 2]> = (0..burst.grid.len()).map(motion).collect();
        let rest = vec![[0.0; 2]; burst.grid.len()];
        let flow: PatchMotion =
            (0..6).map(|k| if k == 1 { there.clone() } else { rest.clone() }).collect();
        let patchwise = burst.blended(|i| references.sample(&burst, &frames[1], i, flow[1][i], 4));
        let [_, pixelwise] = per_pixel_selection(&burst, &references, 4, 1, [&flow, &flow]);
        [patchwise, pixelwise].map(|warped| {
            let mut sum = 0.0;
            for y in 8..56 {
                for x in 18..46 {
                    sum += (warped.row(y)[x] - frames[4].row(y)[x]).powi(2) / (48.0 * 28.0);
                }
            }
            sum
        })
    }

    /// Checks the pixels at a motion boundary. In frame 4 the boundary lies at column 32, and patches up to
    /// half a patch beyond it move with the front.
    #[test]
    fn pixels_at_a_motion_border_move_on_their_own() {
        for border in [32, 40] {
            let [patchwise, pixelwise] = errors(border);
            assert!(
                pixelwise < 0.2 * patchwise,
                "{pixelwise}, {patchwise} by patches, border {border}"
            );
        }
    }
}
