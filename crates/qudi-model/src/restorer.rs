//! Quanta Diffusion as a restorer: windows of counts in, clean frames and their uncertainty out.

mod diffusion;
mod regression;

use crate::checkpoint::ModelKind;
use crate::config::NetworkConfig;
use crate::diffusion::sampler::Sampler;
use crate::diffusion::timesteps::{NUM_TIMESTEPS, TimestepSpacing};
use crate::network::Qudi;
use burn::tensor::Device;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::{Error, Result};
use qudi_kernels::{ComputePrecision, with_precision};
use qudi_layers::TILE;

pub use diffusion::DiffusionRestorer;
pub use regression::RegressionRestorer;

/// The fewest frames of a window that the temporal fusion can use.
pub const MIN_FRAMES: usize = 3;

/// How to sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOptions {
    /// Reverse steps. 0 restores by regression: the pre-denoised frames, filtered over time. 1 gives the mean
    /// of all pictures that fit; more steps give sharper ones.
    pub steps: usize,
    /// The spacing of their timesteps.
    pub spacing: TimestepSpacing,
    /// The sampler.
    pub sampler: Sampler,
    /// Samples drawn. Their mean is the result, their standard deviation its uncertainty.
    pub samples: usize,
    /// Side of the tiles that the network sees, in pixels.
    pub tile: usize,
    /// Numbers that convolutions multiply.
    pub precision: ComputePrecision,
}

impl Default for SampleOptions {
    fn default() -> Self {
        Self {
            steps: 1,
            spacing: TimestepSpacing::default(),
            sampler: Sampler::Ddim,
            samples: 1,
            tile: TILE,
            precision: ComputePrecision::F32,
        }
    }
}

/// A network with what restoring needs to know about it.
#[derive(Debug)]
pub struct Model {
    /// The network, on the device that computes.
    pub network: Qudi,
    /// Its sizes.
    pub config: NetworkConfig,
    /// Which of its parts have learnt.
    pub kind: ModelKind,
    /// The usual number of frames of a window.
    pub window: usize,
}

/// Restores by regression or by diffusion, as model and options say.
#[derive(Debug)]
pub struct QudiRestorer {
    way: Way,
    precision: ComputePrecision,
}

/// How frames are made.
#[derive(Debug)]
enum Way {
    /// By regression: the pre-denoised frames.
    Regression(Box<RegressionRestorer>),
    /// By diffusion, which starts from them.
    Diffusion(Box<DiffusionRestorer>),
}

impl QudiRestorer {
    /// The restorer of a model whose weights are on `device`. A model of [`ModelKind::Regression`] restores
    /// by regression for any number of steps: its U-Net changes nothing.
    ///
    /// # Errors
    /// [`Error::Request`] for options that make no sense.
    pub fn new(model: Model, options: SampleOptions, device: &Device) -> Result<Self> {
        if options.steps > NUM_TIMESTEPS {
            let what = format!("{} reverse steps", options.steps);
            return Err(Error::request(what, "steps", format!("use 0 to {NUM_TIMESTEPS}")));
        }
        if options.samples == 0 {
            return Err(Error::request("no samples at all", "samples", "draw at least 1"));
        }
        let diffuses = model.kind != ModelKind::Regression;
        if options.samples > 1 && !diffuses {
            return Err(Error::request(
                "these weights make the same picture of any noise: samples would not differ",
                "samples",
                "leave it out, or use weights that learnt with train.loss.prediction above 0 (docs/training.md)",
            ));
        }
        if options.samples > 1 && options.steps == 0 {
            let what = "samples do not differ where nothing is diffused";
            return Err(Error::request(what, "samples", "take some steps, such as `steps 10`"));
        }
        let smallest = 4 * model.config.multiple();
        if options.tile < smallest {
            let what = format!("tiles of {} pixels", options.tile);
            let help = format!("this network needs at least {smallest}");
            return Err(Error::request(what, "tile", help));
        }
        let way = if diffuses && options.steps > 0 {
            Way::Diffusion(Box::new(DiffusionRestorer::new(model, options, device)))
        } else {
            Way::Regression(Box::new(RegressionRestorer::new(model, options.tile, device)))
        };
        Ok(Self { way, precision: options.precision })
    }
}

impl Restorer for QudiRestorer {
    fn name(&self) -> &'static str {
        "qudi"
    }

    fn window(&self) -> usize {
        match &self.way {
            Way::Regression(restorer) => restorer.window(),
            Way::Diffusion(restorer) => restorer.window(),
        }
    }

    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored> {
        let frames = burst.frames.len();
        if frames < MIN_FRAMES {
            return Err(Error::request(
                format!("a burst of {frames} frames"),
                "method",
                format!("it needs at least {MIN_FRAMES}, better {}", self.window()),
            ));
        }
        let restored = with_precision(self.precision, || match &mut self.way {
            Way::Regression(restorer) => restorer.restore(burst, acquisition),
            Way::Diffusion(restorer) => restorer.restore(burst, acquisition),
        })?;
        Ok(restored.only(numbers))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::refinement::{align, filter_over_time};
    use qudi_core::Size;
    use qudi_core::sensor::Sensor;

    /// The U-Net of initial weights changes nothing: one step of diffusion gives the pre-denoised frames, in
    /// tiles, too.
    #[test]
    fn diffusion_with_initial_weights_equals_regression() {
        let size = Size { height: 24, width: 48 };
        let counts: Vec<Vec<u16>> = (0..3)
            .map(|t| (0..size.pixels()).map(|i| ((i * 7 + t * 13) % 8) as u16).collect())
            .collect();
        let sensor = Sensor::load("qudi-paper").unwrap();
        let acquisition = Acquisition::new(sensor, 3.25, 0.3).unwrap().with_seed(1);
        let (config, device) = (
            NetworkConfig::parse(include_str!("../../../tests/golden/tiny.toml"), "tiny").unwrap(),
            Device::flex(),
        );
        let options = SampleOptions { steps: 1, tile: 32, ..SampleOptions::default() };
        let burst = BurstView { size, frames: &counts };
        let restored = |kind: ModelKind| {
            let (network, config) = (config.init(2, &device), config.clone());
            let model = Model { network, config, kind, window: 11 };
            let mut restorer = QudiRestorer::new(model, options, &device).unwrap();
            assert_eq!(matches!(restorer.way, Way::Regression(_)), kind == ModelKind::Regression);
            restorer.restore(burst, &acquisition).unwrap().frames
        };
        let regression = restored(ModelKind::Regression);
        let neighbours = config.pre.aligned_neighbours();
        let aligned = align(burst, &acquisition, &[]).unwrap();
        for kind in [ModelKind::Diffusion, ModelKind::DiffusionAfterRegression] {
            let sigmas = (0..counts.len())
                .map(|frame| neighbours.frame(&aligned, frame).noise_sigma)
                .collect();
            let diffusion = filter_over_time(&aligned, restored(kind), sigmas, 1.0);
            for (a, b) in regression.iter().zip(&diffusion) {
                for (a, b) in a.data.iter().zip(&b.data) {
                    assert!((a - b).abs() < 1e-5, "{a} and {b}");
                }
            }
        }
    }
}
