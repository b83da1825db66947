//! Chooses the constants of the methods on training clips: gain-aligned PSNR of all frames, mean over
//! clips, for every setting tried.
//!
//!     cargo run --release -p qudi-burst --example settings -- FOLDER FRAMES SIDE
//!
//! FOLDER holds clips; the first FRAMES frames and the middle SIDE x SIDE pixels of each are used.
#![allow(clippy::print_stdout)]

use qudi_burst::sure_window_radius;
use qudi_burst::{PostFilter, Qbp, QbpSettings, Transform, TransformDenoise};
use qudi_core::metrics::gain_aligned_psnr;
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Error, Frame, Light, Result, Size};
use qudi_sim::clip::{Input, Sampling};
use std::path::Path;

/// A clip exposed at one light level.
struct Exposed {
    truth: Vec<Frame>,
    counts: Vec<Vec<u16>>,
    acquisition: Acquisition,
}

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().collect();
    let [_, folder, frames, side] = args.as_slice() else {
        return Err(Error::request("three arguments", "command line", "FOLDER FRAMES SIDE"));
    };
    let (frames, side) = (frames.parse().unwrap_or(11), side.parse().unwrap_or(256));
    let mut clips = Vec::new();
    let path = Path::new(folder);
    let io = |e| Error::io("list the folder", path, e);
    let mut places = Vec::new();
    for entry in std::fs::read_dir(path).map_err(io)? {
        places.push(entry.map_err(io)?.path());
    }
    places.sort();
    for place in places {
        clips.push(read(&place.display().to_string(), frames, side)?);
    }
    for ppp in [3.25, 9.75, 26.0] {
        let exposed: Vec<Exposed> = clips
            .iter()
            .enumerate()
            .map(|(i, truth)| expose(truth, ppp, i as u64))
            .collect::<Result<_>>()?;
        sweep(&exposed, ppp)?;
    }
    Ok(())
}

/// Every setting of every method at one light level.
fn sweep(clips: &[Exposed], ppp: f64) -> Result<()> {
    println!("{ppp} PPP");
    for transform in [Transform::Identity, Transform::Anscombe, Transform::Integral] {
        // [clips][half]
        let mut figures = Vec::new();
        for clip in clips {
            let of = |half| psnr(clip, &mut TransformDenoise::new(transform, half));
            figures.push((0..=5).map(of).collect::<Result<Vec<f64>>>()?);
        }
        let mean =
            |of: &dyn Fn(usize) -> f64| (0..clips.len()).map(of).sum::<f64>() / clips.len() as f64;
        for length in [1, 3, 5, 7, 9, 11] {
            let figure = mean(&|i| figures[i][length / 2]);
            println!("  {transform:?}, sums of {length:2}: {figure:.2} dB");
        }
        for noise_left in [1.0, 0.3, 0.2, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01] {
            let chosen = mean(&|i| {
                let samples = [clips[i].burst()];
                figures[i][sure_window_radius(&samples, &clips[i].acquisition, noise_left)]
            });
            println!("  {transform:?}, chosen with {noise_left}: {chosen:.2} dB");
        }
        let best = mean(&|i| figures[i].iter().copied().fold(f64::MIN, f64::max));
        println!("  {transform:?}, best length of every clip: {best:.2} dB");
    }
    let mean = |post_filter, settings| -> Result<f64> {
        let figures: Result<Vec<f64>> = clips
            .iter()
            .map(|clip| psnr(clip, &mut Qbp::with_settings(post_filter, settings)))
            .collect();
        Ok(figures?.iter().sum::<f64>() / clips.len() as f64)
    };
    let of = |detections_per_block, wiener_c, bm3d_sigma_factor| QbpSettings {
        detections_per_block,
        wiener_c,
        bm3d_sigma_factor,
    };
    let plain = [16.0, 32.0, 64.0].map(|c| [of(4.0, c, 1.0), of(8.0, c, 1.0)]);
    for settings in plain.into_iter().flatten() {
        println!("  qbp, {settings:?}: {:.2} dB", mean(PostFilter::None, settings)?);
    }
    let filtered = [8.0, 16.0, 32.0].map(|c| of(4.0, c, 1.3));
    let others = [of(8.0, 16.0, 1.3), of(4.0, 16.0, 1.1), of(4.0, 16.0, 1.5)];
    for settings in filtered.into_iter().chain(others) {
        println!("  qbp-bm3d, {settings:?}: {:.2} dB", mean(PostFilter::Bm3d, settings)?);
    }
    Ok(())
}

impl Exposed {
    fn burst(&self) -> BurstView<'_> {
        BurstView { size: self.truth[0].size, frames: &self.counts }
    }
}

/// Mean over all frames.
fn psnr(clip: &Exposed, method: &mut dyn Restorer) -> Result<f64> {
    let restored = method.restore(clip.burst(), &clip.acquisition)?.frames;
    let total: f64 = restored
        .iter()
        .zip(&clip.truth)
        .map(|(image, truth)| gain_aligned_psnr(image, truth))
        .sum();
    Ok(total / restored.len() as f64)
}

/// The middle of the first frames of a clip.
fn read(place: &str, frames: u64, side: usize) -> Result<Vec<Frame>> {
    let input = Input::parse(place, None, None, 1, 2.0)?;
    let sampling = Sampling { frames: Some(frames), ..Sampling::default() };
    let mut source = input.open(&sampling)?;
    let mut clip = Vec::new();
    while let Some(mean_level) = source.next()? {
        let whole = mean_level.truth();
        let size = Size { height: side.min(whole.size.height), width: side.min(whole.size.width) };
        let (top, left) =
            ((whole.size.height - size.height) / 2, (whole.size.width - size.width) / 2);
        clip.push(Frame::from_fn(size, |x, y| whole.row(top + y)[left + x]));
    }
    Ok(clip)
}

fn expose(truth: &[Frame], ppp: f64, seed: u64) -> Result<Exposed> {
    let sensor = Sensor::load("qudi-paper")?;
    let mean = truth.iter().map(Frame::mean).sum::<f64>() / truth.len() as f64;
    let mut camera = Camera::new(&sensor, truth[0].size, Light { ppp, mean_level: mean }, seed)?;
    let mut counts = Vec::new();
    for (i, frame) in truth.iter().enumerate() {
        counts.push(camera.expose(i as u64, &[frame])?);
    }
    let acquisition = Acquisition::new(sensor, ppp, 0.45)?;
    Ok(Exposed { truth: truth.to_vec(), counts, acquisition })
}
