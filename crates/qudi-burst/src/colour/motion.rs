//! Motion of a capture behind a colour filter, found on sums of 2 x 2 counts.

use super::exposures::Exposure;
use super::gray_counts::rounded;
use super::{CountResponse, Exposures};
use crate::burst_motion::{BurstMotion, FRAME_ERROR};
use crate::motion::flow::spread;
use crate::motion::reference_frames::ReferenceFrames;
use crate::patch::PatchMotion;
use crate::reference::ReferenceEstimate;
use qudi_core::colour::Colour;
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::{Gain, Response, Sensor};
use qudi_core::{Frame, Result, Size};
use std::sync::OnceLock;

/// Counts of an exposure that are added: 2 x 2.
const ADDED: u32 = 4;

/// Share of white pixels from which motion is found on them alone: few others would leave a fixed pattern.
const MOSTLY_WHITE: f64 = 0.5;

/// Motion between the frames of a window, at half the resolution.
pub(super) struct QuadMotion {
    size: Size,
    motion: BurstMotion,
    references: ReferenceFrames,
    /// Motion of the patches of each frame to all frames, found on first use.
    motions: Vec<OnceLock<PatchMotion>>,
    /// Restored luma of each frame, in image units.
    luma: Vec<Frame>,
}

/// The pixels of one frame, displaced to another.
pub(super) struct Displaced<'a> {
    size: Size,
    /// Displacement of each pixel of the frame that is looked for, at half the resolution.
    displacement: Vec<[f32; 2]>,
    /// Luma of this frame, and of the one that is looked for.
    luma: [&'a Frame; 2],
}

impl QuadMotion {
    /// Finds the motion of a window. `mean` is the mean light of each colour, in image units.
    pub(super) fn find(
        exposures: &Exposures<'_>,
        acquisition: &Acquisition,
        response: &CountResponse,
        mean: [f32; 4],
    ) -> Result<Self> {
        let of_quads = acquisition_of_quads(acquisition, ADDED * exposures.each.len() as u32);
        let whole = exposures.size;
        let size = Size { height: whole.height / 2, width: whole.width / 2 };
        let most = u32::from(of_quads.sensor.max_count());
        let luma: f32 =
            exposures.shares().iter().zip(mean).map(|(&share, mean)| share as f32 * mean).sum();
        let quads = |t: usize| {
            let mut sums = vec![0u32; size.pixels()];
            for exposure in &exposures.each {
                let gray = balanced(exposure, t, whole, acquisition, response, (mean, luma));
                let at = |y: usize, x: usize| u32::from(gray[y * whole.width + x]);
                for (i, sum) in sums.iter_mut().enumerate() {
                    let (y, x) = (2 * (i / size.width), 2 * (i % size.width));
                    *sum += at(y, x) + at(y, x + 1) + at(y + 1, x) + at(y + 1, x + 1);
                }
            }
            sums.into_iter().map(|sum| sum.min(most) as u16).collect()
        };
        let quads: Vec<Vec<u16>> = (0..exposures.frames()).map(quads).collect();
        let view = BurstView { size, frames: &quads };
        let estimate = ReferenceEstimate::compute(view, &of_quads)?;
        let ReferenceEstimate { frames: luma, mean_counts, motion, .. } = estimate;
        let references = ReferenceFrames::new(&motion.burst, mean_counts, FRAME_ERROR);
        let motions = luma.iter().map(|_| OnceLock::new()).collect();
        Ok(Self { size, motion, references, motions, luma })
    }

    /// Returns the displacement of each frame's pixels to frame `reference`.
    pub(super) fn to(&self, reference: usize) -> Vec<Displaced<'_>> {
        let motion = self.motions[reference]
            .get_or_init(|| self.motion.on_references(&self.references, reference).selected);
        let displaced = |(k, motion): (usize, &Vec<[f32; 2]>)| Displaced {
            size: self.size,
            displacement: spread(&self.motion.burst.grid, motion, self.size),
            luma: [&self.luma[k], &self.luma[reference]],
        };
        motion.iter().enumerate().map(displaced).collect()
    }
}

impl Displaced<'_> {
    /// Returns where pixel (`x`, `y`) of this frame lies in the frame that is looked for, with the luma of
    /// both.
    pub(super) fn place(&self, x: usize, y: usize) -> ([f32; 2], [f32; 2]) {
        let half = |at: usize| 0.5 * (at as f32 - 0.5);
        let own = [half(x), half(y)];
        let nearest = |[x, y]: [f32; 2]| {
            let bound = |v: f32, length: usize| (v.round().max(0.0) as usize).min(length - 1);
            bound(y, self.size.height) * self.size.width + bound(x, self.size.width)
        };
        let mut there = own;
        for _ in 0..2 {
            let [dx, dy] = self.displacement[nearest(there)];
            there = [own[0] - dx, own[1] - dy];
        }
        let [here, other] = self.luma;
        let seen = [here.data[nearest(own)], other.data[nearest(there)]];
        (there.map(|v| 2.0 * v + 0.5), seen)
    }
}

/// Scales the counts of a frame from the mean light of their colours to the mean of luma.
fn balanced(
    exposure: &Exposure<'_>,
    frame: usize,
    size: Size,
    acquisition: &Acquisition,
    response: &CountResponse,
    (mean, luma): ([f32; 4], f32),
) -> Vec<u16> {
    let Exposure { frames, filter } = exposure;
    let counts = &frames[frame];
    let white_alone = filter.shares()[Colour::White as usize] > MOSTLY_WHITE;
    let target = response.at(luma, response.dark);
    let of_colour = mean.map(|mean| response.at(mean, response.dark));
    let scaled = |i: usize| {
        let colour = filter.colours()[i] as usize;
        let there = of_colour[colour];
        let slope = target.slope * luma / (there.slope * mean[colour]).max(1e-6);
        target.mean + slope * (f32::from(counts[i]) - there.mean)
    };
    let value = |i: usize| {
        if !white_alone || filter.colours()[i] == Colour::White {
            return scaled(i);
        }
        let (y, x) = (i / size.width, i % size.width);
        let rows = y.saturating_sub(1)..(y + 2).min(size.height);
        let columns = x.saturating_sub(1)..(x + 2).min(size.width);
        let around = rows.flat_map(|y| columns.clone().map(move |x| y * size.width + x));
        let (mut sum, mut n) = (0.0, 0.0f32);
        for j in around.filter(|&j| filter.colours()[j] == Colour::White) {
            (sum, n) = (sum + scaled(j), n + 1.0);
        }
        if n > 0.0 { sum / n } else { scaled(i) }
    };
    let values: Vec<f32> = (0..size.pixels()).map(value).collect();
    rounded(&values, size, frame, acquisition)
}

/// Returns the acquisition of sums of `added` counts.
fn acquisition_of_quads(acquisition: &Acquisition, added: u32) -> Acquisition {
    let mut sensor: Sensor = acquisition.sensor.clone();
    match sensor.response {
        Response::Binary => sensor.frames_summed = (added * sensor.frames_summed).min(65_535),
        Response::Linear => {
            let bits = added.next_power_of_two().trailing_zeros() as u8;
            sensor.bits = (sensor.bits + bits).min(16);
            sensor.dark = sensor.dark.times(f64::from(added));
            sensor.read_noise *= f64::from(added).sqrt();
            sensor.gain = Gain::Fixed(acquisition.gain);
        }
    }
    let ppp = f64::from(added) * acquisition.ppp;
    Acquisition { sensor, ppp, dark: None, ..acquisition.clone() }
}
