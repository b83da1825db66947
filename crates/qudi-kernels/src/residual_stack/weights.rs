//! Weights as tiles of bfloat16.

use super::buffer::Buffer;
use super::forward::Parameters;
use super::grid::TILE;
use super::layout::{CHANNELS, narrow};
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// Taps of a kernel.
pub(super) const TAPS: usize = 9;

/// Values of a tile of weights: 16 pairs of inputs by 16 outputs.
pub(super) const TILE_VALUES: usize = TILE * 2 * TILE;

/// Weights of a convolution, `[outputs / 16][tap][inputs / 32][16 pairs][16 outputs][2]`.
#[derive(Clone, Debug)]
pub(super) struct Tiles {
    pub(super) values: Buffer,
    /// Channels that are read, a multiple of 32.
    pub(super) inputs: usize,
    /// Channels that are written, a multiple of 32.
    pub(super) outputs: usize,
}

/// The parameters of a stack as tiles, packed when they are first needed and kept as long as the stack.
#[derive(Clone, Debug, Default)]
pub(super) struct Packed(Arc<[OnceLock<Vec<Tiles>>; 2]>);

impl Packed {
    /// Returns the weights of all convolutions.
    pub(super) fn forward(&self, convolutions: &[Parameters<'_>]) -> &[Tiles] {
        Self::get(&self.0[0], convolutions, Tiles::forward)
    }

    /// Returns the weights of the gradients for the inputs of all convolutions.
    pub(super) fn backward(&self, convolutions: &[Parameters<'_>]) -> &[Tiles] {
        Self::get(&self.0[1], convolutions, Tiles::backward)
    }

    fn get<'a>(
        tiles: &'a OnceLock<Vec<Tiles>>,
        convolutions: &[Parameters<'_>],
        pack: fn(&[f32], [usize; 2]) -> Tiles,
    ) -> &'a [Tiles] {
        if let Some(tiles) = tiles.get() {
            return tiles;
        }
        // Threads that come at once pack twice: waiting for one another they could take each other's work.
        let work = convolutions.par_iter().map(|conv| pack(conv.weight, conv.sizes));
        let packed = work.collect();
        tiles.get_or_init(|| packed)
    }
}

impl Tiles {
    /// Packs `weight`, `[outputs, inputs, 3, 3]`.
    pub(super) fn forward(weight: &[f32], [inputs, outputs]: [usize; 2]) -> Self {
        Self::packed([inputs, outputs], |output, input, tap| {
            weight[(output * inputs + input) * TAPS + tap]
        })
    }

    /// Packs the weights of the gradient for the inputs: inputs and outputs change places, and so do opposite
    /// taps.
    pub(super) fn backward(weight: &[f32], [inputs, outputs]: [usize; 2]) -> Self {
        Self::packed([outputs, inputs], |input, output, tap| {
            weight[(output * inputs + input) * TAPS + TAPS - 1 - tap]
        })
    }

    fn packed([inputs, outputs]: [usize; 2], weight: impl Fn(usize, usize, usize) -> f32) -> Self {
        let padded = [inputs, outputs].map(|channels| channels.next_multiple_of(CHANNELS));
        let mut values = Buffer::zeros(padded[0] * padded[1] * TAPS);
        let groups = padded[0] / CHANNELS;
        for output in 0..outputs {
            for input in 0..inputs {
                let row = input % CHANNELS / 2;
                let place = (row * TILE + output % TILE) * 2 + input % 2;
                let tiles = output / TILE * TAPS * groups + input / CHANNELS;
                for tap in 0..TAPS {
                    let tile = tiles + tap * groups;
                    values[tile * TILE_VALUES + place] = narrow(weight(output, input, tap));
                }
            }
        }
        Self { values, inputs: padded[0], outputs: padded[1] }
    }
}
