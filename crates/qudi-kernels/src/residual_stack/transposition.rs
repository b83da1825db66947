//! Rows and columns of tiles, swapped.
#![allow(unsafe_code)]

use super::grid::TILE;
#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{
    __m512i, _mm512_loadu_epi32, _mm512_permutex2var_epi32, _mm512_storeu_epi32,
};

/// Sixteen pixels of sixteen channels, or of as many pairs.
pub(super) type Tile = [[u32; TILE]; TILE];

/// Swaps rows and columns.
#[inline(always)]
pub(super) fn transposed(tile: &Tile) -> Tile {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the processor has AVX-512F.
        return unsafe { exchanged(tile) };
    }
    one_by_one(tile)
}

#[inline(always)]
fn one_by_one(tile: &Tile) -> Tile {
    std::array::from_fn(|row| std::array::from_fn(|column| tile[column][row]))
}

/// Exchanges the squares off the diagonal: halves, then quarters of these, down to single values.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
#[inline]
fn exchanged(tile: &Tile) -> Tile {
    // SAFETY: a row of a tile has sixteen values, here and below.
    let load = |row: &[u32; TILE]| unsafe { _mm512_loadu_epi32(row.as_ptr().cast()) };
    let mut rows: [__m512i; TILE] = std::array::from_fn(|row| load(&tile[row]));
    for side in [8, 4, 2, 1] {
        let upper = |k: usize| if k & side == 0 { k } else { TILE + k - side };
        let lower = |k: usize| if k & side == 0 { k + side } else { TILE + k };
        let upper = load(&std::array::from_fn(|k| upper(k) as u32));
        let lower = load(&std::array::from_fn(|k| lower(k) as u32));
        for row in (0..TILE).filter(|row| row & side == 0) {
            let (above, below) = (rows[row], rows[row + side]);
            rows[row] = _mm512_permutex2var_epi32(above, upper, below);
            rows[row + side] = _mm512_permutex2var_epi32(above, lower, below);
        }
    }
    let mut result = [[0; TILE]; TILE];
    for (to, row) in result.iter_mut().zip(rows) {
        // SAFETY: as above.
        unsafe { _mm512_storeu_epi32(to.as_mut_ptr().cast(), row) };
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vectors_swap_rows_and_columns_as_single_values_do() {
        let tile: Tile =
            std::array::from_fn(|row| std::array::from_fn(|column| (TILE * row + column) as u32));
        let swapped = transposed(&tile);
        assert_eq!(swapped, one_by_one(&tile));
        assert_eq!((swapped[3][5], swapped[15][0]), (83, 15));
    }
}
