//! Which way every single pixel went: one patch has one motion, but where things move past each other it holds two. What
//! restored frames show of a pixel's surroundings chooses among the motions of the patches around it.

use super::grid::inside;
use crate::merge::dft::{Patch, SIDE};
use crate::methods::qbp::{Merger, Patchwise};
use qudi_core::Frame;
use rayon::prelude::*;

/// Radius of the squares that are compared, in pixels.
const RADIUS: usize = 2;

/// Motions less than so many pixels apart in both components are one.
const SAME: f32 = 0.4;

/// By how much any other motion must fit better than the patch's own, in the variance of the noise of two pixels' difference: where all
/// fit, noise would choose.
const RELUCTANCE: f32 = 0.1;

/// Pixels of a square.
const AREA: f32 = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;

impl Merger {
    /// The counts of frame `k`, and its pilot, laid upon the reference pixel by pixel along whichever motion in `flows`, of the
    /// patch or of those around it, makes their pilots the most alike. The first flow is the one to keep where all fit.
    pub(crate) fn closest(&self, reference: usize, k: usize, flows: [&Patchwise; 2]) -> [Frame; 2] {
        let pilots = &self.pilots.as_ref().expect("aligned on restored frames").frames;
        let doubt = AREA * RELUCTANCE * self.matching_variance(reference);
        let flows = flows.map(|flow| &flow[k]);
        let patch = |i: usize| {
            let here = self.sample(&pilots[reference], i, [0.0; 2], reference);
            let motions = self.motions_around(i, flows);
            let mut least = [[f32::INFINITY; SIDE]; SIDE];
            let mut best = [[[0.0; SIDE]; SIDE]; 2];
            for (number, &d) in motions.iter().enumerate() {
                let there = self.sample(&pilots[k], i, d, reference);
                let mut misfit = misfit(&here, &there);
                self.deny_outside(&mut misfit, i, d);
                let own = number == 0;
                if !own {
                    misfit.iter_mut().flatten().for_each(|value| *value += doubt);
                    let mut pairs = misfit.iter().flatten().zip(least.iter().flatten());
                    // Most motions fit no pixel better, and then nobody asks for their counts.
                    if !pairs.any(|(value, least)| value < least) {
                        continue;
                    }
                }
                let counts = self.sample(&self.frames[k], i, d, reference);
                for y in 0..SIDE {
                    for x in 0..SIDE {
                        if own || misfit[y][x] < least[y][x] {
                            least[y][x] = misfit[y][x];
                            best[0][y][x] = counts[y][x];
                            best[1][y][x] = there[y][x];
                        }
                    }
                }
            }
            best
        };
        let patches: Vec<[Patch; 2]> = (0..self.grid.len()).into_par_iter().map(patch).collect();
        [0, 1].map(|image| self.blended(|i| patches[i][image]))
    }

    /// The motions of patch `i`, of those that touch it, and rest; each once.
    fn motions_around(&self, i: usize, flows: [&Vec<[f32; 2]>; 2]) -> Vec<[f32; 2]> {
        let mut motions: Vec<[f32; 2]> = Vec::with_capacity(20);
        let all = flows.iter().flat_map(|flow| {
            std::iter::once(i).chain(self.grid.touching(i)).map(|patch| flow[patch])
        });
        for d in all.chain(std::iter::once([0.0; 2])) {
            let known = |m: &[f32; 2]| (m[0] - d[0]).abs() < SAME && (m[1] - d[1]).abs() < SAME;
            if !motions.iter().any(known) {
                motions.push(d);
            }
        }
        motions
    }

    /// What lies outside of the image fits nothing.
    fn deny_outside(&self, misfit: &mut Patch, i: usize, d: [f32; 2]) {
        let corner = self.grid.corner(i);
        let size = self.frames[0].size;
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
}

/// Squared differences, summed over the squares around each pixel as far as they lie in the patch.
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
    use crate::methods::qbp::Pilots;
    use qudi_core::restorer::{Acquisition, BurstView};
    use qudi_core::sensor::Sensor;
    use qudi_core::{Camera, Light, Size};

    const SIZE: Size = Size { height: 64, width: 80 };

    /// Mean counts of two textures: the right one rests, the left one comes before it, three pixels per frame.
    fn scene(t: usize) -> Frame {
        Frame::from_fn(SIZE, |x, y| {
            let (x, y) = (x as f32, y as f32);
            let front = x < 20.0 + 3.0 * t as f32;
            let x = if front { x - 3.0 * t as f32 } else { x };
            let phase = if front { 0.0 } else { 1.5 };
            3.0 + (0.7 * x + 0.3 * y + phase).sin() + (0.5 * y - 0.4 * x + 2.0 * phase).cos()
        })
    }

    /// The textures of frame 1 are laid upon frame 4 along motions of the one left of `border` and of the one right of it.
    fn errors(border: usize) -> [f32; 2] {
        let sensor = Sensor::load("qudi-paper").unwrap_or_else(|e| panic!("{e}"));
        let light = Light { ppp: 3.25, exposure: 0.45 };
        let camera = Camera::new(&sensor, SIZE, light, 5).unwrap_or_else(|e| panic!("{e}"));
        let gain = camera.gain();
        let acquisition = Acquisition {
            seed: 0,
            first_frame: 0,
            ppp: 3.25,
            exposure: 0.45,
            sensor,
            gain,
            dark: None,
        };
        let counts = vec![vec![3; SIZE.pixels()]; 6];
        let mut merger =
            Merger::new(BurstView { size: SIZE, frames: &counts }, &acquisition, 1, 16.0);
        let frames: Vec<Frame> = (0..6).map(scene).collect();
        merger.follow(Pilots { frames: frames.clone(), error: 0.1 });
        let motion =
            |i| if merger.grid.corner(i)[0] + SIDE / 2 < border { [-9.0, 0.0] } else { [0.0; 2] };
        let there: Vec<[f32; 2]> = (0..merger.grid.len()).map(motion).collect();
        let rest = vec![[0.0; 2]; merger.grid.len()];
        let flow: Patchwise =
            (0..6).map(|k| if k == 1 { there.clone() } else { rest.clone() }).collect();
        let patchwise = merger.blended(|i| merger.sample(&frames[1], i, flow[1][i], 4));
        let [_, pixelwise] = merger.closest(4, 1, [&flow, &flow]);
        [patchwise, pixelwise].map(|laid| {
            let mut sum = 0.0;
            for y in 8..56 {
                for x in 18..46 {
                    sum += (laid.row(y)[x] - frames[4].row(y)[x]).powi(2) / (48.0 * 28.0);
                }
            }
            sum
        })
    }

    /// In frame 4 the border lies at 32; patches up to half a patch beyond are said to move with the front, too.
    #[test]
    fn pixels_at_a_border_go_their_own_way() {
        for border in [32, 40] {
            let [patchwise, pixelwise] = errors(border);
            assert!(
                pixelwise < 0.2 * patchwise,
                "{pixelwise}, {patchwise} by patches, border {border}"
            );
        }
    }
}
