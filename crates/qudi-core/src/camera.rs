//! The camera: a sensor under a certain light, taking one frame after another.
//!
//! Exposed frames depend on the seed, the frame's number and the scene alone, never on threads.

mod rolling_shutter;

pub use rolling_shutter::RollingShutter;

use crate::error::{Error, Result};
use crate::frame::{Frame, Size};
use crate::light::Light;
use crate::random::{Domain, Streams, uniform};
use crate::sensor::{
    CountLaw, CountTable, PixelMaps, Response, RowScratch, Sensor, binomial, counted, poisson,
};
use rayon::prelude::*;

/// Upper bound of the expected detections per pixel and output frame; beyond it counters overflow.
const MAX_DETECTIONS: f64 = 1e9;

/// Upper bound of the expected arrivals for counters with a dead time, which are simulated arrival by
/// arrival.
const MAX_ARRIVALS: f64 = 1e5;

/// Rows handed to a thread at a time.
const ROWS_PER_TASK: usize = 8;

/// A sensor under a certain light. Call [`Camera::expose`] once per output frame, in order.
#[derive(Debug)]
pub struct Camera {
    sensor: Sensor,
    size: Size,
    light: Light,
    gain: f64,
    maps: PixelMaps,
    streams: Streams,
    /// Electrons per unit of image value in one output frame.
    electrons_per_value: f64,
    /// Dark electrons of an ordinary pixel in one native frame.
    dark: f64,
    law: CountLaw,
    /// For whole output frames, and for single binary frames.
    table: Option<CountTable>,
    single: Option<CountTable>,
    /// Binary pixels that fired in the previous frame, while afterpulsing is on.
    previous: Vec<bool>,
}

impl Camera {
    /// Creates a camera with frames of `size` under `light`.
    ///
    /// # Errors
    /// [`Error`] for an impossible sensor, an unreadable dark map, or light beyond all bounds.
    pub fn new(sensor: &Sensor, size: Size, light: Light, seed: u64) -> Result<Self> {
        Self::with_maps(sensor, PixelMaps::draw(sensor, size)?, size, light, seed)
    }

    /// Creates a camera with the given pixel pattern (`maps`, drawn for `sensor` and frames of `size`).
    pub fn with_maps(
        sensor: &Sensor,
        maps: PixelMaps,
        size: Size,
        light: Light,
        seed: u64,
    ) -> Result<Self> {
        sensor.validate()?;
        let gain = sensor.gain_at(light.ppp)?;
        let electrons_per_value = sensor.quantum_efficiency * light.ppp / light.mean_level;
        let dark = sensor.dark_per_frame()? / f64::from(sensor.frames_summed);
        if !electrons_per_value.is_finite() || electrons_per_value > MAX_DETECTIONS {
            return Err(Error::request(
                format!("{electrons_per_value:e} electrons in a white pixel"),
                "ppp, exposure",
                "lower the light or raise the exposure value",
            ));
        }
        // Noise about the pedestal is drawn with it.
        let is_noisy = sensor.response == Response::Linear && sensor.read_noise > 0.0;
        let law = CountLaw::new(sensor, gain).above(if is_noisy { sensor.offset } else { 0.0 });
        if law.dead_time() > 0.0 && electrons_per_value > MAX_ARRIVALS {
            return Err(Error::request(
                format!("{electrons_per_value:e} arrivals in a white pixel with a dead time"),
                "ppp, defects.dead_time_ns",
                format!(
                    "such counters are followed arrival by arrival: stay below {MAX_ARRIVALS:e}"
                ),
            ));
        }
        let n = f64::from(sensor.frames_summed);
        // Up to white and twice the ordinary dark rate; what lies above is drawn directly.
        let brightest = electrons_per_value + 2.0 * dark * n;
        let single_law = law.clone().single_frame();
        let binary = sensor.response == Response::Binary;
        Ok(Self {
            sensor: sensor.clone(),
            size,
            light,
            gain,
            maps,
            streams: Streams::new(seed),
            electrons_per_value,
            dark,
            table: if law.pedestal > 0.0 { None } else { CountTable::new(&law, brightest) },
            single: if binary { CountTable::new(&single_law, brightest / n) } else { None },
            law,
            previous: Vec::new(),
        })
    }

    /// Returns the gain in DN/e-.
    pub fn gain(&self) -> f64 {
        self.gain
    }

    /// Returns the light.
    pub fn light(&self) -> Light {
        self.light
    }

    /// Returns the camera's pixel pattern.
    pub fn maps(&self) -> &PixelMaps {
        &self.maps
    }

    /// Exposes output frame `index` to the instants of one exposure and returns `height * width` counts. With
    /// one instant, nothing moves during the exposure.
    ///
    /// # Errors
    /// [`Error::Request`] if an instant has another size or values that are no light.
    pub fn expose(&mut self, index: u64, instants: &[&Frame]) -> Result<Vec<u16>> {
        self.check(instants)?;
        let defects = &self.sensor.defects;
        let mut counts = match self.sensor.response {
            Response::Linear => {
                let blurred;
                let scene = if let [only] = instants {
                    *only
                } else {
                    blurred = average(instants);
                    &blurred
                };
                if defects.crosstalk > 0.0 {
                    self.expose_with_crosstalk(index, scene)
                } else {
                    let scale = self.electrons_per_value as f32;
                    self.draw_rows(self.table.as_ref(), &self.law, index, scene, scale, 1.0)
                }
            }
            Response::Binary => {
                let still = instants.len() == 1;
                if still && defects.crosstalk == 0.0 && defects.afterpulse == 0.0 {
                    let scale = self.electrons_per_value as f32;
                    let n = self.sensor.frames_summed as f32;
                    self.draw_rows(self.table.as_ref(), &self.law, index, instants[0], scale, n)
                } else {
                    self.expose_binary_frames(index, instants)
                }
            }
        };
        let offset = match self.sensor.response {
            Response::Linear => self.sensor.offset.round() as u16,
            Response::Binary => 0,
        };
        let most = self.sensor.max_count();
        if offset > 0 && self.law.pedestal == 0.0 {
            for count in &mut counts {
                *count = count.saturating_add(offset).min(most);
            }
        }
        for &pixel in &self.maps.dead {
            counts[pixel] = offset.min(most);
        }
        Ok(counts)
    }

    fn check(&self, instants: &[&Frame]) -> Result<()> {
        let fault = |what: String| {
            Err(Error::request(
                what,
                "the scene",
                "frames have one size and values between 0 and 1000000",
            ))
        };
        if instants.is_empty() {
            return fault("an exposure without a frame".into());
        }
        for frame in instants {
            if frame.size != self.size {
                return fault(format!("a frame of {} in a clip of {}", frame.size, self.size));
            }
            // No early exit, so that the compiler can look at many values at once.
            if !frame.data.iter().fold(true, |fine, v| fine & (0.0..=1e6).contains(v)) {
                return fault("a negative, infinite or missing value".into());
            }
        }
        Ok(())
    }

    /// Draws the counts of a frame whose pixels are independent of each other and of earlier frames.
    /// `scale` converts image values into electrons; dark electrons of `dark_times` native frames are added.
    fn draw_rows(
        &self,
        table: Option<&CountTable>,
        law: &CountLaw,
        index: u64,
        scene: &Frame,
        scale: f32,
        dark_times: f32,
    ) -> Vec<u16> {
        let width = self.size.width;
        let mut counts = vec![0u16; self.size.pixels()];
        let dark = self.dark as f32 * dark_times;
        counts.par_chunks_mut(width).with_min_len(ROWS_PER_TASK).enumerate().for_each_init(
            RowScratch::default,
            |scratch, (y, row)| {
                let mut rng = self.streams.row(Domain::Photons, index, y);
                let lit = scene.row(y).iter().map(|&value| scale * value);
                scratch.detections.clear();
                match &self.maps.dark {
                    None => scratch.detections.extend(lit.map(|light| light + dark)),
                    Some(map) => {
                        let map = &map[y * width..(y + 1) * width];
                        scratch
                            .detections
                            .extend(lit.zip(map).map(|(light, d)| light + d * dark_times));
                    }
                }
                if let Some(table) = table {
                    table.draw_row(scratch, row, &mut rng);
                    return;
                }
                for (count, &detections) in row.iter_mut().zip(&scratch.detections) {
                    *count = law.draw(f64::from(detections), &mut rng);
                }
            },
        );
        counts
    }

    /// Exposes a linear sensor with cross-talk: draws electrons, adds the neighbours' share, then reads out.
    fn expose_with_crosstalk(&self, index: u64, scene: &Frame) -> Vec<u16> {
        let width = self.size.width;
        let scale = self.electrons_per_value as f32;
        let mut electrons = vec![0u32; self.size.pixels()];
        electrons.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            let mut rng = self.streams.row(Domain::Photons, index, y);
            for (x, (cell, &value)) in row.iter_mut().zip(scene.row(y)).enumerate() {
                let dark = self.maps.dark.as_ref().map_or(self.dark as f32, |m| m[y * width + x]);
                let mean = f64::from(scale * value + dark);
                *cell = if self.law.dead_time() > 0.0 {
                    counted(mean, self.law.dead_time(), &mut rng) as u32
                } else {
                    poisson(mean, &mut rng) as u32
                };
            }
        });
        let mut counts = vec![0u16; self.size.pixels()];
        counts.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            let mut rng = self.streams.row(Domain::Echoes, index, y);
            for (x, count) in row.iter_mut().enumerate() {
                let around: u64 = self.neighbours(x, y).map(|i| u64::from(electrons[i])).sum();
                let echoes = binomial(around, self.sensor.defects.crosstalk, &mut rng);
                let total = f64::from(electrons[y * width + x]) + echoes as f64;
                *count = self.law.digitise(total, &mut rng);
            }
        });
        counts
    }

    /// Exposes binary frames one by one, each to its own instant of the scene, and returns their sum.
    fn expose_binary_frames(&mut self, index: u64, instants: &[&Frame]) -> Vec<u16> {
        let n = self.sensor.frames_summed as usize;
        let scale = (self.electrons_per_value / n as f64) as f32;
        let law = self.law.clone().single_frame();
        let mut sum = vec![0u16; self.size.pixels()];
        for s in 0..n {
            // The instants that fall into this binary frame, or the one that covers it.
            let first = s * instants.len() / n;
            let last = ((s + 1) * instants.len() / n).max(first + 1);
            let blurred;
            let scene = if last - first == 1 {
                instants[first]
            } else {
                blurred = average(&instants[first..last]);
                &blurred
            };
            let number = index * n as u64 + s as u64;
            let mut fired = self.draw_rows(self.single.as_ref(), &law, number, scene, scale, 1.0);
            if self.sensor.defects.crosstalk > 0.0 || self.sensor.defects.afterpulse > 0.0 {
                fired = self.add_echoes(number, fired);
            }
            sum.par_iter_mut().zip(&fired).for_each(|(sum, &fired)| *sum += fired);
        }
        sum
    }

    /// Adds afterpulses of the previous binary frame, then cross-talk from all pixels that have fired.
    fn add_echoes(&mut self, number: u64, mut fired: Vec<u16>) -> Vec<u16> {
        let width = self.size.width;
        let (afterpulse, crosstalk) =
            (self.sensor.defects.afterpulse, self.sensor.defects.crosstalk);
        // A dead pixel neither fires nor echoes.
        for &pixel in &self.maps.dead {
            fired[pixel] = 0;
        }
        if afterpulse > 0.0 && self.previous.len() == fired.len() {
            fired.par_chunks_mut(width).zip(self.previous.par_chunks(width)).enumerate().for_each(
                |(y, (row, before))| {
                    let mut rng = self.streams.row(Domain::Echoes, 2 * number, y);
                    for (cell, &before) in row.iter_mut().zip(before) {
                        if before && uniform(&mut rng) < afterpulse {
                            *cell = 1;
                        }
                    }
                },
            );
        }
        if crosstalk > 0.0 {
            let primary = fired.clone();
            fired.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
                let mut rng = self.streams.row(Domain::Echoes, 2 * number + 1, y);
                for (x, cell) in row.iter_mut().enumerate() {
                    let around: i32 = self.neighbours(x, y).map(|i| i32::from(primary[i])).sum();
                    if around > 0 && uniform(&mut rng) >= (1.0 - crosstalk).powi(around) {
                        *cell = 1;
                    }
                }
            });
        }
        for &pixel in &self.maps.dead {
            fired[pixel] = 0;
        }
        if afterpulse > 0.0 {
            self.previous = fired.iter().map(|&f| f > 0).collect();
        }
        fired
    }

    /// Returns the indices of the up to 4 neighbours of a pixel.
    fn neighbours(&self, x: usize, y: usize) -> impl Iterator<Item = usize> {
        let Size { height, width } = self.size;
        let i = y * width + x;
        [
            (x > 0).then(|| i - 1),
            (x + 1 < width).then_some(i + 1),
            (y > 0).then(|| i - width),
            (y + 1 < height).then_some(i + width),
        ]
        .into_iter()
        .flatten()
    }
}

/// Averages frames of one size.
fn average(frames: &[&Frame]) -> Frame {
    let mut mean = frames[0].clone();
    for frame in &frames[1..] {
        for (sum, &value) in mean.data.iter_mut().zip(&frame.data) {
            *sum += value;
        }
    }
    let scale = 1.0 / frames.len() as f32;
    mean.data.iter_mut().for_each(|v| *v *= scale);
    mean
}
