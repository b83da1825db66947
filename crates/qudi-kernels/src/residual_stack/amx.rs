//! The matrix unit of Intel's processors (AMX), by inline assembly: Rust has no stable intrinsics for it.
#![allow(unsafe_code)]

use super::grid::{BLOCK, Grid, TILE};
use super::layout::{Line, Shared};
use super::unit::{Finish, Gradient, Products, Scratch, Sums, Unit, add_chunk, convolve_band};
use super::weights::Tiles;
use std::arch::asm;

/// `palette 1`: rows and bytes of a row of the eight tiles, all of full size.
#[repr(C, align(64))]
struct Configuration([u8; 64]);

impl Configuration {
    const FULL_TILES: Self = {
        let mut bytes = [0; 64];
        bytes[0] = 1;
        let mut tile = 0;
        while tile < 8 {
            bytes[16 + 2 * tile] = 64;
            bytes[48 + tile] = TILE as u8;
            tile += 1;
        }
        Self(bytes)
    };
}

/// The unit, configured on this thread until it is dropped. Tiles 0 to 3 hold the sums, 4 and 5 what stands
/// on the left, 6 and 7 what stands on the right.
#[derive(Debug)]
pub(super) struct Amx(());

impl Drop for Amx {
    fn drop(&mut self) {
        // SAFETY: the unit exists, or there would be no value.
        unsafe { asm!("tilerelease", options(nostack, nomem)) };
    }
}

/// Bytes from one row of sums to the next.
const SUM_ROW: usize = BLOCK * size_of::<f32>();

impl Unit for Amx {
    #[inline(always)]
    unsafe fn configured() -> Self {
        static CONFIGURATION: Configuration = Configuration::FULL_TILES;
        let configuration = &raw const CONFIGURATION;
        // SAFETY: 64 readable bytes; nothing else on this thread uses tiles.
        unsafe { asm!("ldtilecfg [{}]", in(reg) configuration, options(nostack, readonly)) };
        Self(())
    }

    #[inline(always)]
    unsafe fn clear(&mut self) {
        // SAFETY: the compiler uses no tiles, so they keep their contents between these blocks.
        unsafe {
            asm!(
                "tilezero tmm0",
                "tilezero tmm1",
                "tilezero tmm2",
                "tilezero tmm3",
                options(nostack, nomem)
            );
        }
    }

    #[inline(always)]
    unsafe fn load(&mut self, sums: &Sums) {
        // SAFETY: sums are as large as four tiles.
        unsafe {
            asm!(
                "tileloadd tmm0, [{sums} + {row}*1]",
                "tileloadd tmm1, [{sums} + {row}*1 + 64]",
                "tileloadd tmm2, [{below} + {row}*1]",
                "tileloadd tmm3, [{below} + {row}*1 + 64]",
                sums = in(reg) &raw const sums.0,
                below = in(reg) &raw const sums.0[TILE],
                row = in(reg) SUM_ROW,
                options(nostack, readonly),
            );
        }
    }

    #[inline(always)]
    unsafe fn add(&mut self, products: &Products) {
        let Products { mut left, left_row, mut right, right_row, steps, step } = *products;
        for _ in 0..steps {
            // SAFETY: the caller's promise.
            unsafe {
                asm!(
                    "tileloadd tmm4, [{left0} + {left_row}*1]",
                    "tileloadd tmm6, [{right0} + {right_row}*1]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tileloadd tmm7, [{right1} + {right_row}*1]",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "tileloadd tmm5, [{left1} + {left_row}*1]",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    left0 = in(reg) left[0],
                    left1 = in(reg) left[1],
                    left_row = in(reg) left_row,
                    right0 = in(reg) right[0],
                    right1 = in(reg) right[1],
                    right_row = in(reg) right_row,
                    options(nostack, readonly),
                );
            }
            left = left.map(|tile| tile.wrapping_byte_add(step[0]));
            right = right.map(|tile| tile.wrapping_byte_add(step[1]));
        }
    }

    #[inline(always)]
    unsafe fn store(&mut self, sums: &mut Sums) {
        // SAFETY: sums are as large as four tiles.
        unsafe {
            asm!(
                "tilestored [{sums} + {row}*1], tmm0",
                "tilestored [{sums} + {row}*1 + 64], tmm1",
                "tilestored [{below} + {row}*1], tmm2",
                "tilestored [{below} + {row}*1 + 64], tmm3",
                sums = in(reg) &raw mut sums.0,
                below = in(reg) &raw mut sums.0[TILE],
                row = in(reg) SUM_ROW,
                options(nostack),
            );
        }
    }
}

/// [`convolve_band`] with the vectors that machines with the unit have.
///
/// # Safety
/// The processor must have the unit, and the process the permission to use it.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512cd,avx2,fma")]
#[cfg_attr(test, allow(dead_code))] // the model stands in
pub(super) unsafe fn band(
    unit: &mut Amx,
    grid: &Grid,
    from: &Line,
    tiles: &Tiles,
    finish: Finish<'_>,
    to: Shared<u16>,
    range: [usize; 2],
) {
    // SAFETY: the caller's promise.
    unsafe { convolve_band(unit, grid, from, tiles, finish, to, range) }
}

/// [`add_chunk`] with the vectors that machines with the unit have.
///
/// # Safety
/// As for [`band`].
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512cd,avx2,fma")]
#[cfg_attr(test, allow(dead_code))] // the model stands in
pub(super) unsafe fn chunk(
    unit: &mut Amx,
    grid: &Grid,
    inputs: &Line,
    gradient: &Line,
    sums: &mut Gradient,
    scratch: &mut Scratch,
    range: [usize; 2],
) {
    // SAFETY: the caller's promise.
    unsafe { add_chunk(unit, grid, inputs, gradient, sums, scratch, range) }
}
