//! Methods on a real static capture: a mean of many binary frames holds exact counts, which are
//! split at random into 11 sums of 7 frames and a reference of all others.
//!
//!     cargo run --release -p qudi-burst --example static_capture -- FOLDER 256 SEED
//!     cargo run --release -p qudi-burst --example static_capture -- FOLDER 256 SEED write BURST
//!     qudi restore BURST.npy --sensor BURST.toml --bits 3 --ppp PPP -o RESTORED.npy
//!     cargo run --release -p qudi-burst --example static_capture -- FOLDER 256 SEED score RESTORED.npy
//!
//! FOLDER holds one image of means of 256 binary frames. The split is hypergeometric, so that input
//! and reference are independent; the reference's own variance is subtracted from the error.
#![allow(clippy::print_stdout)]

use qudi_burst::{Average, Mle};
use qudi_burst::{PostFilter, Qbp, QbpRefined, Transform, TransformDenoise};
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Frame, Size};
use qudi_io::capture::Capture;
use qudi_io::description::{MaskChoice, ReadOptions};
use qudi_io::writer::ArrayWriter;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use std::path::Path;

const FRAMES: usize = 11;
const SUM: u32 = 7;
const EXPOSURE: f64 = 0.45;

fn main() -> qudi_core::Result<()> {
    let args: Vec<String> = std::env::args().collect();
    let [_, folder, levels, seed, rest @ ..] = args.as_slice() else {
        return Err(Error::request("three arguments", "command line", "FOLDER LEVELS SEED"));
    };
    let other = match rest {
        [] => None,
        [word, path] if ["write", "score"].contains(&word.as_str()) => Some((word.as_str(), path)),
        _ => return Err(Error::request(rest.join(" "), "command line", "write or score PATH")),
    };
    let number = |text: &str| text.parse::<u64>().unwrap_or(0);
    let levels = number(levels) as u16;
    let mask = MaskChoice::None;
    let options = ReadOptions { levels: Some(levels), mask, ..ReadOptions::default() };
    let mut capture = Capture::open(Path::new(folder), &options, None)?;
    let size = capture.size();
    let mut counts = vec![0; size.pixels()];
    capture.read(0, &mut counts)?;

    // Draws without replacement: each of the 7 x 11 frames takes a detection with probability
    // left / frames left.
    let mut rng = ChaCha8Rng::seed_from_u64(number(seed));
    let mut frames = vec![vec![0u16; size.pixels()]; FRAMES];
    let rest = u32::from(levels) - SUM * FRAMES as u32;
    let mut reference = vec![0u32; size.pixels()];
    for (i, &count) in counts.iter().enumerate() {
        let (mut ones, mut left) = (u32::from(count), u32::from(levels));
        for frame in &mut frames {
            for _ in 0..SUM {
                let uniform = (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
                let one = uniform * f64::from(left) < f64::from(ones);
                frame[i] += u16::from(one);
                ones -= u32::from(one);
                left -= 1;
            }
        }
        reference[i] = ones;
    }

    // Photons per sum of 7, from the reference; the sensor of the files' family, without dark counts.
    let n = f64::from(rest);
    let flux: Vec<f64> =
        reference.iter().map(|&s| -(-f64::from(s).min(n - 1.0) / n).ln_1p()).collect();
    let mean = flux.iter().sum::<f64>() / flux.len() as f64;
    let unit = EXPOSURE / mean;
    let truth: Vec<f64> = flux.iter().map(|f| f * unit).collect();
    let variance = reference.iter().map(|&s| {
        let p = f64::from(s).min(n - 1.0) / n;
        p / (1.0 - p) / n * unit * unit
    });
    let own_noise = variance.sum::<f64>() / truth.len() as f64;

    let mut document = serde_json::to_value(Sensor::load("swissspad2")?).unwrap_or_default();
    document["dark"] = 0.0.into();
    document["quantum_efficiency"] = 1.0.into();
    document["frames_summed"] = SUM.into();
    let sensor = Sensor::from_document(document, "swissspad2")?;
    let acquisition = Acquisition::new(sensor, mean * f64::from(SUM), EXPOSURE)?;
    println!(
        "{size}, {:.4} detections per frame of {SUM}, reference of {rest} frames",
        acquisition.ppp
    );
    let burst = BurstView { size, frames: &frames };
    match other {
        Some(("write", path)) => return write(path, burst, &acquisition.sensor),
        Some((_, path)) => {
            let image = middle(path, size)?;
            println!("{path}: psnr-a {:.2} dB", corrected(&image, &truth, own_noise));
            return Ok(());
        }
        None => {}
    }
    let mut mle = Mle::choose(&[burst], &acquisition);
    let choose = |transform| TransformDenoise::choose(transform, &[burst], &acquisition);
    let mut stabilized = choose(Transform::Integral);
    let mut plain = choose(Transform::Identity);
    let (mut qbp, mut qbp_bm3d) = (Qbp::new(PostFilter::None), Qbp::new(PostFilter::Bm3d));
    let methods: [&mut dyn Restorer; 7] = [
        &mut Average,
        &mut mle,
        &mut stabilized,
        &mut plain,
        &mut qbp,
        &mut qbp_bm3d,
        &mut QbpRefined,
    ];
    for method in methods {
        let restored = method.restore(burst, &acquisition)?.frames;
        let decibels = corrected(&restored[FRAMES / 2], &truth, own_noise);
        println!("{:<17} psnr-a {decibels:6.2} dB", method.name());
    }
    println!("mle over {} frames, transform-denoise over {}", mle.length(), stabilized.length());
    Ok(())
}

/// PSNR after the best gain, in dB, the reference's own variance subtracted.
fn corrected(image: &Frame, truth: &[f64], own_noise: f64) -> f64 {
    -10.0 * (squared_error(image, truth) - own_noise).max(1e-12).log10()
}

/// The counts as PATH.npy and the sensor as PATH.toml.
fn write(path: &str, burst: BurstView<'_>, sensor: &Sensor) -> qudi_core::Result<()> {
    let shape = [burst.size.height, burst.size.width];
    let array = format!("{path}.npy");
    let mut array = ArrayWriter::create(Path::new(&array), Overwrite::Yes, "|u1", &shape)?;
    for frame in burst.frames {
        array.push(&frame.iter().map(|&count| count as u8).collect::<Vec<_>>())?;
    }
    array.finish()?;
    let text = toml::to_string(sensor)
        .map_err(|e| Error::request(e.to_string(), "the sensor", "report this"))?;
    PendingFile::write_whole(Path::new(&format!("{path}.toml")), text.as_bytes(), Overwrite::Yes)
}

/// The middle one of 11 frames of float32 in a .npy file of ours.
fn middle(path: &str, size: Size) -> qudi_core::Result<Frame> {
    let bytes = std::fs::read(path).map_err(|e| Error::io("read", Path::new(path), e))?;
    let frame = 4 * size.pixels();
    let Some(values) = bytes.len().checked_sub(FRAMES * frame).map(|header| &bytes[header..])
    else {
        return Err(Error::request("too few frames", path, "restore all of the burst"));
    };
    let words = values[FRAMES / 2 * frame..][..frame].chunks_exact(4);
    let data = words.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    Ok(Frame { size, data })
}

/// Mean squared error after the best gain, in image units.
fn squared_error(image: &Frame, truth: &[f64]) -> f64 {
    let pairs = || image.data.iter().map(|&v| f64::from(v)).zip(truth);
    let cross: f64 = pairs().map(|(e, t)| e * t).sum();
    let square: f64 = pairs().map(|(e, _)| e * e).sum();
    let gain = if square > 0.0 { cross / square } else { 1.0 };
    pairs().map(|(e, t)| (gain * e - t).powi(2)).sum::<f64>() / truth.len() as f64
}
