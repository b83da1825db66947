//! Products of pairs of bfloat16 on the vector unit (AVX512-BF16).
#![allow(unsafe_code)]

use super::grid::{BLOCK, Grid, TILE};
use super::layout::{Line, Shared};
use super::unit::{Finish, Gradient, Products, Scratch, Sums, Unit, add_chunk, convolve_band};
use super::weights::Tiles;
use std::arch::x86_64::{
    __m512, __m512bh, __m512i, _mm512_dpbf16_ps, _mm512_load_ps, _mm512_loadu_epi16,
    _mm512_set1_epi32, _mm512_store_ps,
};
use std::mem::transmute;

/// Rows of sums that stay in registers: two vectors each, of 32 that there are.
const ROWS: usize = 8;

/// The vector unit. Sums lie in memory between calls.
#[derive(Debug)]
pub(super) struct Vectors(Sums);

impl Unit for Vectors {
    #[inline(always)]
    unsafe fn configured() -> Self {
        Self(Sums([[0.0; BLOCK]; BLOCK]))
    }

    #[inline(always)]
    unsafe fn clear(&mut self) {
        self.0 = Sums([[0.0; BLOCK]; BLOCK]);
    }

    #[inline(always)]
    unsafe fn load(&mut self, sums: &Sums) {
        self.0.0 = sums.0;
    }

    #[inline(always)]
    unsafe fn add(&mut self, products: &Products) {
        for (number, rows) in self.0.0.chunks_exact_mut(ROWS).enumerate() {
            let row = number * ROWS;
            let left = products.left[row / TILE].wrapping_byte_add(row % TILE * products.left_row);
            let rows = rows.first_chunk_mut().expect("whole chunks");
            // SAFETY: the caller's promise.
            unsafe { add_rows(products, left, rows) };
        }
    }

    #[inline(always)]
    unsafe fn store(&mut self, sums: &mut Sums) {
        sums.0 = self.0.0;
    }
}

/// Adds the products of some rows on the left, from `left` on, to their sums.
///
/// # Safety
/// The processor must have AVX512-BF16; all tiles must be readable, and the rows aligned to 64 bytes.
#[inline(always)]
unsafe fn add_rows(products: &Products, left: *const u16, rows: &mut [[f32; BLOCK]; ROWS]) {
    let Products { left_row, right, right_row, steps, step, .. } = *products;
    // SAFETY: the caller's promise.
    unsafe {
        let mut sums: [[__m512; 2]; ROWS] =
            std::array::from_fn(|row| [0, TILE].map(|at| _mm512_load_ps(&raw const rows[row][at])));
        for number in 0..steps {
            let left = left.wrapping_byte_add(number * step[0]);
            let right = right.map(|tile| tile.wrapping_byte_add(number * step[1]));
            for pair in 0..TILE {
                let columns: [__m512bh; 2] = right.map(|tile| {
                    let row = tile.wrapping_byte_add(pair * right_row).cast::<i16>();
                    transmute::<__m512i, __m512bh>(_mm512_loadu_epi16(row))
                });
                for (row, sums) in sums.iter_mut().enumerate() {
                    let pair = left.wrapping_byte_add(row * left_row).wrapping_add(2 * pair);
                    let pair = i32::from_le_bytes(pair.cast::<[u8; 4]>().read());
                    let values = transmute::<__m512i, __m512bh>(_mm512_set1_epi32(pair));
                    for (sums, columns) in sums.iter_mut().zip(columns) {
                        *sums = _mm512_dpbf16_ps(*sums, values, columns);
                    }
                }
            }
        }
        for (row, sums) in rows.iter_mut().zip(sums) {
            _mm512_store_ps(&raw mut row[0], sums[0]);
            _mm512_store_ps(&raw mut row[TILE], sums[1]);
        }
    }
}

/// [`convolve_band`], compiled for the unit.
///
/// # Safety
/// The processor must have AVX512-BF16.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512cd,avx512bf16,avx2,fma")]
#[cfg_attr(test, allow(dead_code))] // the model stands in
pub(super) unsafe fn band(
    unit: &mut Vectors,
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

/// [`add_chunk`], compiled for the unit.
///
/// # Safety
/// As for [`band`].
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512cd,avx512bf16,avx2,fma")]
#[cfg_attr(test, allow(dead_code))] // the model stands in
pub(super) unsafe fn chunk(
    unit: &mut Vectors,
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
