//! A capture in numbers: rates, light, saturation, histogram, bit order, bad pixels.

use super::Capture;
use super::frame_axis::likely_axes;
use super::mosaic::{MosaicContrast, PlacedSums, check_pattern, mosaic_contrast};
use crate::description::{Axes, BitOrder, PackAxis};
use crate::recognition::{Z_SCORE_THRESHOLD, bit_order_z_score};
use qudi_core::PppDefinition;
use qudi_core::Result;
use qudi_core::colour::ColourFilter;
use qudi_core::sensor::{CountLaw, DarkRate, Response, Sensor};
use qudi_core::{Frame, Size};
use serde::Serialize;

/// Statistics of at most [`SAMPLE_FRAMES`](qudi_core::limits::SAMPLE_FRAMES) output frames.
#[derive(Clone, Debug)]
pub struct Summary {
    /// Frames measured.
    pub sampled: u64,
    /// Mean count per pixel and output frame, bad pixels repaired.
    pub mean: f64,
    /// Samples of each count; the last entry belongs to the largest count seen.
    pub histogram: Vec<u64>,
    /// Fraction of samples at the largest possible count, if that is known.
    pub saturated: Option<f64>,
    /// The same fraction of the pixels behind red, green, blue and white, of captures whose colours are read.
    pub saturated_colours: Option<[f64; 4]>,
    /// Photons per pixel and output frame: incident, detected, DN. Absent without a known sensor.
    pub ppp: Ppp,
    /// Agreement of the picture with the bit order in use; packed captures only.
    pub bit_order: Option<BitOrderCheck>,
    /// Difference between the pixels of tiles, where the picture looks like an unnamed colour filter array.
    pub mosaic: Option<MosaicContrast>,
    /// Doubt about the filter in use: pixels of one colour differ.
    pub filter_doubt: Option<String>,
    /// Mean count of a pixel behind red, green, blue and white, of captures whose colours are read; none of
    /// colours that the filter lacks.
    pub colours: Option<[Option<f64>; 4]>,
    /// Axes that the array seems to have, where what was read as frames looks like rows of the scene.
    pub likely_axes: Option<Axes>,
    /// Sum of the measured frames, repaired.
    pub sums: Vec<u32>,
}

/// Photons per pixel and output frame in their three meanings.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Ppp {
    /// Photons that fell on a pixel.
    pub incident: Option<f64>,
    /// Electrons or avalanches, dark ones included, also those that saturation hid.
    pub detected: Option<f64>,
    /// Mean output value.
    pub dn: f64,
}

impl Ppp {
    /// Returns the value of one definition.
    pub fn get(&self, definition: PppDefinition) -> Option<f64> {
        match definition {
            PppDefinition::Incident => self.incident,
            PppDefinition::Detected => self.detected,
            PppDefinition::Dn => Some(self.dn),
        }
    }
}

/// The bit order, judged by the picture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BitOrderCheck {
    /// Standard errors by which the picture fits the order in use; negative if it fits the other better.
    #[serde(rename = "evidence")]
    pub z_score: f64,
    /// Order that the picture shows, if it shows one.
    pub seen: Option<BitOrder>,
}

impl Summary {
    /// Measures `capture`. `sensor` turns counts into photons; `gain` is its gain in DN/e-, for sensors whose
    /// own rule follows the light.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the file cannot be read, or the picture contradicts its colour filter.
    pub fn measure(
        capture: &mut Capture,
        sensor: Option<&Sensor>,
        gain: Option<f64>,
    ) -> Result<Self> {
        let size = capture.size();
        let sampled = capture.sample_frames();
        let mut halves = [vec![0u32; size.pixels()], vec![0u32; size.pixels()]];
        let mut counts = vec![0u16; size.pixels()];
        let mut totals = Vec::with_capacity(sampled.len());
        let mut histogram = vec![0u64; 1 << 16];
        let mut saturated_colours = [0u64; 4];
        for (number, &frame) in sampled.iter().enumerate() {
            let sums = &mut halves[2 * number / sampled.len()];
            capture.read(frame, &mut counts)?;
            totals.push(counts.iter().map(|&count| f64::from(count)).sum());
            for (sum, &count) in sums.iter_mut().zip(&counts) {
                *sum += u32::from(count);
                histogram[usize::from(count)] += 1;
            }
            if let (Some(filter), Some(max)) = (&capture.filter, capture.max_count()) {
                for (&colour, &count) in filter.colours().iter().zip(&counts) {
                    saturated_colours[colour as usize] += u64::from(count == max);
                }
            }
        }
        let likely_axes = likely_axes(&halves, &totals, size);
        let [mut sums, second] = halves;
        for (sum, second) in sums.iter_mut().zip(second) {
            *sum += second;
        }
        let picture = PlacedSums {
            sums: &sums,
            size,
            from: capture.view.from.as_deref(),
            stored_width: capture.native.size().width,
        };
        let filter_doubt = match (&capture.filter, &capture.info.cfa) {
            (Some(filter), Some(cfa)) => {
                check_pattern(&picture, filter, cfa, capture.filter_is_recorded)?
            }
            _ => None,
        };
        let unnamed = capture.info.cfa.is_none();
        let mosaic = unnamed.then(|| mosaic_contrast(&picture)).flatten();
        let largest = histogram.iter().rposition(|&n| n > 0).unwrap_or(0);
        histogram.truncate(largest + 1);
        let samples = sampled.len() as f64 * size.pixels() as f64;
        let total: f64 = sums.iter().map(|&sum| f64::from(sum)).sum();
        let saturated = capture
            .max_count()
            .map(|max| histogram.get(usize::from(max)).map_or(0.0, |&n| n as f64 / samples));
        let looked = sampled.len() as u64;
        let bit_order = check_bit_order(capture, &sampled)?;
        let ppp = ppp(capture, &sums, looked, sensor, gain)?;
        Ok(Self {
            sampled: looked,
            mean: total / samples,
            histogram,
            saturated,
            saturated_colours: capture.filter.as_ref().map(|filter| {
                let pixels = filter.shares().map(|share| (share * samples).max(1.0));
                std::array::from_fn(|k| saturated_colours[k] as f64 / pixels[k])
            }),
            ppp,
            bit_order,
            mosaic,
            filter_doubt,
            colours: capture.filter.as_ref().map(|filter| colour_means(&sums, looked, filter)),
            likely_axes,
            sums,
        })
    }

    /// Returns the mean picture in linear light, with the response inverted and dark counts subtracted if
    /// `sensor` is known; white is the 99.5th percentile.
    pub fn picture(&self, capture: &Capture, sensor: Option<&Sensor>, gain: Option<f64>) -> Frame {
        let size = capture.size();
        let frames = self.sampled as u32 * capture.sum;
        let data = match native_sensor(capture, sensor) {
            Some(sensor) => {
                let gain = gain.or(sensor.fixed_gain()).unwrap_or(1.0);
                let dark = sensor.dark_per_frame().unwrap_or(0.0);
                let summed = f64::from(sensor.frames_summed);
                let light = |(i, &sum): (usize, &u32)| {
                    let dark = capture.dark.as_ref().map_or(dark, |map| f64::from(map[i]) * summed);
                    let dark = dark + capture.info.pedestal / gain;
                    sensor.estimate_flux(f64::from(sum), frames, gain, dark) as f32
                };
                self.sums.iter().enumerate().map(light).collect()
            }
            None => self.sums.iter().map(|&sum| sum as f32).collect::<Vec<_>>(),
        };
        Frame { size, data }.with_white_at_highlights()
    }
}

/// Returns the mean count of an output frame behind each colour.
fn colour_means(sums: &[u32], frames: u64, filter: &ColourFilter) -> [Option<f64>; 4] {
    let (mut totals, mut pixels) = ([0.0; 4], [0u64; 4]);
    for (&sum, &colour) in sums.iter().zip(filter.colours()) {
        totals[colour as usize] += f64::from(sum);
        pixels[colour as usize] += 1;
    }
    let mean = |k: usize| totals[k] / (pixels[k] * frames) as f64;
    std::array::from_fn(|k| (pixels[k] > 0).then(|| mean(k)))
}

/// Returns the sensor of native frames: `sensor`, or an ideal binary one if it is unknown, summing as many
/// binary frames as the capture's counts do.
fn native_sensor(capture: &Capture, sensor: Option<&Sensor>) -> Option<Sensor> {
    let info = &capture.info;
    let known = match sensor {
        Some(sensor) => sensor.clone(),
        None if info.binary => {
            let mut ideal = Sensor::load("swissspad2").ok()?;
            (ideal.dark, ideal.quantum_efficiency) = (DarkRate::PerFrame(0.0), 1.0);
            ideal
        }
        None => return None,
    };
    match (known.response, info.max_count) {
        (Response::Binary, Some(max)) => Some(Sensor { frames_summed: u32::from(max), ..known }),
        // No light follows from an unknown number of frames per count.
        (Response::Binary, None) => None,
        (Response::Linear, _) => Some(known),
    }
}

/// Compares pixels across byte boundaries in the stored frames.
fn check_bit_order(capture: &mut Capture, sampled: &[u64]) -> Result<Option<BitOrderCheck>> {
    let Some(packing) = capture.info.packing else { return Ok(None) };
    let stored = capture.native.size();
    let mut sums = vec![0u32; stored.pixels()];
    for &look in sampled {
        let first = capture.range.start + capture.begins(look);
        if capture.sum == 1 {
            capture.native.add(first..first + 1, &mut sums)?;
            continue;
        }
        capture.sum_stored(first..first + u64::from(capture.sum))?;
        sums.iter_mut().zip(&capture.stored_sums).for_each(|(sum, one)| *sum += one);
    }
    let z_score = match packing.axis {
        PackAxis::Height => {
            let turned = Size { height: stored.width, width: stored.height };
            let columns: Vec<u32> = (0..stored.pixels())
                .map(|i| sums[i % stored.height * stored.width + i / stored.height])
                .collect();
            bit_order_z_score(&columns, turned)
        }
        _ => bit_order_z_score(&sums, stored),
    };
    let seen = match z_score {
        e if e > Z_SCORE_THRESHOLD => Some(packing.order),
        e if e < -Z_SCORE_THRESHOLD => Some(packing.order.reversed()),
        _ => None,
    };
    Ok(Some(BitOrderCheck { z_score, seen }))
}

/// Computes the photons per pixel and output frame.
fn ppp(
    capture: &Capture,
    sums: &[u32],
    sampled: u64,
    sensor: Option<&Sensor>,
    gain: Option<f64>,
) -> Result<Ppp> {
    let sampled = sampled as f64;
    let dn = sums.iter().map(|&sum| f64::from(sum)).sum::<f64>() / sums.len() as f64 / sampled;
    let Some(native) = native_sensor(capture, sensor) else {
        return Ok(Ppp { incident: None, detected: None, dn });
    };
    let per_frame = f64::from(capture.sum);
    let detected = if native.response == Response::Binary {
        let n = f64::from(native.frames_summed) * per_frame;
        let trials = n * sampled;
        let light = |mean: f64| -n * (-(mean * sampled).min(trials - 0.5) / trials).ln_1p();
        Some(light_of_blocks(sums, capture.size(), sampled, light))
    } else {
        // Counts beyond the full scale belong to another sensor.
        let largest = sums.iter().copied().max().unwrap_or(0);
        let fits = f64::from(largest) <= f64::from(native.max_count()) * per_frame * sampled;
        gain.or(native.fixed_gain()).filter(|_| fits).map(|gain| {
            let pedestal = capture.info.pedestal / gain;
            let mean = dn / per_frame;
            let by_law = CountLaw::new(&native, gain).detections_for_mean(mean) - pedestal;
            // The law ends at zero, which counts on a pedestal do not reach.
            let seen = if pedestal > 0.0 { by_law.max(mean / gain - pedestal) } else { by_law };
            seen.max(0.0) * per_frame
        })
    };
    let dark = match &capture.dark {
        Some(map) => {
            let mean = map.iter().map(|&d| f64::from(d)).sum::<f64>() / map.len() as f64;
            mean * f64::from(native.frames_summed)
        }
        None => native.dark_per_frame()?,
    };
    let of_light = |detected: f64| {
        let frames = per_frame * f64::from(native.frames_summed);
        let seen = detected / native.echo_factor_of_seen(detected / frames);
        ((seen - dark * per_frame) / native.quantum_efficiency).max(0.0)
    };
    let incident = detected.filter(|_| sensor.is_some()).map(of_light);
    Ok(Ppp { incident, detected, dn: dn - capture.info.pedestal * per_frame })
}

/// Computes the mean light over the picture, block by block: the response of binary pixels is not linear, so
/// that bright and dark parts are inverted separately, and single pixels have counted too little.
fn light_of_blocks(sums: &[u32], size: Size, sampled: f64, light: impl Fn(f64) -> f64) -> f64 {
    const BLOCK: usize = 8;
    let (down, across) = (size.height.div_ceil(BLOCK), size.width.div_ceil(BLOCK));
    let mut blocks = vec![(0u64, 0u32); down * across];
    for (i, &sum) in sums.iter().enumerate() {
        let block = &mut blocks[i / size.width / BLOCK * across + i % size.width / BLOCK];
        *block = (block.0 + u64::from(sum), block.1 + 1);
    }
    let total = |&(sum, n): &(u64, u32)| light(sum as f64 / f64::from(n) / sampled) * f64::from(n);
    blocks.iter().map(total).sum::<f64>() / size.pixels() as f64
}
