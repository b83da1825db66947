//! The picture of `qudi demo --diffusion`, of what more steps draw: one step, ten steps with two draws of
//! noise, the mean of several, and the truth, with errors and spread below.

use super::animation::middle;
use super::restored::{CENTRE, ExposedScene, rms, stop_if_asked};
use super::scenes::SIZE;
use crate::error::Result;
use crate::methods::QUDI_DIFFUSION;
use crate::methods::network;
use crate::methods::options::NetworkOptions;
use crate::report::Bar;
use crate::report::grid::Grid;
use crate::report::player::counts_frame;
use qudi_core::metrics::{best_gain, gain_aligned_psnr};
use qudi_core::restorer::BurstView;
use qudi_core::{Frame, Size};

/// Reverse steps of the drawn pictures.
const STEPS: usize = 10;

/// Pictures whose mean and spread are shown.
const SAMPLES: usize = 8;

/// Largest size of the file in bytes.
const MAX_BYTES: usize = 150_000;

/// JPEG qualities: the highest one whose file is small enough is taken.
const QUALITIES: [u8; 6] = [94, 92, 90, 86, 80, 70];

/// Side of the panels, cut out of the middle.
const SIDE: usize = 168;

/// The factor by which errors and spread are shown brighter than images.
const ERROR_GAIN: f32 = 4.0;

/// The centre frame of a sampling, at the truth's brightness.
struct Sampled {
    luma: Frame,
    /// Red, green and blue, where the scene has colours.
    colour: Option<[Frame; 3]>,
    psnr_a: f64,
    /// Spread over samples, where there are several.
    spread: Option<Frame>,
}

impl Sampled {
    fn planes(&self) -> [&Frame; 3] {
        match &self.colour {
            Some(colour) => colour.each_ref(),
            None => [&self.luma; 3],
        }
    }

    fn error(&self, truth: &Frame) -> Frame {
        let pairs = self.luma.data.iter().zip(&truth.data);
        Frame { size: SIZE, data: pairs.map(|(e, t)| (e - t).abs()).collect() }
    }
}

/// Samples the centre frame of a scene and encodes the picture as a JPEG.
pub(super) fn picture(
    scene: &ExposedScene,
    options: &NetworkOptions,
    bar: &mut Bar,
) -> Result<Vec<u8>> {
    let seed = scene.acquisition.seed;
    let runs =
        [(1, 1, seed), (STEPS, 1, seed), (STEPS, 1, seed.wrapping_add(1)), (STEPS, SAMPLES, seed)];
    let mut sampled = Vec::with_capacity(runs.len());
    for (done, (steps, samples, seed)) in (1..).zip(runs) {
        sampled.push(sample(scene, options, steps, samples, seed)?);
        bar.update("sampling", done, Some(runs.len() as u64));
        stop_if_asked()?;
    }
    let mut smallest = Vec::new();
    for quality in QUALITIES {
        smallest = compose(scene, &sampled).jpeg(quality);
        if smallest.len() <= MAX_BYTES {
            break;
        }
    }
    Ok(smallest)
}

fn sample(
    scene: &ExposedScene,
    options: &NetworkOptions,
    steps: usize,
    samples: usize,
    seed: u64,
) -> Result<Sampled> {
    let options = NetworkOptions { steps: Some(steps), samples, own_file: None, ..options.clone() };
    let acquisition = scene.acquisition.clone().with_seed(seed);
    let choice = QUDI_DIFFUSION.as_own().unwrap_or(network::NetworkChoice::Best);
    let (restorer, _) = network::restorer(choice, &options, &acquisition, SIZE)?;
    let view = BurstView { size: SIZE, frames: &scene.counts };
    let mut restorer = scene.behind_filter(restorer)?;
    let mut restored = restorer.restore_frames(view, &acquisition, &[CENTRE])?;
    let (frame, truth) = (restored.frames.swap_remove(0), &scene.truths[CENTRE]);
    let gain = best_gain(&frame, truth) as f32;
    let scaled = |frame: &Frame| {
        let data = frame.data.iter().map(|value| (value * gain).clamp(0.0, 1.0)).collect();
        Frame { size: SIZE, data }
    };
    let spread = restored.std.map(|mut std| scaled(&std.swap_remove(0)));
    Ok(Sampled {
        luma: scaled(&frame),
        colour: restored.colour.map(|colour| colour[0].each_ref().map(scaled)),
        psnr_a: gain_aligned_psnr(&frame, truth),
        spread: spread.filter(|_| samples > 1),
    })
}

fn compose(scene: &ExposedScene, sampled: &[Sampled]) -> Grid {
    let mut grid = Grid::new(Size { height: SIDE, width: SIDE }, 2, sampled.len() + 1, 2);
    let mut place = |row: usize, column: usize, labels: [&str; 2], planes: [&Frame; 3]| {
        let cut = planes.map(|plane| middle(plane, SIDE));
        grid.place(row, column, &labels, cut.each_ref());
    };
    let sensor = &scene.acquisition.sensor;
    let counts = counts_frame(SIZE, &scene.counts[CENTRE], sensor.max_count());
    place(0, 0, ["COUNTS", &format!("{} BIT", sensor.output_bits())], [&counts; 3]);
    let truth = &scene.truths[CENTRE];
    let labels = ["1 STEP", "10 STEPS", "OTHER NOISE", "MEAN OF 8"];
    let quality = |sampled: &Sampled| format!("{:.1} DB", sampled.psnr_a);
    // The mean lies under the counts, so that its spread is under the truth.
    let places = [(0, 1), (0, 2), (0, 3), (1, 0)];
    for ((sampled, label), (row, column)) in sampled.iter().zip(labels).zip(places) {
        place(row, column, [label, &quality(sampled)], sampled.planes());
        if row == 0 {
            let error = sampled.error(truth);
            place(1, column, ["ERROR X4", &size_text(&error)], [&brighter(&error); 3]);
        }
        if let Some(spread) = &sampled.spread {
            place(1, 4, ["SPREAD X4", &size_text(spread)], [&brighter(spread); 3]);
        }
    }
    place(0, 4, ["TRUTH", ""], scene.truth(CENTRE));
    grid
}

fn size_text(frame: &Frame) -> String {
    format!("RMS {:.3}", rms(frame))
}

fn brighter(frame: &Frame) -> Frame {
    Frame { size: frame.size, data: frame.data.iter().map(|value| value * ERROR_GAIN).collect() }
}
