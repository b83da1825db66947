//! What the network is told of a burst: counts, their linear estimate, and the sensor in numbers.

use crate::draft::Draft;
use crate::network::SENSOR_NUMBERS;
use crate::tensor::to_tensor;
use burn::tensor::{Device, Tensor};
use qudi_burst::{AlignedBurst, AlignedFrame, Alignments, ReferenceEstimate};
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::{CountLaw, Response, Sensor};
use qudi_core::{Result, Size};
use std::ops::Range;

/// Brightest linear estimate, in image units: twice white.
pub(crate) const BRIGHTEST: f64 = 2.0;

/// Planes of a burst, frame after frame, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Planes {
    /// Counts over full scale.
    pub y: Vec<f32>,
    /// The linear estimate in image units, in [0, 2].
    pub u: Vec<f32>,
}

impl Planes {
    /// The planes of a captured burst.
    pub fn of(burst: BurstView<'_>, acquisition: &Acquisition) -> Self {
        let response = CountResponse::new(
            &acquisition.sensor,
            acquisition.photons_per_unit(),
            acquisition.gain,
            dark(&acquisition.sensor),
        );
        let mut planes = Self { y: Vec::new(), u: Vec::new() };
        for frame in burst.frames {
            response.add(frame, &mut planes);
            if let Some(map) = &acquisition.dark {
                let start = planes.u.len() - frame.len();
                for ((u, &count), &dark) in planes.u[start..].iter_mut().zip(frame).zip(map) {
                    *u = response.estimate(count, f64::from(dark));
                }
            }
        }
        planes
    }
}

/// Which frames are laid upon each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Laid {
    /// So many, the nearest ones.
    pub neighbours: usize,
    /// Along which alignments.
    pub along: Alignments,
}

impl Laid {
    /// How many planes that makes.
    pub fn frames(self) -> usize {
        self.along.count() * self.neighbours
    }

    /// What is known of a frame of an aligned window.
    pub(crate) fn of(self, alignment: &AlignedBurst<'_>, frame: usize) -> AlignedFrame {
        alignment.frame(frame, self.neighbours, self.along)
    }
}

/// The frames of a captured burst laid upon each other: by the classical guide, then by what each of `drafts` restores, the
/// pre-denoisers of a network before its last one.
///
/// # Errors
/// [`SimError`](qudi_core::SimError) if the sensor's dark rate is unknown, or the drafts' device fails.
pub fn aligned<'a>(
    burst: BurstView<'_>,
    acquisition: &'a Acquisition,
    drafts: &[Draft],
) -> Result<AlignedBurst<'a>> {
    let mut alignment =
        AlignedBurst::new(ReferenceEstimate::compute(burst, acquisition)?, acquisition);
    for draft in drafts {
        let better = draft.restore(&alignment)?;
        alignment = alignment.realign(better);
    }
    Ok(alignment)
}

/// What classical methods make of a burst, for a network to go on from; frame after frame, row-major. In this order: the
/// restored image, the merely merged one and the deviation of the latter's noise, in image units, in [0, 2]; the counts of the
/// frame and of its neighbours laid upon it, and what is expected of the neighbours, in deviations (see
/// [`AlignedFrame`]).
#[derive(Clone, Debug, Default)]
pub struct GuidePlanes(pub Vec<Vec<f32>>);

/// Planes in image units.
pub const IMAGES: usize = 3;

impl GuidePlanes {
    /// Planes with such frames laid upon each.
    pub fn count(laid: Laid) -> usize {
        IMAGES + 2 * laid.frames() + 1
    }

    /// Those of some frames of an aligned window.
    pub fn of(alignment: &AlignedBurst<'_>, laid: Laid, frames: Range<usize>) -> Self {
        let mut planes = Self::default();
        for frame in frames {
            planes.extend(Self::of_frame(laid.of(alignment, frame)));
        }
        planes
    }

    /// The planes of one frame.
    pub(crate) fn of_frame(frame: AlignedFrame) -> Self {
        let AlignedFrame { reference, merged, noise_sigma, counts, expected } = frame;
        let images = [reference, merged, noise_sigma].into_iter().map(|mut image| {
            image.data.iter_mut().for_each(|value| *value = value.min(BRIGHTEST as f32));
            image
        });
        Self(images.chain(counts).chain(expected).map(|plane| plane.data).collect())
    }

    /// Every plane changed by `f`.
    #[must_use]
    pub fn map(&self, f: impl Fn(&[f32]) -> Vec<f32>) -> Self {
        Self(self.0.iter().map(|plane| f(plane)).collect())
    }

    /// Appends another burst's.
    pub fn extend(&mut self, more: Self) {
        self.0.resize(more.0.len(), Vec::new());
        for (plane, more) in self.0.iter_mut().zip(more.0) {
            plane.extend(more);
        }
    }

    /// The planes as channels, `[frames, planes, height, width]`.
    pub fn into_tensor(self, size: Size, device: &Device) -> Tensor<4> {
        let planes = self.0.into_iter().map(|plane| to_tensor(plane, size, device));
        Tensor::cat(planes.collect(), 1)
    }
}

/// What a count of a sensor under a certain light means.
#[derive(Clone, Debug)]
pub struct CountResponse<'a> {
    sensor: &'a Sensor,
    photons_per_unit: f64,
    gain: f64,
    /// Counts over full scale, and linear estimates of an ordinary pixel, by count.
    table: Vec<(f32, f32)>,
}

impl<'a> CountResponse<'a> {
    /// For pixels with `dark` electrons per output frame.
    pub fn new(sensor: &'a Sensor, photons_per_unit: f64, gain: f64, dark: f64) -> Self {
        let mut response = Self { sensor, photons_per_unit, gain, table: Vec::new() };
        let full_scale = f32::from(sensor.max_count());
        let of = |count| (f32::from(count) / full_scale, response.estimate(count, dark));
        response.table = (0..=sensor.max_count()).map(of).collect();
        response
    }

    /// The linear estimate from one count, in image units.
    fn estimate(&self, count: u16, dark: f64) -> f32 {
        let photons = self.sensor.estimate_flux(f64::from(count), 1, self.gain, dark);
        (photons / self.photons_per_unit).min(BRIGHTEST) as f32
    }

    /// Deviation of the linear estimate at `detections` expected per output frame, from the count's exact law.
    fn linear_deviation(&self, detections: f64) -> f64 {
        let law = CountLaw::new(self.sensor, self.gain).probabilities(detections);
        let values = || law.iter().zip(&self.table).map(|(p, &(_, u))| (p, f64::from(u)));
        let mean: f64 = values().map(|(p, u)| p * u).sum();
        values().map(|(p, u)| p * (u - mean).powi(2)).sum::<f64>().sqrt()
    }

    /// Appends a frame. Counts above full scale, which no such sensor gives, count as full scale.
    pub fn add(&self, counts: &[u16], planes: &mut Planes) {
        let last = self.table.len() - 1;
        let values = counts.iter().map(|&count| self.table[usize::from(count).min(last)]);
        for (y, u) in values {
            planes.y.push(y);
            planes.u.push(u);
        }
    }
}

/// Dark electrons per output frame; none where the sensor does not say.
pub(crate) fn dark(sensor: &Sensor) -> f64 {
    sensor.dark_per_frame().unwrap_or(0.0)
}

/// The sensor and its light as the network is told them (docs/network.md).
pub fn sensor_numbers(acquisition: &Acquisition) -> [f32; SENSOR_NUMBERS] {
    let sensor = &acquisition.sensor;
    let binary = sensor.response == Response::Binary;
    let light = acquisition.photons_per_unit();
    let response = CountResponse::new(sensor, light, acquisition.gain, dark(sensor));
    let deviation = |image| {
        let detections = sensor.quantum_efficiency * image * light + dark(sensor);
        response.linear_deviation(detections).max(1e-4).log10()
    };
    [
        acquisition.ppp.max(1e-6).log10(),
        acquisition.exposure,
        sensor.quantum_efficiency,
        dark(sensor),
        sensor.read_noise,
        acquisition.gain.max(1e-6).log10(),
        (f64::from(sensor.max_count()) + 1.0).log2() / 8.0,
        f64::from(u8::from(binary)),
        f64::from(sensor.frames_summed).log2() / 8.0,
        deviation(0.0),
        deviation(acquisition.exposure),
    ]
    .map(|number| number as f32)
}
