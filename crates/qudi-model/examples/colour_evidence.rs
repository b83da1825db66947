//! Writes what counts tell of the colours of photographs in motion, for `scripts/colour_network.py`.
//!
//!     cargo run --release --example colour_evidence -- PICTURES EVIDENCE [SEED]
//!
//! Every picture of a folder moves in front of a filter. Its counts are restored with the built-in weights of
//! the program, four of five with the regression. Three frames of evidence and truth are written as `.npy`.
#![allow(clippy::print_stdout)]

use burn::tensor::Device;
use qudi_burst::{ColourCorrector, ColourEvidence, ColourRestorer, CorrectedColours};
use qudi_core::colour::ColourFilter;
use qudi_core::npy::write_header;
use qudi_core::random::{Domain, Streams, uniform};
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Error, Frame, Light, Result, Size, srgb_to_linear};
use qudi_model::ComputePrecision;
use qudi_model::checkpoint::load;
use qudi_model::config::NetworkConfig;
use qudi_model::diffusion::{DiffusionRestorer, SampleOptions};
use qudi_model::regression::{Regression, RegressionRestorer};
use qudi_model::restorer::Model;
use qudi_model::window::Window;
use qudi_sim::clip::decode_image;
use rand::Rng;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

const SIZE: Size = Size { height: 128, width: 128 };
const FRAMES: usize = 11;
const WRITTEN: [usize; 3] = [1, 5, 8];

/// Most pixels of a picture.
const MAX_PIXELS: u64 = 1 << 26;

/// Part of a picture that is seen while it moves.
const PART: usize = 168;

/// Shares of red, green and blue pixels of a random filter; the others are white.
const RANDOM_FILTER: f64 = 0.0807;

/// Keeps the evidence of all frames, and changes nothing.
#[derive(Clone, Default)]
struct Recorder(Arc<Mutex<Vec<ColourEvidence>>>);

impl ColourCorrector for Recorder {
    fn correct(&self, evidence: &ColourEvidence) -> Result<CorrectedColours> {
        let pixels = evidence.size.pixels();
        let ratios = |k: usize| evidence.planes[(1 + k) * pixels..][..pixels].to_vec();
        let same =
            CorrectedColours { luma: vec![1.0; pixels], ratios: [ratios(0), ratios(1), ratios(2)] };
        self.0
            .lock()
            .map_err(|_| Error::request("a thread failed", "evidence", "run it again"))?
            .push(evidence.clone());
        Ok(same)
    }
}

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().collect();
    let (pictures, out, seed) = match args.as_slice() {
        [_, pictures, out] => (pictures, out, 0),
        [_, pictures, out, seed] => (pictures, out, seed.parse().unwrap_or(0)),
        _ => {
            return Err(Error::request(
                "other arguments",
                "command line",
                "PICTURES EVIDENCE [SEED]",
            ));
        }
    };
    let (pictures, out) = (Path::new(pictures), Path::new(out));
    let io = |e| Error::io("list", pictures, e);
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(pictures).map_err(io)? {
        paths.push(entry.map_err(io)?.path());
    }
    paths.sort();
    std::fs::create_dir_all(out).map_err(|e| Error::io("create", out, e))?;
    for (number, path) in paths.iter().enumerate() {
        let mut rng = Streams::new(seed).row(Domain::Photons, number as u64, 0);
        let Some(scene) = scene(path, &mut rng)? else { continue };
        let stem = out.join(path.file_stem().unwrap_or_default());
        let word = if write(&scene, number, &stem, &mut rng)? { "written" } else { "left out" };
        println!("{} of {}: {} {word}", number + 1, paths.len(), path.display());
    }
    Ok(())
}

/// Draws a number from `from` to `to`.
fn between(rng: &mut impl Rng, from: f64, to: f64) -> f64 {
    from + (to - from) * uniform(rng)
}

/// Returns a part of a picture in linear light, shrunk, mirrored, and sometimes of exchanged colours or gray;
/// none of pictures that are too small.
fn scene(path: &Path, rng: &mut impl Rng) -> Result<Option<[Frame; 3]>> {
    let image = decode_image(path, MAX_PIXELS)?;
    let least = f64::from(image.width().min(image.height()));
    let scale = [1.0, 0.75, 0.6f64][(3.0 * uniform(rng)) as usize];
    let scale = scale.max((PART + 2) as f64 / least).min(1.0);
    let side = |side: u32| (f64::from(side) * scale) as u32;
    let image = image.thumbnail_exact(side(image.width()), side(image.height())).to_rgb8();
    let part = PART as u32;
    if image.width() < part || image.height() < part {
        return Ok(None);
    }
    let mut corner = |side: u32| between(rng, 0.0, f64::from(side - part + 1)) as u32;
    let (left, top) = (corner(image.width()), corner(image.height()));
    let mirrored = uniform(rng) < 0.5;
    let order = if uniform(rng) < 0.3 { [1, 2, 0] } else { [0, 1, 2] };
    let gray = uniform(rng) < 0.07;
    let size = Size { height: PART, width: PART };
    let light = |x: usize, y: usize, k: usize| {
        let x = if mirrored { PART - 1 - x } else { x };
        let pixel = image.get_pixel(left + x as u32, top + y as u32);
        srgb_to_linear(f32::from(pixel.0[order[k]]) / 255.0)
    };
    let planes = [0, 1, 2].map(|k| Frame::from_fn(size, |x, y| light(x, y, k)));
    if !gray {
        return Ok(Some(planes));
    }
    let [red, green, blue] = planes;
    let mean = |i: usize| (red.data[i] + 2.0 * green.data[i] + blue.data[i]) / 4.0;
    let plane = Frame { size, data: (0..size.pixels()).map(mean).collect() };
    Ok(Some([plane.clone(), plane.clone(), plane]))
}

/// Returns the middle of a scene, moved by `shift` pixels.
fn moved(scene: &[Frame; 3], shift: [f64; 2]) -> [Frame; 3] {
    let border = (PART - SIZE.width) as f64 / 2.0;
    let value = |plane: &Frame, x: usize, y: usize| {
        let at = |place: usize, shift: f64| {
            let at = (place as f64 + border + shift).clamp(0.0, (PART - 2) as f64);
            (at as usize, at.fract() as f32)
        };
        let ((left, fx), (top, fy)) = (at(x, shift[0]), at(y, shift[1]));
        let pixel = |dy: usize, dx: usize| plane.data[(top + dy) * PART + left + dx];
        let row = |dy: usize| pixel(dy, 0) * (1.0 - fx) + pixel(dy, 1) * fx;
        row(0) * (1.0 - fy) + row(1) * fy
    };
    scene.each_ref().map(|plane| Frame::from_fn(SIZE, |x, y| value(plane, x, y)))
}

/// Draws a filter: a Bayer pattern, or a random one with white pixels.
fn filter(rng: &mut impl Rng) -> Result<ColourFilter> {
    let drawn = uniform(rng);
    if drawn < 0.65 {
        let pattern = ["rggb", "gbrg", "bggr"][(3.0 * drawn / 0.65) as usize];
        let tile = pattern.parse().map_err(|e: String| Error::request(e, pattern, "a pattern"))?;
        return ColourFilter::tiled(&tile, SIZE);
    }
    let pure = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255; 3]];
    let colour = |_| pure[((uniform(rng) / RANDOM_FILTER) as usize).min(3)];
    let pixels: Vec<[u8; 3]> = (0..SIZE.pixels()).map(colour).collect();
    ColourFilter::from_picture(SIZE, &pixels, "random")
}

/// Restores with the built-in weights: one in five with the diffusion in one step.
fn method(number: usize) -> Result<Box<dyn Restorer>> {
    let device = Device::flex();
    let precision = ComputePrecision::fastest(&device);
    let weights = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../qudi-cli/weights"));
    let other = || Error::request("weights of another kind", weights.display(), "clone again");
    if number.is_multiple_of(5) {
        let file = weights.join("diffusion.safetensors");
        let (network, description) = load::<Window>(&file, &device)?;
        let NetworkConfig::Window(config) = description.network else { return Err(other()) };
        let model = Model { network, config, window: description.window, passes: 1 };
        let options = SampleOptions { precision, ..SampleOptions::default() };
        return Ok(Box::new(DiffusionRestorer::new(model, options, &device)?));
    }
    let file = weights.join("regression.safetensors");
    let (network, description) = load::<Regression>(&file, &device)?;
    let NetworkConfig::Regression(config) = description.network else { return Err(other()) };
    let model = Model { network, config, window: description.window, passes: 1 };
    Ok(Box::new(RegressionRestorer::new(model, None, 512, precision, &device)?))
}

/// Exposes and restores a scene, and writes evidence, truth and weights; false if it is too dark.
fn write(scene: &[Frame; 3], number: usize, stem: &Path, rng: &mut impl Rng) -> Result<bool> {
    let filter = filter(rng)?;
    let speed = if uniform(rng) < 0.15 { 0.0 } else { between(rng, 0.0, 1.8) };
    let angle = between(rng, 0.0, std::f64::consts::TAU);
    let middle = (FRAMES / 2) as f64;
    let truths: Vec<[Frame; 3]> = (0..FRAMES)
        .map(|t| {
            let way = speed * (t as f64 - middle);
            moved(scene, [way * angle.cos(), way * angle.sin()])
        })
        .collect();
    let seen: Vec<Frame> = truths.iter().map(|truth| filter.mosaic(truth)).collect();
    let level = seen.iter().map(Frame::mean).sum::<f64>() / FRAMES as f64;
    if level < 0.005 {
        return Ok(false);
    }
    let light = Light { ppp: between(rng, 1.2f64.ln(), 26f64.ln()).exp(), mean_level: level };
    let sensor = if uniform(rng) < 0.8 {
        Sensor::load("qudi-paper")?
    } else {
        Sensor { frames_summed: 7, ..Sensor::load("spad512s")? }
    };
    let mut camera = Camera::new(&sensor, SIZE, light, number as u64)?;
    let counts: Vec<Vec<u16>> =
        (0..).zip(&seen).map(|(t, frame)| camera.expose(t, &[frame])).collect::<Result<_>>()?;
    let acquisition = Acquisition::new(sensor, light.ppp, level)?;
    let recorder = Recorder::default();
    let mut restorer = ColourRestorer::new(method(number)?, filter, true)
        .with_corrector(Box::new(recorder.clone()));
    restorer.restore_frames(BurstView { size: SIZE, frames: &counts }, &acquisition, &WRITTEN)?;
    drop(restorer);
    let mut evidence = recorder.0.lock().map_or_else(|_| Vec::new(), |list| list.clone());
    evidence.sort_by_key(|evidence| evidence.frame);
    let named = |kind: &str| PathBuf::from(format!("{}-{kind}.npy", stem.display()));
    let planes = evidence.iter().flat_map(|evidence| evidence.planes.iter().copied());
    let shape = [WRITTEN.len(), ColourEvidence::PLANES, SIZE.height, SIZE.width];
    array(&named("evidence"), &shape, planes)?;
    let truth =
        WRITTEN.iter().flat_map(|&t| truths[t].iter().flat_map(|plane| plane.data.iter().copied()));
    array(&named("truth"), &[WRITTEN.len(), 3, SIZE.height, SIZE.width], truth)?;
    let weights = evidence.first().map_or([0.0; 3], |evidence| evidence.weights);
    array(&named("weights"), &[3], weights.into_iter())?;
    Ok(true)
}

fn array(path: &Path, shape: &[usize], values: impl Iterator<Item = f32>) -> Result<()> {
    let mut bytes = Vec::new();
    let io = |e| Error::io("write", path, e);
    write_header(&mut bytes, "<f4", shape).map_err(io)?;
    bytes.extend(values.flat_map(f32::to_le_bytes));
    std::fs::write(path, bytes).map_err(io)
}
