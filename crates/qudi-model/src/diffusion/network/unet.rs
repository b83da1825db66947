//! The U-Net that predicts the clean frames (Ho et al. 2020).

use super::attention::Attention;
use super::embedding::sinusoids;
use super::features::Pyramid;
use crate::diffusion::precondition::Preconditioned;
use crate::diffusion::state::DiffusionState;
use crate::diffusion::{FusionConfig, UNetConfig, UNetPrediction};
use crate::sensor::SENSOR_NUMBERS;
use burn::module::Module;
use burn::tensor::activation::silu;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle, repeat};
use qudi_layers::{Bias, Conv2d, GroupNorm, Linear};

/// Two convolutions with norms, modulated by the embedding (FiLM, Perez et al. 2018).
#[derive(Module, Debug)]
pub(crate) struct ResidualBlock {
    norm1: GroupNorm,
    conv1: Conv2d,
    film: Linear,
    norm2: GroupNorm,
    conv2: Conv2d,
    skip: Option<Conv2d>,
}

impl ResidualBlock {
    pub(crate) fn zeros([inputs, outputs]: [usize; 2], embedding: usize, device: &Device) -> Self {
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        Self {
            norm1: GroupNorm::zeros(inputs, device),
            conv1: conv([inputs, outputs], 3),
            film: Linear::zeros([embedding, 2 * outputs], device),
            norm2: GroupNorm::zeros(outputs, device),
            conv2: conv([outputs, outputs], 3),
            skip: (inputs != outputs).then(|| conv([inputs, outputs], 1)),
        }
    }

    /// `x`: `[images, inputs, h, w]`; `embedding`: `[bursts, M]` after SiLU.
    pub(crate) fn forward(&self, x: Tensor<4>, embedding: Tensor<2>) -> Tensor<4> {
        let h = self.conv1.linear(&[self.norm1.silu(x.clone())]);
        let film = self.film.forward(embedding);
        let outputs = film.dims()[1] / 2;
        let scale = film.clone().narrow(1, 0, outputs);
        let shift = film.narrow(1, outputs, outputs);
        let h = self.norm2.film_silu(h, scale, shift);
        let shortcut = match &self.skip {
            Some(skip) => skip.linear(&[x]),
            None => x,
        };
        self.conv2.add(&[h], shortcut)
    }
}

/// The blocks of a level, in the encoder or the decoder.
#[derive(Module, Debug)]
struct Level {
    blocks: Vec<ResidualBlock>,
    attention: Vec<Attention>,
}

impl Level {
    fn zeros(
        config: &UNetConfig,
        k: usize,
        sizes: impl Fn(usize) -> [usize; 2],
        device: &Device,
    ) -> Self {
        let block = |j| ResidualBlock::zeros(sizes(j), config.embedding, device);
        let attention = if config.attention.contains(&k) { config.blocks } else { 0 };
        let attention = (0..attention).map(|j| Attention::zeros(sizes(j)[1], device));
        Self { blocks: (0..config.blocks).map(block).collect(), attention: attention.collect() }
    }

    fn block(&self, j: usize, x: Tensor<4>, embedding: &Tensor<2>) -> Tensor<4> {
        let x = self.blocks[j].forward(x, embedding.clone());
        match self.attention.get(j) {
            Some(attention) => attention.forward(x),
            None => x,
        }
    }
}

#[derive(Module, Debug)]
struct Middle {
    first: ResidualBlock,
    attention: Attention,
    second: ResidualBlock,
}

/// The U-Net.
#[derive(Module, Debug)]
pub(crate) struct UNet {
    time_in: Linear,
    time_out: Linear,
    sensor_in: Linear,
    sensor_out: Linear,
    inp: Conv2d,
    merge: Vec<Conv2d>,
    encoder: Vec<Level>,
    down: Vec<Conv2d>,
    middle: Middle,
    decoder: Vec<Level>,
    /// To levels 0 and up.
    up: Vec<Conv2d>,
    norm: GroupNorm,
    out: Conv2d,
    fold: usize,
}

impl UNetPrediction {
    /// Returns the number of images that the U-Net sees besides the fused features.
    fn planes(self) -> usize {
        match self {
            Self::X0 => 4,
            Self::Correction => 6,
        }
    }

    /// Collects these images; `measured` are linear estimate and counts, in [-1, 1].
    pub(crate) fn images(
        self,
        noisy: &Preconditioned,
        state: &DiffusionState,
        measured: &Tensor<4>,
    ) -> Vec<Tensor<4>> {
        let Preconditioned { mean, residual, previous, log_snr, .. } = noisy.clone();
        match self {
            Self::X0 => {
                let linear_estimate = measured.clone().narrow(1, 0, 1);
                vec![mean, state.x_t.clone(), state.previous(), linear_estimate]
            }
            Self::Correction => vec![mean, residual, previous, measured.clone(), log_snr],
        }
    }
}

impl UNetConfig {
    /// Creates the U-Net that takes fused features of these widths, all weights zero.
    pub(crate) fn init(&self, fusion: &FusionConfig, fold: usize, device: &Device) -> UNet {
        let channels: Vec<usize> = self.multipliers.iter().map(|m| m * self.width).collect();
        let levels = channels.len();
        let size = self.embedding;
        let linear = |inputs| Linear::zeros([inputs, size], device);
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        let before = |k: usize| channels[k.saturating_sub(1)];
        let encoder = |k: usize| {
            let first = |j| [if j == 0 { before(k) } else { channels[k] }, channels[k]];
            Level::zeros(self, k, first, device)
        };
        let decoder = |k: usize| Level::zeros(self, k, |_| [2 * channels[k], channels[k]], device);
        let deepest = channels[levels - 1];
        let residual = || ResidualBlock::zeros([deepest, deepest], self.embedding, device);
        UNet {
            time_in: linear(size),
            time_out: linear(size),
            sensor_in: linear(SENSOR_NUMBERS),
            sensor_out: linear(size),
            inp: conv([self.predicts.planes() * fold * fold, channels[0]], 3),
            merge: (0..levels.min(3))
                .map(|k| conv([before(k) + fusion.widths[k], before(k)], 1))
                .collect(),
            encoder: (0..levels).map(encoder).collect(),
            down: (1..levels).map(|k| conv([channels[k - 1], channels[k - 1]], 3)).collect(),
            middle: Middle {
                first: residual(),
                attention: Attention::zeros(deepest, device),
                second: residual(),
            },
            decoder: (0..levels).map(decoder).collect(),
            up: (1..levels).map(|k| conv([channels[k], channels[k - 1]], 3)).collect(),
            norm: GroupNorm::zeros(channels[0], device),
            out: conv([channels[0], fold * fold], 3),
            fold,
        }
    }
}

impl UNet {
    /// Encodes the sensor for the embedding, `[bursts, M]`; does not depend on the step.
    pub(crate) fn encode(&self, sensor: Tensor<2>) -> Tensor<2> {
        self.sensor_out.forward(silu(self.sensor_in.forward(sensor)))
    }

    /// Embeds timesteps, one for each burst, and the sensor.
    fn embed(&self, timesteps: &[usize], sensor: Tensor<2>) -> Tensor<2> {
        let [bursts, size] = sensor.dims();
        let angles = TensorData::new(sinusoids(timesteps, size), [bursts, size]);
        let angles = Tensor::from_data(angles, &sensor.device());
        self.time_out.forward(silu(self.time_in.forward(angles))) + sensor
    }

    /// Computes the output of the U-Net, `[images, 1, H, W]`. `planes` are images that it sees besides the
    /// fused features; `timesteps` has one number for each burst; `sensor` is as from [`Self::encode`].
    pub(crate) fn forward(
        &self,
        planes: Vec<Tensor<4>>,
        fused: Pyramid,
        timesteps: &[usize],
        sensor: Tensor<2>,
    ) -> Tensor<4> {
        let embedding = silu(self.embed(timesteps, sensor));
        let mut x = self.inp.linear(&[pixel_unshuffle(Tensor::cat(planes, 1), self.fold)]);
        let mut skips = Vec::new();
        let mut fused = fused.into_iter();
        for (k, level) in self.encoder.iter().enumerate() {
            if k > 0 {
                x = self.down[k - 1].stride2(&[x]);
            }
            if let (Some(merge), Some(fused)) = (self.merge.get(k), fused.next()) {
                x = merge.linear(&[x, fused]);
            }
            for j in 0..level.blocks.len() {
                x = level.block(j, x, &embedding);
                skips.push(x.clone());
            }
        }
        x = self.middle.first.forward(x, embedding.clone());
        x = self.middle.attention.forward(x);
        x = self.middle.second.forward(x, embedding.clone());
        for (k, level) in self.decoder.iter().enumerate().rev() {
            for j in 0..level.blocks.len() {
                let skip = skips.pop().expect("a skip for every block");
                x = level.block(j, Tensor::cat(vec![x, skip], 1), &embedding);
            }
            if k > 0 {
                x = self.up[k - 1].linear(&[repeat(x)]);
            }
        }
        pixel_shuffle(self.out.linear(&[self.norm.silu(x)]), self.fold)
    }
}
