//! The matrix unit of Intel's processors (AMX), by inline assembly: Rust has no stable intrinsics for it.
#![allow(unsafe_code)]

use super::run::Tile;
use super::tiles::{
    Block, Correlation, MatrixUnit, Model, OUTPUTS, PIXELS, Row, SIDE, Sums, WeightSums, blocks,
};
use super::weight_tiles::Work;
use std::arch::asm;

/// Bytes between rows of a tile of weights.
const WEIGHT_ROW: usize = size_of::<Row>();

/// Bytes between rows of sums.
const SUM_ROW: usize = PIXELS * size_of::<f32>();

/// Configuration of `palette 1`: rows of the eight tiles, and bytes per row.
#[repr(C, align(64))]
struct Configuration([u8; 64]);

impl Configuration {
    /// Creates a configuration with tiles 0 to 3 for sums, 4 and 5 for weights of `group` pairs, 6 and 7 for
    /// pixels.
    fn new(group: usize) -> Self {
        let mut bytes = [0; 64];
        bytes[0] = 1;
        for tile in 0..8 {
            let (rows, row) = match tile {
                0..4 => (16, 64),
                4 | 5 => (16, 4 * group),
                _ => (group, 64),
            };
            bytes[16 + 2 * tile] = row as u8;
            bytes[48 + tile] = rows as u8;
        }
        Self(bytes)
    }
}

/// Guard of the unit, configured on this thread until it is dropped.
#[derive(Debug)]
struct Amx(());

impl Amx {
    /// Configures the unit.
    ///
    /// # Safety
    /// The processor must have the unit, and the process must have permission to use it.
    unsafe fn configured(group: usize) -> Self {
        let configuration = Configuration::new(group);
        // SAFETY: 64 readable bytes; nothing else on this thread uses tiles.
        unsafe {
            asm!("ldtilecfg [{}]", in(reg) &raw const configuration, options(nostack, readonly));
        };
        Self(())
    }
}

impl Drop for Amx {
    fn drop(&mut self) {
        // SAFETY: the unit exists, or there would be no value.
        unsafe { asm!("tilerelease", options(nostack, nomem)) };
    }
}

/// Loads 16 rows of 64 bytes, `stride` apart.
macro_rules! load {
    ($tile:literal, $from:expr, $stride:expr) => {
        asm!(
            concat!("tileloadd ", $tile, ", [{from} + {stride}*1]"),
            from = in(reg) $from,
            stride = in(reg) $stride,
            options(nostack, readonly),
        )
    };
}

/// Stores 16 rows of 64 bytes, `stride` apart.
macro_rules! store {
    ($tile:literal, $to:expr, $stride:expr) => {
        asm!(
            concat!("tilestored [{to} + {stride}*1], ", $tile),
            to = in(reg) $to,
            stride = in(reg) $stride,
            options(nostack),
        )
    };
}

/// Adds the products of two tiles to a third.
macro_rules! add_product {
    ($sums:literal, $a:literal, $b:literal) => {
        asm!(concat!("tdpbf16ps ", $sums, ", ", $a, ", ", $b), options(nostack, nomem))
    };
}

impl Amx {
    /// Adds the products of `A` left tiles and `B` right tiles to the sums: tiles 0 and 1 for the first left
    /// tile, 2 and 3 for the second. Rows are the given number of bytes apart.
    ///
    /// # Safety
    /// The unit must be configured, and the tiles readable.
    #[inline(always)]
    unsafe fn add_products<const A: usize, const B: usize, L, R>(
        (left, left_row): ([*const L; 2], usize),
        (right, right_row): ([*const R; 2], usize),
    ) {
        // SAFETY: the caller's promise; the compiler uses no tiles, so they keep their contents between
        // these blocks.
        unsafe {
            load!("tmm6", right[0], right_row);
            load!("tmm4", left[0], left_row);
            add_product!("tmm0", "tmm4", "tmm6");
            if B == 2 {
                load!("tmm7", right[1], right_row);
                add_product!("tmm1", "tmm4", "tmm7");
            }
            if A == 2 {
                load!("tmm5", left[1], left_row);
                add_product!("tmm2", "tmm5", "tmm6");
            }
            if A == 2 && B == 2 {
                add_product!("tmm3", "tmm5", "tmm7");
            }
        }
    }

    /// Stores the sums.
    ///
    /// # Safety
    /// The unit must be configured, and the `A` by `B` destination tiles writable.
    #[inline(always)]
    unsafe fn store<const A: usize, const B: usize, T>(to: [[*mut T; 2]; 2], row: usize) {
        // SAFETY: as in `add_products`.
        unsafe {
            store!("tmm0", to[0][0], row);
            if B == 2 {
                store!("tmm1", to[0][1], row);
            }
            if A == 2 {
                store!("tmm2", to[1][0], row);
            }
            if A == 2 && B == 2 {
                store!("tmm3", to[1][1], row);
            }
        }
    }

    /// Implements [`MatrixUnit::multiply`] for `A` tiles of weights and `B` tiles of pixels.
    ///
    /// # Safety
    /// Same as [`MatrixUnit::multiply`].
    #[inline(always)]
    unsafe fn multiply<const A: usize, const B: usize>(block: &Block<'_>, sums: &mut Sums) {
        let plane = block.plane * size_of::<f32>();
        let mut weights = block.weights;
        // SAFETY: the caller's promise; sums are as large as four tiles.
        unsafe {
            asm!("tilezero tmm0", "tilezero tmm1", options(nostack, nomem));
            asm!("tilezero tmm2", "tilezero tmm3", options(nostack, nomem));
            for &offset in block.offsets {
                let pixels = block.pixels.add(offset as usize);
                // Without a second tile, its address is not read.
                let left = [weights, weights.wrapping_add(SIDE)];
                let right = [pixels, pixels.wrapping_add(SIDE)];
                Self::add_products::<A, B, _, _>((left, WEIGHT_ROW), (right, plane));
                weights = weights.add(A * SIDE);
            }
            let to = sums.0.as_mut_ptr().cast::<f32>();
            let second = to.add(OUTPUTS / 2 * PIXELS);
            Self::store::<A, B, _>([[to, to.add(SIDE)], [second, second.add(SIDE)]], SUM_ROW);
        }
    }

    /// Implements [`MatrixUnit::correlate`] for `A` tiles of planes and `B` tiles of channels.
    ///
    /// # Safety
    /// Same as [`MatrixUnit::correlate`].
    #[inline(always)]
    unsafe fn correlate<const A: usize, const B: usize>(
        what: &Correlation,
        sums: [[*mut WeightSums; 2]; 2],
    ) {
        let row = size_of::<Row>();
        let plane = what.plane * size_of::<u16>();
        let mut gradients = what.gradients;
        // SAFETY: the caller's promise.
        unsafe {
            load!("tmm0", sums[0][0], row);
            if B == 2 {
                load!("tmm1", sums[0][1], row);
            }
            if A == 2 {
                load!("tmm2", sums[1][0], row);
            }
            if A == 2 && B == 2 {
                load!("tmm3", sums[1][1], row);
            }
            for line in 0..what.lines {
                for step in 0..what.steps {
                    let at = line * what.line + step * 2 * SIDE;
                    let pixels = what.pixels.map(|pixels| pixels.add(at));
                    Self::add_products::<A, B, _, _>((pixels, plane), (gradients, row));
                    gradients = gradients.map(|rows| rows.add(SIDE));
                }
            }
            Self::store::<A, B, _>(sums, row);
        }
    }
}

impl MatrixUnit for Amx {
    #[inline(always)]
    unsafe fn multiply(&self, block: &Block<'_>, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe {
            match block.tiles {
                [1, 1] => Self::multiply::<1, 1>(block, sums),
                [1, _] => Self::multiply::<1, 2>(block, sums),
                [_, 1] => Self::multiply::<2, 1>(block, sums),
                _ => Self::multiply::<2, 2>(block, sums),
            }
        }
    }

    #[inline(always)]
    unsafe fn correlate(&self, what: &Correlation, sums: [[*mut WeightSums; 2]; 2]) {
        // SAFETY: the caller's promise.
        unsafe {
            match what.tiles {
                [1, 1] => Self::correlate::<1, 1>(what, sums),
                [1, _] => Self::correlate::<1, 2>(what, sums),
                [_, 1] => Self::correlate::<2, 1>(what, sums),
                _ => Self::correlate::<2, 2>(what, sums),
            }
        }
    }
}

/// Computes the blocks of a tile of the image. All machines with the unit have AVX-512.
///
/// # Safety
/// The processor must have the unit, and the process must have permission to use it.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512cd,avx2,fma")]
#[cfg_attr(test, allow(dead_code))] // the model stands in
pub(super) unsafe fn work(tile: &Tile<'_>, group: usize) {
    // SAFETY: the caller's promise.
    unsafe { blocks(&Amx::configured(group), tile, group) }
}

/// Computes the products of a tile of the image for the gradient of weights.
///
/// # Safety
/// The processor must have the unit, and the process must have permission to use it.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512cd,avx2,fma")]
#[cfg_attr(test, allow(dead_code))] // the model stands in
pub(super) unsafe fn correlate(work: &Work<'_>, sums: &mut [WeightSums]) {
    // SAFETY: the caller's promise.
    unsafe { work.correlate(&Amx::configured(SIDE), sums) }
}

/// Returns true if the unit computes the same as its model.
pub(crate) fn agrees() -> bool {
    const GROUP: usize = 5;
    const PLANE: usize = 40;
    let value = |number: usize| {
        // Numbers with few bits: all products and sums are exact.
        let half = |number: usize| (((number * 37 % 17) as f32 - 8.0).to_bits()) >> 16;
        f32::from_bits(half(number) << 16 | half(number + 3))
    };
    let weight = |row: usize| Row(std::array::from_fn(|place| value(row * SIDE + place)));
    let weights: Vec<Row> = (0..4 * SIDE).map(weight).collect();
    let pixels: Vec<f32> = (0..SIDE * PLANE + 2 * PLANE).map(|number| value(7 * number)).collect();
    let block = Block {
        weights: weights.as_ptr(),
        tiles: [2, 2],
        pixels: pixels.as_ptr(),
        offsets: &[0, 3],
        group: GROUP,
        plane: PLANE,
    };
    let [mut got, mut expected] = [const { Sums([[0.0; PIXELS]; OUTPUTS]) }; 2];
    // SAFETY: the unit was found and permitted before; both read within the two vectors.
    unsafe {
        Amx::configured(GROUP).multiply(&block, &mut got);
        Model.multiply(&block, &mut expected);
    }
    // The same pixels as planes of 16 bits, from an odd place on.
    let (from, plane) = (3, 2 * PLANE);
    let pixels: &[u16] = pulp::bytemuck::cast_slice(&pixels);
    let zeros = || [const { Row([0.0; SIDE]) }; SIDE];
    let [mut of_unit, mut of_model] = [0; 2].map(|_| [[zeros(), zeros()], [zeros(), zeros()]]);
    let planes = [&pixels[from..], &pixels[from + 1..]].map(<[u16]>::as_ptr);
    let gradients = [&weights[..], &weights[SIDE..]].map(<[Row]>::as_ptr);
    let what = Correlation {
        pixels: planes,
        gradients,
        tiles: [2, 2],
        plane,
        lines: 2,
        steps: 1,
        line: plane / 2,
    };
    let pointers = |row: &mut [WeightSums; 2]| row.each_mut().map(|sums| &raw mut *sums);
    // SAFETY: as above.
    unsafe {
        let amx = Amx::configured(SIDE);
        amx.correlate(&what, of_unit.each_mut().map(pointers));
        Model.correlate(&what, of_model.each_mut().map(pointers));
    }
    let equal = |(a, b): (&WeightSums, &WeightSums)| a.iter().zip(b).all(|(a, b)| a.0 == b.0);
    got.0 == expected.0 && of_unit.as_flattened().iter().zip(of_model.as_flattened()).all(equal)
}
