//! Hot and dead pixels: found in a capture, and repaired before anything else looks at it.

mod dead_lines;

use crate::frame::Size;
use dead_lines::dead_lines_and_clumps;
use std::fmt::Write as _;

/// Least ratio of a hot pixel to its brightest good neighbours.
const HOT_RATIO: f64 = 2.0;

/// Least difference of a hot pixel from its brightest good neighbours, in standard deviations of their
/// counts.
const HOT_SIGMAS: f64 = 8.0;

/// Count that all neighbours but two of a dead pixel exceed. By chance a good pixel is silent there once in
/// e^18 pixels, and black parts of a scene are larger.
const DEAD_NEIGHBOUR_COUNT: f64 = 18.0;

/// Radius of the neighbourhood of a pixel: 5 x 5 pixels.
const NEIGHBOUR_RADIUS: isize = 2;

/// Bad pixels of an array, as indices in rising order.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BadPixels {
    /// Pixels that fire without light.
    pub hot: Vec<usize>,
    /// Pixels that never fire.
    pub dead: Vec<usize>,
    /// Pixels of bright clumps: hot ones, or small bright things. They are not repaired.
    pub doubtful: usize,
}

impl BadPixels {
    /// Looks for isolated pixels far off their neighbourhood in the `sums` of `frames` frames.
    /// Counts per frame go up to `max_count` (1 for binary frames, whose saturation is corrected first).
    ///
    /// Optics spread even a star over several pixels; a single one that is twice as bright as the
    /// second brightest around it is a defect.
    pub fn find(sums: &[u32], size: Size, frames: u64, max_count: Option<u16>) -> Self {
        let trials = frames as f64 * f64::from(max_count.unwrap_or(u16::MAX));
        // Detections: binary counts saturate, and a hot pixel among bright ones hides there.
        let detections: Vec<f64> = sums
            .iter()
            .map(|&sum| match max_count {
                Some(1) => -trials * (-(f64::from(sum)).min(trials - 0.5) / trials).ln_1p(),
                _ => f64::from(sum),
            })
            .collect();
        let mut bad = Self::default();
        // Where nothing is bright, no pixel is known to be dead.
        let is_lit = detections.iter().any(|&value| value > DEAD_NEIGHBOUR_COUNT);
        for i in 0..size.pixels() {
            // Only pixels beyond what noise alone explains, or empty ones, are compared with their
            // neighbours.
            let (bright, empty) = (detections[i] > HOT_SIGMAS, is_lit && sums[i] == 0);
            if !bright && !empty {
                continue;
            }
            let around = Neighbours::of(i, size, &detections);
            if around.count < 5 {
                continue;
            }
            // The very brightest may be a defect itself.
            let usual = around.brightest[1];
            let noise = (usual + 1.0).sqrt();
            if detections[i] > HOT_RATIO * usual && detections[i] > usual + HOT_SIGMAS * noise {
                bad.hot.push(i);
            } else if empty && around.dark < 3 {
                bad.dead.push(i);
            }
        }
        if is_lit {
            bad.dead.extend(dead_lines_and_clumps(&detections, size));
            bad.dead.sort_unstable();
            bad.dead.dedup();
        }
        bad.doubtful = doubtful(&detections, size, &bad);
        bad
    }

    /// Returns the number of bad pixels.
    pub fn len(&self) -> usize {
        self.hot.len() + self.dead.len()
    }

    /// Returns true if there are no bad pixels.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns a mask that is true for bad pixels.
    pub fn mask(&self, size: Size) -> Vec<bool> {
        let mut mask = vec![false; size.pixels()];
        for &i in self.hot.iter().chain(&self.dead) {
            mask[i] = true;
        }
        mask
    }

    /// Describes the bad pixels in words.
    pub fn describe(&self, size: Size) -> String {
        let mut text = String::new();
        let percent = |n: usize| 100.0 * n as f64 / size.pixels() as f64;
        let (hot, dead) = (self.hot.len(), self.dead.len());
        let _ =
            write!(text, "{hot} hot ({:.3} %), {dead} dead ({:.3} %)", percent(hot), percent(dead));
        if self.doubtful > 0 {
            let _ = write!(text, ", {} in bright clumps are doubtful", self.doubtful);
        }
        text
    }
}

/// Statistics of the pixels around one pixel.
struct Neighbours {
    count: usize,
    /// The brightest two.
    brightest: [f64; 2],
    /// Number of pixels that are too dark to reveal a dead one.
    dark: usize,
}

impl Neighbours {
    fn of(i: usize, size: Size, detections: &[f64]) -> Self {
        let mut around = Self { count: 0, brightest: [f64::NEG_INFINITY; 2], dark: 0 };
        neighbours(i, size, NEIGHBOUR_RADIUS, |j| {
            let value = detections[j];
            around.count += 1;
            around.dark += usize::from(value <= DEAD_NEIGHBOUR_COUNT);
            let [first, second] = &mut around.brightest;
            if value > *first {
                *second = std::mem::replace(first, value);
            } else if value > *second {
                *second = value;
            }
        });
        around
    }
}

/// Radius of the surroundings of a clump: 9 x 9 pixels.
const CLUMP_RADIUS: isize = 4;

/// Least ratio of a clump to the pixels around it: optics leave a rim around bright objects.
const CLUMP_RATIO: f64 = 4.0;

/// Counts pixels that are not isolated defects, but far brighter than most pixels around them.
fn doubtful(detections: &[f64], size: Size, bad: &BadPixels) -> usize {
    let known = bad.mask(size);
    let mut around = Vec::with_capacity(80);
    let mut count = 0;
    for i in 0..size.pixels() {
        // Noise alone explains these.
        if known[i] || detections[i] <= HOT_SIGMAS {
            continue;
        }
        // Most pixels are darker than their surroundings and need no second look.
        let mut mean = 0.0;
        let mut n = 0.0;
        neighbours(i, size, NEIGHBOUR_RADIUS, |j| {
            mean += detections[j];
            n += 1.0;
        });
        if n == 0.0 || detections[i] < 1.2 * mean / n {
            continue;
        }
        around.clear();
        neighbours(i, size, CLUMP_RADIUS, |j| around.push(detections[j]));
        let upper = around.len() * 3 / 4;
        if around.len() < 24 {
            continue;
        }
        let (_, &mut usual, _) = around.select_nth_unstable_by(upper, f64::total_cmp);
        let noise = HOT_SIGMAS * (usual + 1.0).sqrt();
        if detections[i] > CLUMP_RATIO * usual && detections[i] > usual + noise {
            count += 1;
        }
    }
    count
}

/// Calls `f` with the pixels within `radius` of pixel `i`, itself left out.
fn neighbours(i: usize, size: Size, radius: isize, mut f: impl FnMut(usize)) {
    let (y, x) = ((i / size.width) as isize, (i % size.width) as isize);
    let (height, width) = (size.height as isize, size.width as isize);
    for ny in (y - radius).max(0)..(y + radius + 1).min(height) {
        for nx in (x - radius).max(0)..(x + radius + 1).min(width) {
            if (ny, nx) != (y, x) {
                f((ny * width + nx) as usize);
            }
        }
    }
}

/// Replaces bad pixels from good ones around them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Repair {
    /// Bad pixel and its nearest good neighbours.
    pixels: Vec<(usize, Vec<usize>)>,
}

impl Repair {
    /// Plans the repair of the pixels set in `mask`; in clusters the search widens.
    pub fn new(mask: &[bool], size: Size) -> Self {
        Self::among(mask, size, |_, _| true)
    }

    /// Plans the repair of the pixels set in `mask` from those that are `alike`.
    pub fn among(mask: &[bool], size: Size, alike: impl Fn(usize, usize) -> bool) -> Self {
        let widest = size.height.max(size.width) as isize;
        let good = |i: usize| -> Vec<usize> {
            let mut found = Vec::new();
            let mut radius = 1;
            while found.is_empty() && radius <= widest {
                neighbours(i, size, radius, |j| {
                    if !mask[j] && alike(i, j) {
                        found.push(j);
                    }
                });
                radius *= 2;
            }
            found
        };
        let bad = mask.iter().enumerate().filter(|(_, bad)| **bad);
        let pixels = bad.map(|(i, _)| (i, good(i))).filter(|(_, good)| !good.is_empty());
        Self { pixels: pixels.collect() }
    }

    /// Returns the number of repaired pixels.
    pub fn count(&self) -> usize {
        self.pixels.len()
    }

    /// Copies one good neighbour, another one in each frame, which keeps the noise of a count
    /// (Ma et al. 2020, whose code does the same with one draw for all pixels).
    pub fn frame(&self, frame: u64, counts: &mut [u16]) {
        for (i, good) in &self.pixels {
            let pick = scramble(frame ^ (*i as u64) << 32) % good.len() as u64;
            counts[*i] = counts[good[pick as usize]];
        }
    }

    /// Replaces bad pixels by the mean of their good neighbours, the limit of many frames of
    /// [`Repair::frame`].
    pub fn sums(&self, sums: &mut [u32]) {
        for (i, good) in &self.pixels {
            let total: u64 = good.iter().map(|&j| u64::from(sums[j])).sum();
            let n = good.len() as u64;
            sums[*i] = ((total + n / 2) / n) as u32;
        }
    }
}

/// Scrambles a number (SplitMix64's finaliser, Steele et al. 2014).
pub fn scramble(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ z >> 31
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repairs_clusters_from_their_surroundings() {
        let size = Size { height: 5, width: 5 };
        let mut mask = vec![false; 25];
        for i in [6, 7, 8, 11, 12, 13, 16, 17, 18] {
            mask[i] = true;
        }
        let repair = Repair::new(&mask, size);
        let mut counts: Vec<u16> = mask.iter().map(|&bad| if bad { 99 } else { 3 }).collect();
        repair.frame(4, &mut counts);
        assert_eq!(counts, vec![3; 25]);
        let mut sums: Vec<u32> = mask.iter().map(|&bad| if bad { 99 } else { 3 }).collect();
        repair.sums(&mut sums);
        assert_eq!(sums, vec![3; 25]);
    }

    #[test]
    fn frames_pick_different_neighbours_and_their_mean_is_the_sum() {
        let size = Size { height: 3, width: 3 };
        let mut mask = vec![false; 9];
        mask[4] = true;
        let repair = Repair::new(&mask, size);
        let source: Vec<u16> = vec![0, 10, 20, 30, 0, 40, 50, 60, 70];
        let mut total = 0u64;
        for frame in 0..10_000 {
            let mut counts = source.clone();
            repair.frame(frame, &mut counts);
            total += u64::from(counts[4]);
        }
        let mut sums: Vec<u32> = source.iter().map(|&c| u32::from(c) * 10_000).collect();
        repair.sums(&mut sums);
        assert!((total as f64 / f64::from(sums[4]) - 1.0).abs() < 0.02, "{total} {}", sums[4]);
    }

    #[test]
    fn leaves_a_fully_bad_array_unrepaired() {
        let size = Size { height: 2, width: 2 };
        assert_eq!(Repair::new(&[true; 4], size).count(), 0);
    }
}
