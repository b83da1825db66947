//! A burst to learn from, and the network that does: what tests of the loss have in common.
#![allow(dead_code)] // each of them takes its part

use burn::tensor::{Device, Tensor};
use qudi_core::restorer::{Acquisition, BurstView};
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Frame, Light, Size};
use qudi_layers::tensor::to_tensor;
use qudi_model::config::NetworkConfig;
use qudi_model::counts::CountPlanes;
use qudi_model::diffusion::{Conditioning, DiffusionConfig};
use qudi_model::sensor::{response_tensor, sensor_tensor};
use qudi_train::diffusion::Example;

/// Counts of a disk that moves, their truth and their light.
pub(crate) struct Burst {
    pub(crate) counts: Vec<Vec<u16>>,
    pub(crate) conditioning: Conditioning,
    pub(crate) truth: Tensor<4>,
    pub(crate) acquisition: Acquisition,
    pub(crate) size: Size,
}

impl Burst {
    pub(crate) fn example<'a>(&'a self, noise: Tensor<4>, timesteps: &'a [usize]) -> Example<'a> {
        Example {
            conditioning: &self.conditioning,
            truth: self.truth.clone(),
            acquisitions: std::slice::from_ref(&self.acquisition),
            noise,
            timesteps,
        }
    }
}

pub(crate) fn tiny() -> DiffusionConfig {
    let text = include_str!("../../../../tests/golden/tiny.toml");
    let NetworkConfig::Diffusion(config) = NetworkConfig::parse(text, "tiny").unwrap() else {
        panic!("tiny is a diffusion")
    };
    config
}

/// Returns a burst of a scene whose values are these, on the ground's upper border and on the disk.
pub(crate) fn burst([ground, disk]: [f32; 2], size: Size, frames: usize, device: &Device) -> Burst {
    let sensor = Sensor::load("qudi-paper").unwrap();
    let light = Light { ppp: 3.25, mean_level: 0.45 };
    let mut camera = Camera::new(&sensor, size, light, 4).unwrap();
    let scene = |t: usize| {
        Frame::from_fn(size, |x, y| {
            let (dx, dy) = (x as f32 - 10.0 - t as f32, y as f32 - 14.0);
            if dx * dx + dy * dy < 40.0 { disk } else { ground + 0.01 * y as f32 }
        })
    };
    let truth: Vec<Frame> = (0..frames).map(scene).collect();
    let counts: Vec<Vec<u16>> =
        truth.iter().enumerate().map(|(t, f)| camera.expose(t as u64, &[f]).unwrap()).collect();
    let acquisition = Acquisition::new(sensor, light.ppp, light.mean_level).unwrap();
    let view = BurstView { size, frames: &counts };
    let planes = CountPlanes::new(view, &acquisition);
    let conditioning = Conditioning {
        counts: to_tensor(planes.y, size, device),
        linear_estimate: to_tensor(planes.u, size, device),
        sensor: sensor_tensor(&acquisition, device),
        response: response_tensor(&acquisition, device),
        frames,
        motion: Vec::new(),
    };
    let truth = truth.into_iter().flat_map(|frame| frame.data).collect();
    Burst { counts, conditioning, truth: to_tensor(truth, size, device), acquisition, size }
}
