//! Calibration from a dark capture: dark rate of every pixel, hot pixels, read noise.

use super::Capture;
use super::pedestal::{Pedestal, ordinary};
use qudi_core::Size;
use qudi_core::bad_pixels::BadPixels;
use qudi_core::sensor::{CountLaw, Response, Sensor};
use qudi_core::{Error, Result};

/// Ratio of a hot pixel's dark rate to the array's bulk, unless a threshold is given.
const HOT_FACTOR: f64 = 10.0;

/// Standard deviations of its counts by which a hot pixel exceeds the bulk, in addition.
const HOT_SIGMAS: f64 = 6.0;

/// Frames summed at once: 16-bit counts of so many frames fit into 32 bits.
const CHUNK_FRAMES: u64 = 4096;

/// Range in which read noise is fitted, in e-.
const READ_NOISE_RANGE: (f64, f64) = (0.01, 30.0);

/// Dark rates, hot pixels and read noise of a camera.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// Size of the maps: of frames without turn and crop.
    pub size: Size,
    /// Frames used.
    pub frames: u64,
    /// Dark electrons per native frame, `[height * width]`.
    pub dark: Vec<f32>,
    /// Median of the dark rates; where most pixels never fired, the mean of the darkest nine tenths.
    pub bulk: f64,
    /// Hot pixels.
    pub bad: BadPixels,
    /// Dark rate per native frame beyond which a pixel is hot.
    pub threshold: f64,
    /// Read noise in e- of the ordinary pixels, for linear sensors.
    pub read_noise: Option<f64>,
    /// Pedestal in DN, if there is one: given, or found in the counts.
    pub pedestal: Option<Pedestal>,
    /// Correlation of the rates of neighbouring pixels, where it shows a picture.
    pub picture: Option<f64>,
}

/// Measures `capture`, taken with the shutter closed. `gain` is in DN/e- and needed for linear
/// sensors, which may count above a pedestal of `offset` DN; `hot` is a threshold in dark electrons per
/// native frame.
///
/// # Errors
/// [`Error`] if the capture cannot be read, is no dark one, or the gain is unknown.
pub fn calibrate(
    capture: &mut Capture,
    sensor: &Sensor,
    gain: Option<f64>,
    offset: Option<f64>,
    hot: Option<f64>,
    on: &mut dyn FnMut(u64, u64) -> std::ops::ControlFlow<()>,
) -> Result<Calibration> {
    let binary = sensor.response == Response::Binary;
    let size = capture.size();
    let native = u64::from(capture.summed())
        * u64::from(if binary { capture.info.max_count.unwrap_or(1) } else { 1 });
    if !binary && capture.summed() > 1 {
        return Err(Error::request(
            "a sum of frames cannot tell read noise from dark counts",
            "sum",
            "leave it out",
        ));
    }
    let mut sums = vec![0u64; size.pixels()];
    let mut piece = vec![0u32; size.pixels()];
    let frames = capture.frames();
    for first in (0..frames).step_by(CHUNK_FRAMES as usize) {
        if on(first, frames).is_break() {
            return Err(Error::Interrupted);
        }
        capture.total(first..(first + CHUNK_FRAMES).min(frames), &mut piece)?;
        for (sum, &piece) in sums.iter_mut().zip(&piece) {
            *sum += u64::from(piece);
        }
    }
    let trials = (frames * native) as f64;
    if binary {
        let rate = |&sum: &u64| -(-(sum as f64).min(trials - 0.5) / trials).ln_1p();
        let rates: Vec<f64> = sums.iter().map(rate).collect();
        return finish(capture, frames, &rates, trials, hot, None, None);
    }
    let gain = gain.ok_or_else(|| {
        Error::request(
            format!("the gain of `{}` follows the light, and a dark capture has none", sensor.name),
            "gain",
            "give the gain of this capture in DN per electron",
        )
    })?;
    let means: Vec<f64> = sums.iter().map(|&sum| sum as f64 / trials).collect();
    if let Some(pedestal) = Pedestal::find(capture, gain, offset, &means)? {
        let rates: Vec<f64> = means.iter().map(|mean| (mean - pedestal.offset) / gain).collect();
        let noise = pedestal.read_noise;
        return finish(capture, frames, &rates, trials, hot, Some(noise), Some(pedestal));
    }
    let read_noise = fit_read_noise(capture, sensor, gain, &means)?;
    let law = CountLaw::new(&Sensor { read_noise, ..sensor.clone() }, gain);
    finish(capture, frames, &invert(&law, &means), trials, hot, Some(read_noise), None)
}

/// Returns the detections for each mean count, by interpolation in a table.
fn invert(law: &CountLaw, means: &[f64]) -> Vec<f64> {
    const STEPS: usize = 2048;
    let highest = means.iter().copied().fold(0.0, f64::max);
    let most = law.detections_for_mean(highest).max(1e-6);
    // Finer where it is dark: most pixels are there.
    let detections = |i: usize| most * (i as f64 / STEPS as f64).powi(2);
    let table: Vec<f64> = (0..=STEPS).map(|i| law.mean(detections(i))).collect();
    let interpolate = |&mean: &f64| {
        let above = table.partition_point(|&m| m < mean).clamp(1, STEPS);
        let (low, high) = (table[above - 1], table[above]);
        let part = if high > low { ((mean - low) / (high - low)).clamp(0.0, 1.0) } else { 0.0 };
        detections(above - 1) + part * (detections(above) - detections(above - 1))
    };
    means.iter().map(interpolate).collect()
}

fn finish(
    capture: &Capture,
    frames: u64,
    rates: &[f64],
    trials: f64,
    hot: Option<f64>,
    read_noise: Option<f64>,
    pedestal: Option<Pedestal>,
) -> Result<Calibration> {
    let size = capture.size();
    let mut sorted = rates.to_vec();
    sorted.sort_by(f64::total_cmp);
    let median = sorted[sorted.len() / 2];
    let darkest = &sorted[..(sorted.len() * 9).div_ceil(10)];
    let trimmed = darkest.iter().sum::<f64>() / darkest.len() as f64;
    let bulk = if median > 0.0 { median } else { trimmed.max(0.0) };
    let ninth = sorted[(sorted.len() - 1) * 9 / 10];
    if ninth > 0.5 && read_noise.is_none() {
        return Err(Error::data(
            format!("a tenth of the pixels count more than {ninth:.2} dark electrons per frame"),
            capture.path(),
            "calibrate from a capture with the shutter closed",
        ));
    }
    let threshold = hot.unwrap_or(HOT_FACTOR * bulk);
    let hot = (0..rates.len())
        .filter(|&i| {
            let expected = bulk * trials;
            let variance = expected + trials * read_noise.unwrap_or(0.0).powi(2) + 1.0;
            let significant = rates[i] * trials > expected + HOT_SIGMAS * variance.sqrt();
            rates[i] > threshold && significant
        })
        .collect();
    // Maps are of the frames without turn and crop, and are turned and cropped with these.
    let dark: Vec<f32> = rates.iter().map(|&rate| rate.max(0.0) as f32).collect();
    let hot = BadPixels { hot, ..BadPixels::default() }.mask(size);
    let hot = usual(capture, &hot, false);
    let hot = (0..hot.len()).filter(|&i| hot[i]).collect();
    Ok(Calibration {
        size: capture.usual.size,
        frames,
        dark: usual(capture, &dark, bulk as f32),
        bulk,
        bad: BadPixels { hot, ..BadPixels::default() },
        threshold,
        read_noise,
        pedestal,
        picture: picture(rates, size, 3.0 * bulk),
    })
}

/// Returns a map of the frames in use as one of the frames without turn and crop, `outside` where these end.
fn usual<T: Copy>(capture: &Capture, map: &[T], outside: T) -> Vec<T> {
    if capture.view == capture.usual {
        return map.to_vec();
    }
    let stored = capture.view.stored(map, capture.native.size(), outside);
    let mut usual = vec![outside; capture.usual.size.pixels()];
    capture.usual.apply(&stored, &mut usual);
    usual
}

/// Least correlation of neighbours in a picture; dark rates of pixels have nothing to do with each other.
const PICTURE_CORRELATION: f64 = 0.3;

/// Returns the correlation of the rates of neighbouring pixels if they show a picture. Pixels with rates
/// beyond `most` are hot.
fn picture(rates: &[f64], size: Size, most: f64) -> Option<f64> {
    let clipped: Vec<f64> = rates.iter().map(|rate| rate.min(most)).collect();
    let mean = clipped.iter().sum::<f64>() / clipped.len() as f64;
    let (mut product, mut square) = (0.0, 0.0);
    for row in clipped.chunks_exact(size.width) {
        for pair in row.windows(2) {
            product += (pair[0] - mean) * (pair[1] - mean);
            square += (pair[0] - mean).powi(2);
        }
    }
    let correlation = if square > 0.0 { product / square } else { 0.0 };
    (correlation > PICTURE_CORRELATION).then_some(correlation)
}

/// Fits the read noise of the ordinary pixels by maximum likelihood.
fn fit_read_noise(capture: &mut Capture, sensor: &Sensor, gain: f64, means: &[f64]) -> Result<f64> {
    let chosen = ordinary(means);
    let mut histogram = vec![0u64; usize::from(sensor.max_count()) + 1];
    let mut counts = vec![0u16; means.len()];
    for frame in capture.sample_frames() {
        capture.read(frame, &mut counts)?;
        for &i in &chosen {
            let Some(bin) = histogram.get_mut(usize::from(counts[i])) else {
                return Err(Error::data(
                    format!(
                        "a count of {}, where `{}` reaches {}",
                        counts[i],
                        sensor.name,
                        sensor.max_count()
                    ),
                    capture.path(),
                    "give the sensor that took it: `sensor`, or `bits N`",
                ));
            };
            *bin += 1;
        }
    }
    let total: u64 = histogram.iter().sum();
    let mean = histogram.iter().enumerate().map(|(y, &n)| y as f64 * n as f64).sum::<f64>();
    let mean = mean / total.max(1) as f64;
    let unlikelihood = |ln_noise: f64| {
        let law = CountLaw::new(&Sensor { read_noise: ln_noise.exp(), ..sensor.clone() }, gain);
        let probabilities = law.probabilities(law.detections_for_mean(mean));
        let log = |(&n, p): (&u64, &f64)| if n > 0 { n as f64 * p.max(1e-300).ln() } else { 0.0 };
        -histogram.iter().zip(&probabilities).map(log).sum::<f64>()
    };
    Ok(minimum(unlikelihood, READ_NOISE_RANGE.0.ln(), READ_NOISE_RANGE.1.ln()).exp())
}

/// Finds the minimum of `f` by golden-section search.
fn minimum(f: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> f64 {
    let golden = 0.5 * (5f64.sqrt() - 1.0);
    let (mut a, mut b) = (high - golden * (high - low), low + golden * (high - low));
    let (mut fa, mut fb) = (f(a), f(b));
    for _ in 0..40 {
        if fa < fb {
            (high, b, fb) = (b, a, fa);
            a = high - golden * (high - low);
            fa = f(a);
        } else {
            (low, a, fa) = (a, b, fb);
            b = low + golden * (high - low);
            fb = f(b);
        }
    }
    0.5 * (low + high)
}
