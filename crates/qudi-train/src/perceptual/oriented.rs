//! A distance of normalised responses of oriented filters: the model of early vision of Teo and Heeger (1994,
//! "Perceptual image distortion"), made small.
//!
//! At each of up to four scales (means of 2 x 2 pixels) the image is filtered with Gabor functions (Daugman
//! 1985) of four orientations, each in an even and an odd phase. Every response is divided by the root of the
//! sum of all squared responses at that place and of a constant (Heeger 1992): contrast counts less where there
//! is more of it. Two things are compared: these responses, and for every orientation the sum of squares of the
//! two phases, its energy (Adelson and Bergen 1985), which does not depend on where in a texture its lines are.

use super::scales;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_kernels::conv::{Options, conv_2d};
use qudi_model::network::halve;
use std::f64::consts::{PI, TAU};

/// Orientations, evenly over half a turn.
const ORIENTATIONS: usize = 4;

/// Pixels of a filter's side.
pub(super) const SIDE: usize = 9;

/// Pixels of a period at the finest scale.
const PERIOD: f64 = 4.0;

/// Deviation of the filters' window, pixels: a bandwidth of about an octave.
const SIGMA: f64 = 2.0;

/// Scales.
const SCALES: usize = 4;

/// Contrast, in image units, below which responses are hardly normalised.
const FLOOR: f32 = 0.02;

/// The filters.
#[derive(Clone, Debug)]
pub(super) struct Oriented {
    /// `[8, 1, 9, 9]`: the even ones, then the odd ones.
    bank: Tensor<4>,
}

impl Oriented {
    pub(super) fn new(device: &Device) -> Self {
        let filters = |phase: f64| (0..ORIENTATIONS).flat_map(move |number| filter(number, phase));
        let values: Vec<f32> = filters(0.0).chain(filters(PI / 2.0)).collect();
        let shape = [2 * ORIENTATIONS, 1, SIDE, SIDE];
        Self { bank: Tensor::from_data(TensorData::new(values, shape), device) }
    }

    /// `[images]`, from images `[images, 1, height, width]` in [0, 1]: squared differences of responses and of
    /// energies, summed over the filters, averaged over pixels whose filters are within the image, and over
    /// scales.
    pub(super) fn distances(&self, mut p: Tensor<4>, mut q: Tensor<4>) -> Tensor<1> {
        let [images, _, height, width] = p.dims();
        let count = scales([height, width], SIDE, SCALES);
        let mut sum = Tensor::zeros([images], &p.device());
        for scale in 0..count {
            let (responses_p, energies_p) = self.responses(p.clone());
            let (responses_q, energies_q) = self.responses(q.clone());
            let error =
                |a: Tensor<4>, b: Tensor<4>| super::image_means((a - b).powi_scalar(2).sum_dim(1));
            sum = sum + error(responses_p, responses_q) + error(energies_p, energies_q);
            if scale + 1 < count {
                (p, q) = (halve(p), halve(q));
            }
        }
        sum / count as f32
    }

    /// Normalised responses `[images, 8, rows, columns]` and energies `[images, 4, rows, columns]`.
    fn responses(&self, x: Tensor<4>) -> (Tensor<4>, Tensor<4>) {
        let [_, _, height, width] = x.dims();
        let bank = self.bank.clone();
        let zero = Tensor::zeros([2 * ORIENTATIONS], &x.device());
        let x = conv_2d(&[x], bank, zero, Options::default());
        let x = x.narrow(2, SIDE / 2, height + 1 - SIDE).narrow(3, SIDE / 2, width + 1 - SIDE);
        let total = (x.clone().powi_scalar(2).sum_dim(1) + FLOOR * FLOOR).sqrt();
        let x = x / total;
        let squares = x.clone().powi_scalar(2);
        let phase = |first: usize| squares.clone().narrow(1, first, ORIENTATIONS);
        (x, phase(0) + phase(ORIENTATIONS))
    }
}

/// A Gabor function: a Gaussian window times `cos(2 pi u / period - phase)`, `u` the distance along the
/// orientation; without response to a constant; and with response 1 to its own grating of amplitude 1.
fn filter(orientation: usize, phase: f64) -> Vec<f32> {
    let angle = orientation as f64 * PI / ORIENTATIONS as f64;
    let middle = (SIDE / 2) as f64;
    let places = (0..SIDE * SIDE).map(|i| ((i % SIDE) as f64 - middle, (i / SIDE) as f64 - middle));
    let points: Vec<(f64, f64)> = places
        .map(|(x, y)| {
            let window = (-(x * x + y * y) / (2.0 * SIGMA * SIGMA)).exp();
            let u = x * angle.cos() + y * angle.sin();
            (window, (TAU * u / PERIOD - phase).cos())
        })
        .collect();
    let windows: f64 = points.iter().map(|(window, _)| window).sum();
    let mean = points.iter().map(|(window, wave)| window * wave).sum::<f64>() / windows;
    let response: f64 = points.iter().map(|(window, wave)| window * (wave - mean) * wave).sum();
    points.iter().map(|(window, wave)| (window * (wave - mean) / response) as f32).collect()
}
