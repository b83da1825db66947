//! Execution of a pass: fills scratch memory, calls the innermost loops, and writes results.
#![allow(unsafe_code)]

#[cfg(all(target_arch = "x86_64", not(test)))]
use super::amx;
use super::micro::{self, BlockWork, Products, Single, in_blocks};
#[cfg(target_arch = "x86_64")]
use super::pairs;
use super::pass::{Pass, Tiling};
use super::scratch::Format;
use super::source::Source;
use super::tiles;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use std::cell::RefCell;
use std::marker::PhantomData;

thread_local! {
    /// Scratch memory of a thread, reused between calls.
    pub(super) static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// Results of a convolution: parts joined by channel, `[images, channels, height, width]` each.
#[derive(Clone, Debug)]
pub(super) struct Target {
    /// First value and number of channels of each part.
    parts: Vec<(*mut f32, usize)>,
    pub(super) height: usize,
    pub(super) width: usize,
}

// SAFETY: tiles of a pass, and passes of a gradient, write to disjoint places (see `run`).
unsafe impl Send for Target {}
// SAFETY: as above.
unsafe impl Sync for Target {}

impl Target {
    /// Reserves `images * channels * height * width` values of capacity in each of the `parts`.
    pub(super) fn new(
        parts: &mut [(Vec<f32>, usize)],
        images: usize,
        height: usize,
        width: usize,
    ) -> Self {
        for (part, channels) in parts.iter_mut() {
            part.clear();
            part.reserve_exact(images * *channels * height * width);
        }
        let parts = parts.iter_mut().map(|(part, channels)| (part.as_mut_ptr(), *channels));
        Self { parts: parts.collect(), height, width }
    }

    /// Returns the first value of a plane.
    ///
    /// # Safety
    /// The image must exist.
    pub(super) unsafe fn plane(&self, image: usize, mut channel: usize) -> *mut f32 {
        for &(start, channels) in &self.parts {
            if channel < channels {
                let number = image * channels + channel;
                // SAFETY: within the part's capacity, which `new` reserved.
                return unsafe { start.add(number * self.height * self.width) };
            }
            channel -= channels;
        }
        unreachable!("no such channel")
    }
}

/// A pass over input planes, cut into tiles, with its weights in the order of the innermost loops.
#[derive(Clone, Debug)]
pub(super) struct Packed {
    /// Weights `[block][scratch plane][tap][channel of the block]`; empty for matrix units.
    values: Vec<f32>,
    /// Weights in the layout of [`tiles::packed`]; empty otherwise.
    pub(super) tiles: Vec<tiles::Row>,
    /// Block size in channels and vectors.
    block: (usize, usize),
    pub(super) outputs: usize,
    /// Number of scratch planes.
    planes: usize,
    tiling: Tiling,
}

impl Packed {
    /// Packs the weights `weight(output, plane, tap)` of `planes` input planes.
    pub(super) fn new(
        pass: &Pass,
        bf16: bool,
        outputs: usize,
        planes: usize,
        weight: impl Fn(usize, usize, usize) -> f32 + Sync,
    ) -> Self {
        let format = Format::new(bf16, planes);
        let scratch_planes = format.scratch_planes(planes);
        let tiling = pass.tiling(format, scratch_planes, micro::longest_run(format));
        let taps = pass.taps.len();
        let weight = |output: usize, number: usize, tap: usize| {
            let value = |plane| if plane < planes { weight(output, plane, tap) } else { 0.0 };
            if output < outputs { format.place(number, value) } else { 0.0 }
        };
        let block = micro::block(outputs, tiling.columns);
        let (mut values, mut tiles) = (Vec::new(), Vec::new());
        if let Format::Tiles(group) = format {
            tiles = tiles::packed(outputs, scratch_planes, group, taps, weight);
        } else {
            let per_channel = scratch_planes * taps;
            values = vec![0.0; outputs.next_multiple_of(block.0) * per_channel];
            // A convolution without inputs or taps has no weights.
            let size = (block.0 * per_channel).max(1);
            values.par_chunks_mut(size).enumerate().for_each(|(number, values)| {
                let first = number * block.0;
                for (at, values) in values.chunks_exact_mut(block.0).enumerate() {
                    let (plane, tap) = (at / taps, at % taps);
                    for (output, value) in (first..).zip(values) {
                        *value = weight(output, plane, tap);
                    }
                }
            });
        }
        Self { values, tiles, block, outputs, planes: scratch_planes, tiling }
    }
}

/// Initial values of the results, and their activation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Finish<'a> {
    /// One value per output channel; zero if absent.
    pub(super) bias: Option<&'a [f32]>,
    /// One value per result, in the shape of a target of one part.
    pub(super) addend: Option<&'a [f32]>,
    pub(super) relu: bool,
}

/// Correlates `source` with `weights` over `images` images. Every result of the pass's grid is written by one
/// thread only, and its sum has the same order with any tiles.
pub(super) fn run(
    source: Source<'_>,
    images: usize,
    pass: &Pass,
    weights: &Packed,
    finish: Finish<'_>,
    target: &Target,
) {
    let (tiling, planes) = (weights.tiling, weights.planes);
    let offsets = tiling.offsets(pass, tiling.planes);
    let arch = Arch::new();
    (0..images * tiling.count()).into_par_iter().for_each(|task| {
        let (image, number) = (task / tiling.count(), task % tiling.count());
        let (at, size) = tiling.tile(number, pass.grid);
        SCRATCH.with_borrow_mut(|scratch| {
            let needed = tiling.scratch();
            if scratch.len() < needed {
                scratch.resize(needed, 0.0);
            }
            let scratch = &mut scratch[..needed];
            let mut first = 0;
            while first < planes {
                let end = (first + tiling.planes).min(planes);
                source.fill(image, first..end, pass, &tiling, at, scratch);
                let tile = Tile {
                    scratch,
                    offsets: &offsets[..(end - first) / tiling.format.group() * pass.taps.len()],
                    planes: (first, end, planes),
                    pass,
                    tiling: &tiling,
                    weights,
                    finish,
                    target,
                    image,
                    at,
                    size,
                };
                tile.run(arch);
                first = end;
            }
        });
    });
}

/// Work on one filled tile.
pub(super) struct Tile<'a> {
    pub(super) scratch: &'a [f32],
    pub(super) offsets: &'a [u32],
    /// First, end and total number of the scratch planes that are filled.
    pub(super) planes: (usize, usize, usize),
    pub(super) pass: &'a Pass,
    pub(super) tiling: &'a Tiling,
    pub(super) weights: &'a Packed,
    finish: Finish<'a>,
    target: &'a Target,
    image: usize,
    at: [usize; 2],
    pub(super) size: [usize; 2],
}

impl WithSimd for Tile<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // SAFETY: `Single` needs no instructions beyond `S`.
        unsafe { self.products::<S, Single>(simd) }
    }
}

#[cfg(target_arch = "x86_64")]
impl pairs::PairWork for Tile<'_> {
    #[inline(always)]
    unsafe fn work(self, simd: pulp::x86::V4) {
        // SAFETY: the caller's promise.
        unsafe { self.products::<_, pairs::Pairs>(simd) }
    }
}

/// Work on one filled tile with the products `P`.
struct Blocks<'a, P>(&'a Tile<'a>, PhantomData<P>);

impl<S: Simd, P: Products<S>> BlockWork<S> for Blocks<'_, P> {
    #[inline(always)]
    unsafe fn blocks<const M: usize, const V: usize>(self, simd: S) {
        // SAFETY: the caller's promise.
        unsafe { self.0.blocks::<S, P, M, V>(simd) }
    }
}

impl Tile<'_> {
    fn run(self, arch: Arch) {
        match self.tiling.format {
            Format::Single | Format::Rounded => arch.dispatch(self),
            #[cfg(target_arch = "x86_64")]
            Format::Pairs => pairs::with_pairs(self),
            #[cfg(not(target_arch = "x86_64"))]
            Format::Pairs => unreachable!("the format requires the units"),
            #[cfg(all(target_arch = "x86_64", not(test)))]
            // SAFETY: the format is `Tiles` only where the processor has the unit, and the process may use
            // it.
            Format::Tiles(group) => unsafe { amx::work(&self, group) },
            #[cfg(any(not(target_arch = "x86_64"), test))]
            // SAFETY: the model needs no unit.
            Format::Tiles(group) => unsafe { tiles::blocks(&tiles::Model, &self, group) },
        }
    }

    /// Multiplies all blocks with the products `P`.
    ///
    /// # Safety
    /// The machine must have the instructions of `P`.
    #[inline(always)]
    unsafe fn products<S: Simd, P: Products<S>>(&self, simd: S) {
        // SAFETY: the caller's promise.
        unsafe { in_blocks(simd, self.weights.block, Blocks::<P>(self, PhantomData)) }
    }

    /// Multiplies blocks of `M` channels by `V` vectors of pixels.
    ///
    /// # Safety
    /// The machine must have the instructions of `P`.
    #[inline(always)]
    unsafe fn blocks<S: Simd, P: Products<S>, const M: usize, const V: usize>(&self, simd: S) {
        let run = V * S::F32_LANES;
        let taps = self.pass.taps.len();
        for first in (0..self.weights.outputs).step_by(M) {
            let start = (first * self.planes.2 + self.planes.0 * M) * taps;
            let weights = &self.weights.values[start..start + self.offsets.len() * M];
            for row in 0..self.size[0] {
                for column in (0..self.size[1]).step_by(run) {
                    let base = self.pass.stride * row * self.tiling.row + column;
                    let count = run.min(self.size[1] - column);
                    let mut sums = self.start::<S, M, V>(simd, first, row, column, count);
                    // SAFETY: a scratch row holds whole runs past the tile's last column, and the
                    // offsets stay within the planes that were filled (`Pass::tiling`).
                    unsafe {
                        micro::accumulate::<S, P, M, V>(
                            simd,
                            self.scratch.as_ptr().add(base),
                            self.offsets,
                            weights.as_ptr(),
                            &mut sums,
                        );
                    }
                    self.write::<S, M, V>(simd, first, row, column, count, sums);
                }
            }
        }
    }

    /// Returns the address of the first value in a run of results of one channel.
    #[inline(always)]
    fn place(&self, channel: usize, row: usize, column: usize) -> *mut f32 {
        let [y, x] = self.pass.place;
        let y = y + self.pass.step * (self.at[0] + row);
        let x = x + self.pass.step * (self.at[1] + column);
        // SAFETY: the pass's grid lies within the target.
        unsafe { self.target.plane(self.image, channel).add(y * self.target.width + x) }
    }

    /// Writes a run of results of one channel. `sums` holds the sums over the planes in scratch memory.
    #[inline(always)]
    pub(super) fn finish(&self, channel: usize, row: usize, column: usize, sums: &mut [f32]) {
        let to = self.place(channel, row, column);
        if self.planes.0 > 0 {
            for (p, sum) in sums.iter_mut().enumerate() {
                // SAFETY: this thread wrote it for the planes before.
                *sum += unsafe { *to.add(p * self.pass.step) };
            }
        } else if let Some(bias) = self.finish.bias {
            for sum in sums.iter_mut() {
                *sum += bias[channel];
            }
            if let Some(addend) = self.addends(channel, row, column, sums.len()) {
                sums.iter_mut().zip(addend).for_each(|(sum, addend)| *sum += addend);
            }
        }
        if self.finish.relu && self.planes.1 == self.planes.2 {
            for sum in sums.iter_mut() {
                *sum = sum.max(0.0);
            }
        }
        if self.pass.step == 1 {
            // SAFETY: the results lie next to each other from there.
            unsafe { std::ptr::copy_nonoverlapping(sums.as_ptr(), to, sums.len()) };
        } else {
            for (p, &sum) in sums.iter().enumerate() {
                // SAFETY: the results lie `step` apart from there.
                unsafe { to.add(p * self.pass.step).write(sum) };
            }
        }
    }

    /// Returns the addends of a run of results of one channel.
    #[inline(always)]
    fn addends(&self, channel: usize, row: usize, column: usize, count: usize) -> Option<&[f32]> {
        let addend = self.finish.addend?;
        let channel = self.image * self.weights.outputs + channel;
        let line = channel * self.target.height + self.at[0] + row;
        let from = line * self.target.width + self.at[1] + column;
        Some(&addend[from..from + count])
    }

    /// Returns the initial values of a block: the bias, or the sums over previous planes.
    #[inline(always)]
    fn start<S: Simd, const M: usize, const V: usize>(
        &self,
        simd: S,
        first: usize,
        row: usize,
        column: usize,
        count: usize,
    ) -> [[S::f32s; V]; M] {
        let mut sums = [[simd.splat_f32s(0.0); V]; M];
        for (m, sum) in sums.iter_mut().enumerate().take(self.weights.outputs - first) {
            if self.planes.0 > 0 {
                let from = self.place(first + m, row, column);
                let values: &mut [f32] = pulp::bytemuck::cast_slice_mut(sum);
                if self.pass.step == 1 {
                    // SAFETY: this thread wrote `count` values there for the planes before.
                    unsafe { std::ptr::copy_nonoverlapping(from, values.as_mut_ptr(), count) };
                    continue;
                }
                for (p, value) in values.iter_mut().enumerate().take(count) {
                    // SAFETY: this thread wrote it for the planes before.
                    *value = unsafe { *from.add(p * self.pass.step) };
                }
            } else if let Some(bias) = self.finish.bias {
                *sum = [simd.splat_f32s(bias[first + m]); V];
                if let Some(addend) = self.addends(first + m, row, column, count) {
                    let values: &mut [f32] = pulp::bytemuck::cast_slice_mut(sum);
                    for (value, addend) in values.iter_mut().zip(addend) {
                        *value += addend;
                    }
                }
            }
        }
        sums
    }

    #[inline(always)]
    fn write<S: Simd, const M: usize, const V: usize>(
        &self,
        simd: S,
        first: usize,
        row: usize,
        column: usize,
        count: usize,
        sums: [[S::f32s; V]; M],
    ) {
        let cut = self.finish.relu && self.planes.1 == self.planes.2;
        for (m, mut sum) in sums.into_iter().enumerate().take(self.weights.outputs - first) {
            if cut {
                sum = sum.map(|vector| simd.max_f32s(vector, simd.splat_f32s(0.0)));
            }
            let to = self.place(first + m, row, column);
            if self.pass.step == 1 {
                // SAFETY: `count` results lie next to each other from there.
                unsafe { micro::store::<S, V>(sum, to, count) };
            } else {
                let values: &[f32] = pulp::bytemuck::cast_slice(&sum);
                for (p, &value) in values.iter().enumerate().take(count) {
                    // SAFETY: results lie `step` apart from there.
                    unsafe { to.add(p * self.pass.step).write(value) };
                }
            }
        }
    }
}
