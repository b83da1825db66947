//! A matrix unit, and the loops around it.
#![allow(unsafe_code)]

use super::buffer::Buffer;
use super::grid::{BLOCK, Grid, TILE};
use super::layout::{CHANNELS, Line, Shared, narrow, widen};
use super::transposition::transposed;
use super::weights::{TAPS, TILE_VALUES, Tiles};
use rayon::prelude::*;

/// Sums of a block, `[32 rows][32 columns]`: two tiles by two.
#[repr(C, align(64))]
#[derive(Clone, Debug)]
pub(super) struct Sums(pub(super) [[f32; BLOCK]; BLOCK]);

/// Products of two tiles on the left by two on the right, for a list of places. Distances are in bytes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Products {
    /// The tiles on the left: rows of 32 values.
    pub(super) left: [*const u16; 2],
    /// From one row on the left to the next.
    pub(super) left_row: usize,
    /// The tiles on the right: 16 rows of 16 pairs.
    pub(super) right: [*const u16; 2],
    /// From one row on the right to the next.
    pub(super) right_row: usize,
    /// Number of products.
    pub(super) steps: usize,
    /// Distances from the tiles of one product to the tiles of the next, left and right.
    pub(super) step: [usize; 2],
}

/// A unit that multiplies tiles of bfloat16 and adds up 32 bits.
pub(super) trait Unit {
    /// Makes the unit ready on this thread.
    ///
    /// # Safety
    /// The machine must have the unit.
    unsafe fn configured() -> Self;

    /// Sets the sums that the unit holds to zero.
    ///
    /// # Safety
    /// All pointers of this and the following must be valid.
    unsafe fn clear(&mut self);

    /// Loads the sums.
    unsafe fn load(&mut self, sums: &Sums);

    /// Adds products to the sums.
    unsafe fn add(&mut self, products: &Products);

    /// Stores the sums.
    unsafe fn store(&mut self, sums: &mut Sums);
}

/// What follows the sums of a convolution.
#[derive(Clone, Copy, Debug)]
pub(super) struct Finish<'a> {
    /// Added to every pixel; none for gradients.
    pub(super) bias: Option<&'a [f32]>,
    /// Added pixel by pixel; may be where the result goes.
    pub(super) addend: Option<*const u16>,
    /// Negative sums become zero.
    pub(super) relu: bool,
    /// Sums become zero where this is zero: the gradient of a ReLU.
    pub(super) mask: Option<&'a Line>,
}

// SAFETY: the addend is read by the thread that writes the same pixels.
unsafe impl Sync for Finish<'_> {}

/// Blocks of a band, which one thread computes at once.
const BAND: usize = 8;

/// A function that convolves some blocks of pixels.
pub(super) type ConvolveBand<U> =
    unsafe fn(&mut U, &Grid, &Line, &Tiles, Finish<'_>, Shared<u16>, [usize; 2]);

/// Convolves a line into another one.
///
/// # Safety
/// The machine must have the unit; lines must belong to the grid and have the channels of the weights.
pub(super) unsafe fn convolve<U: Unit>(
    grid: &Grid,
    from: &Line,
    tiles: &Tiles,
    finish: Finish<'_>,
    to: Shared<u16>,
    band: ConvolveBand<U>,
) {
    let blocks = grid.blocks();
    (0..blocks.div_ceil(BAND)).into_par_iter().for_each(|number| {
        let range = [number * BAND, blocks.min((number + 1) * BAND)];
        // SAFETY: the caller's promise; bands write pixels of their own.
        unsafe {
            let mut unit = U::configured();
            band(&mut unit, grid, from, tiles, finish, to, range);
        }
    });
}

/// Convolves some blocks of pixels.
///
/// # Safety
/// As for [`convolve`].
#[inline(always)]
pub(super) unsafe fn convolve_band<U: Unit>(
    unit: &mut U,
    grid: &Grid,
    from: &Line,
    tiles: &Tiles,
    finish: Finish<'_>,
    to: Shared<u16>,
    [start, end]: [usize; 2],
) {
    let (inputs, outputs) = (tiles.inputs, tiles.outputs);
    let groups = inputs / CHANNELS;
    let mut sums = Sums([[0.0; BLOCK]; BLOCK]);
    for output in (0..outputs).step_by(CHANNELS) {
        let tile = |k: usize| output / TILE * TAPS * groups + k * TAPS * groups;
        let right = [0, 1].map(|k| tiles.values.as_ptr().wrapping_add(tile(k) * TILE_VALUES));
        for block in start..end {
            if grid.pixels[2 * block] | grid.pixels[2 * block + 1] == 0 {
                let at = (grid.first() + block * BLOCK) * outputs + output;
                for pixel in 0..BLOCK {
                    // SAFETY: a pixel of this band.
                    unsafe { to.at(at + pixel * outputs).write_bytes(0, CHANNELS) };
                }
                continue;
            }
            let first = grid.first() + block * BLOCK;
            // SAFETY: taps stay within the line; the caller's promise.
            unsafe {
                unit.clear();
                for tap in 0..TAPS {
                    let place = first.wrapping_add_signed(grid.tap(tap));
                    let left = from.values.as_ptr().add(place * inputs);
                    let products = Products {
                        left: [left, left.add(TILE * inputs)],
                        left_row: 2 * inputs,
                        right: right.map(|right| right.add(tap * groups * TILE_VALUES)),
                        right_row: 4 * TILE,
                        steps: groups,
                        step: [2 * CHANNELS, 2 * TILE_VALUES],
                    };
                    unit.add(&products);
                }
                unit.store(&mut sums);
                finish.block(grid, block, &sums, to, output, outputs);
            }
        }
    }
}

impl Finish<'_> {
    /// Finishes the sums of a block and writes them.
    ///
    /// # Safety
    /// The block must be writable.
    #[inline(always)]
    unsafe fn block(
        &self,
        grid: &Grid,
        block: usize,
        sums: &Sums,
        to: Shared<u16>,
        output: usize,
        outputs: usize,
    ) {
        let bits = u32::from(grid.pixels[2 * block]) | u32::from(grid.pixels[2 * block + 1]) << 16;
        let bias: [f32; CHANNELS] = match self.bias {
            Some(bias) => *bias[output..].first_chunk().expect("a bias for every output"),
            None => [0.0; CHANNELS],
        };
        let (has_addend, has_mask) = (self.addend.is_some(), self.mask.is_some());
        for (pixel, sums) in sums.0.iter().enumerate() {
            let at = (grid.first() + block * BLOCK + pixel) * outputs + output;
            let mut result = [0; CHANNELS];
            if bits >> pixel & 1 != 0 {
                // SAFETY: a pixel's channels lie next to each other; addend and mask are lines of this shape.
                let read = |line: *const u16| unsafe { line.add(at).cast::<Channels>().read() };
                let addend = self.addend.map_or([0; CHANNELS], read);
                let mask = self.mask.map_or([0; CHANNELS], |mask| read(mask.values.as_ptr()));
                // One loop over all: vector units take it whole.
                for c in 0..CHANNELS {
                    let mut value = sums[c] + bias[c];
                    if has_addend {
                        value += widen(addend[c]);
                    }
                    if self.relu {
                        value = value.max(0.0);
                    }
                    let is_masked = has_mask && mask[c] == 0;
                    result[c] = if is_masked { 0 } else { narrow(value) };
                }
            }
            // SAFETY: the caller's promise.
            unsafe { to.at(at).cast::<Channels>().write(result) };
        }
    }
}

/// Channels of a block of a pixel.
type Channels = [u16; CHANNELS];

/// The gradient of a convolution's weights as sums, and of its bias.
#[derive(Clone, Debug)]
pub(super) struct Gradient {
    /// `[tap][input / 32][output / 32]` blocks of sums, outputs by inputs.
    pub(super) blocks: Vec<Sums>,
    pub(super) bias: Vec<f32>,
}

/// Blocks of pixels that are multiplied at once.
const CHUNK: usize = 16;

/// Chunks of a part; parts are added up apart, so that the result is the same on any number of threads.
const PART_CHUNKS: usize = 8;
const MAX_PARTS: usize = 8;

/// A function that adds a chunk of pixels to a gradient.
pub(super) type AddChunk<U> =
    unsafe fn(&mut U, &Grid, &Line, &Line, &mut Gradient, &mut Scratch, [usize; 2]);

/// Memory for a chunk of pixels.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// The gradient, `[outputs][pixels]`.
    planes: Buffer,
    /// Inputs of neighbouring pixels as pairs, `[pixels / 2][inputs]`: pairs that begin with an even pixel,
    /// and with an odd one. So every tap finds its pixels in whole cache lines.
    pairs: [Buffer; 2],
}

/// Correlates inputs with the gradient of what a convolution made of them.
///
/// # Safety
/// The machine must have the unit; lines must belong to the grid.
pub(super) unsafe fn correlate<U: Unit>(
    grid: &Grid,
    inputs: &Line,
    gradient: &Line,
    add: AddChunk<U>,
) -> Gradient {
    let chunks = grid.blocks().div_ceil(CHUNK);
    let parts = (chunks / PART_CHUNKS).clamp(1, MAX_PARTS);
    let sums = |part: usize| {
        let count = TAPS * (inputs.channels / CHANNELS) * (gradient.channels / CHANNELS);
        let mut sums = Gradient {
            blocks: vec![Sums([[0.0; BLOCK]; BLOCK]); count],
            bias: vec![0.0; gradient.channels],
        };
        let mut scratch = Scratch::default();
        // SAFETY: the caller's promise.
        unsafe {
            let mut unit = U::configured();
            for chunk in part * chunks / parts..(part + 1) * chunks / parts {
                let range = [chunk * CHUNK, grid.blocks().min((chunk + 1) * CHUNK)];
                add(&mut unit, grid, inputs, gradient, &mut sums, &mut scratch, range);
            }
        }
        sums
    };
    let parts: Vec<Gradient> = (0..parts).into_par_iter().map(sums).collect();
    parts.into_iter().reduce(Gradient::plus).expect("a part")
}

impl Gradient {
    /// Adds the sums of another part.
    pub(super) fn plus(mut self, other: Self) -> Self {
        for (to, from) in self.blocks.iter_mut().zip(&other.blocks) {
            let (to, from) = (to.0.as_flattened_mut(), from.0.as_flattened());
            to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
        }
        for (to, from) in self.bias.iter_mut().zip(&other.bias) {
            *to += from;
        }
        self
    }
}

/// Adds a chunk of pixels to a gradient.
///
/// # Safety
/// As for [`correlate`].
#[inline(always)]
pub(super) unsafe fn add_chunk<U: Unit>(
    unit: &mut U,
    grid: &Grid,
    inputs: &Line,
    gradient: &Line,
    sums: &mut Gradient,
    scratch: &mut Scratch,
    [start, end]: [usize; 2],
) {
    let (first, count) = (grid.first() + start * BLOCK, (end - start) * BLOCK);
    let border = grid.pitch() + 1;
    // Rows of planes are whole cache lines, and do not all begin at the same place of the cache.
    let stride = count + BLOCK;
    transpose(gradient, first, count, stride, &mut scratch.planes);
    add_pixels(gradient, first, count, &mut sums.bias);
    let Scratch { planes, pairs } = scratch;
    for (odd, pairs) in pairs.iter_mut().enumerate() {
        interleave(inputs, first - border + odd, count / 2 + border - odd, pairs);
    }
    let [wide, high] = [inputs.channels, gradient.channels].map(|channels| channels / CHANNELS);
    for input in 0..wide {
        for output in 0..high {
            let left = planes.as_ptr().wrapping_add(output * CHANNELS * stride);
            for tap in 0..TAPS {
                let place = border.wrapping_add_signed(grid.tap(tap));
                let row = place / 2 * 2 * inputs.channels;
                let right = pairs[place % 2].as_ptr().wrapping_add(row + input * 2 * CHANNELS);
                let block = &mut sums.blocks[(tap * wide + input) * high + output];
                // SAFETY: sums are blocks of their own; tiles lie within the scratch memory.
                unsafe {
                    unit.load(block);
                    unit.add(&Products {
                        left: [left, left.wrapping_add(TILE * stride)],
                        left_row: 2 * stride,
                        right: [right, right.wrapping_add(2 * TILE)],
                        right_row: 4 * inputs.channels,
                        steps: count / BLOCK,
                        step: [2 * BLOCK, 4 * inputs.channels * TILE],
                    });
                    unit.store(block);
                }
            }
        }
    }
}

/// Writes pixels with channels last as planes, `[channels][stride]`.
#[inline(always)]
fn transpose(line: &Line, first: usize, count: usize, stride: usize, planes: &mut Buffer) {
    planes.resize(line.channels * stride);
    let planes = planes.pairs_mut();
    for pixel in (0..count).step_by(BLOCK) {
        for channel in (0..line.channels).step_by(TILE) {
            // Pairs of pixels by channels, then channels by pairs.
            let mut pairs = [[0; TILE]; TILE];
            for (k, to) in pairs.iter_mut().enumerate() {
                let at = (first + pixel + 2 * k) * line.channels + channel;
                let (low, high) = (&line.values[at..], &line.values[at + line.channels..]);
                for (to, (&low, &high)) in to.iter_mut().zip(low.iter().zip(high)) {
                    *to = u32::from(low) | u32::from(high) << 16;
                }
            }
            for (c, row) in transposed(&pairs).iter().enumerate() {
                let first_value = (channel + c) * stride + pixel;
                planes[first_value / 2..][..TILE].copy_from_slice(row);
            }
        }
    }
}

/// Writes `count` pairs of neighbouring pixels from `first` on, `[count][channels]`.
#[inline(always)]
fn interleave(line: &Line, first: usize, count: usize, pairs: &mut Buffer) {
    let channels = line.channels;
    pairs.resize(2 * count * channels);
    let pixels = &line.values[first * channels..(first + 2 * count) * channels];
    let rows = pairs.pairs_mut().chunks_exact_mut(channels);
    for (to, two) in rows.zip(pixels.chunks_exact(2 * channels)) {
        let (one, other) = two.split_at(channels);
        for ((to, &low), &high) in to.iter_mut().zip(one).zip(other) {
            *to = u32::from(low) | u32::from(high) << 16;
        }
    }
}

/// Adds all pixels to `sums`, two at a time.
#[inline(always)]
fn add_pixels(line: &Line, first: usize, count: usize, sums: &mut [f32]) {
    let channels = line.channels;
    let pixels = &line.values[first * channels..(first + count) * channels];
    for two in pixels.chunks_exact(2 * channels) {
        let (one, other) = two.split_at(channels);
        for ((sum, &low), &high) in sums.iter_mut().zip(one).zip(other) {
            *sum += widen(low) + widen(high);
        }
    }
}

/// The unit's results by plain loops: tests run on it, and need no unit.
#[derive(Debug)]
pub(super) struct Model(Box<[[f32; BLOCK]; BLOCK]>);

impl Unit for Model {
    unsafe fn configured() -> Self {
        Self(Box::new([[0.0; BLOCK]; BLOCK]))
    }

    unsafe fn clear(&mut self) {
        *self.0 = [[0.0; BLOCK]; BLOCK];
    }

    unsafe fn load(&mut self, sums: &Sums) {
        *self.0 = sums.0;
    }

    unsafe fn add(&mut self, products: &Products) {
        for step in 0..products.steps {
            for (number, left) in products.left.into_iter().enumerate() {
                for (other, right) in products.right.into_iter().enumerate() {
                    let left = left.wrapping_byte_add(step * products.step[0]);
                    let right = right.wrapping_byte_add(step * products.step[1]);
                    for row in 0..TILE {
                        let left = left.wrapping_byte_add(row * products.left_row);
                        for k in 0..BLOCK {
                            let pair = right.wrapping_byte_add(k / 2 * products.right_row);
                            for column in 0..TILE {
                                // SAFETY: the caller's promise.
                                let product = unsafe {
                                    widen(left.add(k).read_unaligned())
                                        * widen(*pair.add(2 * column + k % 2))
                                };
                                self.0[number * TILE + row][other * TILE + column] += product;
                            }
                        }
                    }
                }
            }
        }
    }

    unsafe fn store(&mut self, sums: &mut Sums) {
        sums.0 = *self.0;
    }
}
