//! The network that corrects colours behind a filter: luma and the ratios of red, green and blue to it, from
//! what the counts tell beyond them.
//!
//! `scripts/colour_network.py` trains it, on evidence that the example `colour_evidence` writes.

use crate::window::hourglass::{CoarseEntry, Hourglass};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_burst::{ColourCorrector, ColourEvidence, CorrectedColours};
use qudi_core::Result;
use qudi_kernels::{ComputePrecision, with_precision};
use qudi_layers::resample::{pixel_shuffle, pixel_unshuffle};
use qudi_layers::{Bias, Conv2d, StateDict, TILE, Tiling, init_parameters, parameter_shapes};
use std::collections::HashMap;
use std::path::Path;

/// Channels at half, a quarter and an eighth of the resolution.
const WIDTHS: [usize; 3] = [32, 64, 64];

/// Frames have sides that are multiples of this.
const MULTIPLE: usize = 8;

/// Outputs: corrections of three ratios and of the logarithm of luma.
const OUTPUTS: usize = 4;

/// Change of a ratio for an output of 1.
const RATIO_STEP: f32 = 0.3;

/// Change of the logarithm of luma for an output of 1.
const LUMA_STEP: f32 = 0.1;

/// Largest ratio of a colour to luma, 1 of gray.
const MAX_RATIO: f32 = 12.0;

/// Least weighted sum of ratios.
const MIN_SUM: f32 = 1e-3;

/// The layers.
#[derive(Module, Debug)]
struct Layers {
    hourglass: Hourglass,
    out: Conv2d,
}

/// The network with its weights.
#[derive(Debug)]
pub struct ColourNetwork {
    layers: Layers,
    precision: ComputePrecision,
    device: Device,
}

impl Layers {
    fn zeros(device: &Device) -> Self {
        Self {
            hourglass: Hourglass::zeros(
                4 * ColourEvidence::PLANES,
                0,
                WIDTHS,
                CoarseEntry::Rectified,
                device,
            ),
            out: Conv2d::zeros([WIDTHS[0] / 4, OUTPUTS], 3, Bias::Yes, device),
        }
    }

    /// Computes `[images, 4, height, width]` from features, `[images, 15, height, width]`.
    fn forward(&self, features: Tensor<4>) -> Tensor<4> {
        let [finest, ..] = self.hourglass.forward(&[pixel_unshuffle(features, 2)], None);
        self.out.linear(&[pixel_shuffle(finest, 2)])
    }
}

impl ColourNetwork {
    /// Reads the weights in `bytes`, a SafeTensors file; `path` is used in errors only.
    ///
    /// # Errors
    /// [`Error::Data`](qudi_core::Error::Data) if these are no weights of this network.
    pub fn of_bytes(
        bytes: &[u8],
        path: &Path,
        precision: ComputePrecision,
        device: &Device,
    ) -> Result<Self> {
        let file = StateDict::of_bytes(bytes.to_vec(), path)?;
        let layers = Layers::zeros(device);
        let mut values = HashMap::new();
        for (name, shape) in parameter_shapes(&layers) {
            values.insert(name.clone(), file.read(&name, &shape)?);
        }
        let layers = init_parameters(layers, |name, _| values.remove(name).unwrap_or_default());
        Ok(Self { layers, precision, device: device.clone() })
    }

    /// Computes the four outputs for every pixel.
    fn outputs(&self, evidence: &ColourEvidence) -> Result<Vec<Vec<f32>>> {
        let tiling = Tiling::new(evidence.size, MULTIPLE, TILE);
        let planes = tiling.padded(&features(evidence));
        let Tiling { tiles, .. } = &tiling;
        let shape = [1, ColourEvidence::PLANES, tiles.tile.height, tiles.tile.width];
        let outputs = tiling.joined(|number| {
            let tile = TensorData::new(tiles.crop(number, &planes), shape);
            let output = self.layers.forward(Tensor::from_data(tile, &self.device));
            Ok((0..OUTPUTS).map(|k| output.clone().narrow(1, k, 1)).collect())
        })?;
        Ok(outputs.into_iter().map(|frame| frame.data).collect())
    }
}

impl ColourCorrector for ColourNetwork {
    fn correct(&self, evidence: &ColourEvidence) -> Result<CorrectedColours> {
        let outputs = with_precision(self.precision, || self.outputs(evidence))?;
        let pixels = evidence.size.pixels();
        let output = |k: usize, i: usize| outputs[k][i];
        let mut ratios: [Vec<f32>; 3] = std::array::from_fn(|_| Vec::with_capacity(pixels));
        for i in 0..pixels {
            let corrected: [f32; 3] = std::array::from_fn(|k| {
                let ratio = evidence.planes[(1 + k) * pixels + i];
                (ratio + RATIO_STEP * output(k, i)).clamp(0.0, MAX_RATIO)
            });
            let sum: f32 = corrected.iter().zip(&evidence.weights).map(|(r, w)| r * w).sum();
            for (ratios, ratio) in ratios.iter_mut().zip(corrected) {
                ratios.push(ratio / sum.max(MIN_SUM));
            }
        }
        let luma = (0..pixels).map(|i| (LUMA_STEP * output(3, i)).clamp(-1.0, 1.0).exp()).collect();
        Ok(CorrectedColours { luma, ratios })
    }
}

/// Scales the planes of evidence to inputs of about unit size.
fn features(evidence: &ColourEvidence) -> Vec<f32> {
    let pixels = evidence.size.pixels();
    let scaled = |(i, &value): (usize, &f32)| match i / pixels {
        0 => 0.7 * (value + 0.02).max(1e-4).ln(),
        1..4 => (value - 1.0).min(4.0),
        4..7 | 13 => (0.5 * value).clamp(-2.5, 2.5),
        7..10 => (0.3 * value).min(4.0),
        10..13 => (3.0 * value).min(3.0),
        _ => (0.1 * value).min(4.0),
    };
    evidence.planes.iter().enumerate().map(scaled).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cases::{File, parameter};
    use qudi_core::Size;

    /// Creates the network with weights by formula.
    fn network(device: &Device) -> ColourNetwork {
        let layers = init_parameters(Layers::zeros(device), parameter);
        ColourNetwork { layers, precision: ComputePrecision::F32, device: device.clone() }
    }

    #[test]
    fn corrections_are_the_ones_of_the_training() {
        let file = File::open("network/colour");
        let size = Size { height: 20, width: 24 };
        let weights = [0.25, 0.5, 0.25];
        let evidence = ColourEvidence { size, frame: 0, planes: file.f32s("evidence"), weights };
        let corrected = network(&Device::flex()).correct(&evidence).unwrap();
        let expected = file.f32s("colours");
        let pixels = size.pixels();
        for (k, ratios) in corrected.ratios.iter().enumerate() {
            for i in 0..pixels {
                let value = evidence.planes[i] * corrected.luma[i] * ratios[i];
                let reference = expected[k * pixels + i];
                assert!(
                    (value - reference).abs() < 1e-4 * (1.0 + reference.abs()),
                    "{k}, {i}: {value} {reference}"
                );
            }
        }
    }

    #[test]
    fn weights_of_other_networks_are_refused() {
        let bytes = std::fs::read(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../tests/golden/network/colour.safetensors"
        ))
        .unwrap();
        let read = ColourNetwork::of_bytes(
            &bytes,
            Path::new("colour.safetensors"),
            ComputePrecision::F32,
            &Device::flex(),
        );
        let error = read.unwrap_err().to_string();
        assert!(error.contains("is missing"), "{error}");
    }
}
