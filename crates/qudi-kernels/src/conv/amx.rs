//! The matrix unit of Intel's processors (AMX), by inline assembly: Rust has no stable intrinsics for it.
#![allow(unsafe_code)]

use super::run::Tile;
use super::tiles::{Block, MatrixUnit, Model, OUTPUTS, PIXELS, Row, SIDE, Sums, blocks};
use std::arch::asm;

/// Bytes from one row of a tile of weights to the next.
const WEIGHT_ROW: usize = size_of::<Row>();

/// Bytes from one row of sums to the next.
const SUM_ROW: usize = PIXELS * size_of::<f32>();

/// `palette 1`: rows and bytes of a row of the eight tiles.
#[repr(C, align(64))]
struct Configuration([u8; 64]);

impl Configuration {
    /// Tiles 0 to 3 for sums, 4 and 5 for weights of `group` pairs, 6 and 7 for pixels.
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

/// The unit, configured on this thread until it is dropped.
#[derive(Debug)]
struct Amx(());

impl Amx {
    /// # Safety
    /// The processor must have the unit, and the process the permission to use it.
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

impl MatrixUnit for Amx {
    #[inline(always)]
    unsafe fn multiply(&self, block: &Block<'_>, sums: &mut Sums) {
        let stride = block.plane * size_of::<f32>();
        let mut weights = block.weights;
        // SAFETY: the caller promises what the loads read; the compiler uses no tiles, so they keep their
        // contents between these blocks.
        unsafe {
            asm!("tilezero tmm0", "tilezero tmm1", options(nostack, nomem));
            if block.tiles == 2 {
                asm!("tilezero tmm2", "tilezero tmm3", options(nostack, nomem));
                for &offset in block.offsets {
                    asm!(
                        "tileloadd tmm6, [{pixels} + {stride}*1]",
                        "tileloadd tmm4, [{weights} + {row}*1]",
                        "tdpbf16ps tmm0, tmm4, tmm6",
                        "tileloadd tmm7, [{pixels} + {stride}*1 + 64]",
                        "tdpbf16ps tmm1, tmm4, tmm7",
                        "tileloadd tmm5, [{weights} + {row}*1 + 1024]",
                        "tdpbf16ps tmm2, tmm5, tmm6",
                        "tdpbf16ps tmm3, tmm5, tmm7",
                        pixels = in(reg) block.pixels.add(offset as usize),
                        stride = in(reg) stride,
                        weights = in(reg) weights,
                        row = in(reg) WEIGHT_ROW,
                        options(nostack, readonly),
                    );
                    weights = weights.add(2 * SIDE);
                }
            } else {
                for &offset in block.offsets {
                    asm!(
                        "tileloadd tmm4, [{weights} + {row}*1]",
                        "tileloadd tmm6, [{pixels} + {stride}*1]",
                        "tdpbf16ps tmm0, tmm4, tmm6",
                        "tileloadd tmm7, [{pixels} + {stride}*1 + 64]",
                        "tdpbf16ps tmm1, tmm4, tmm7",
                        pixels = in(reg) block.pixels.add(offset as usize),
                        stride = in(reg) stride,
                        weights = in(reg) weights,
                        row = in(reg) WEIGHT_ROW,
                        options(nostack, readonly),
                    );
                    weights = weights.add(SIDE);
                }
            }
            let to = sums.0.as_mut_ptr();
            asm!(
                "tilestored [{to} + {row}*1], tmm0",
                "tilestored [{to} + {row}*1 + 64], tmm1",
                to = in(reg) to,
                row = in(reg) SUM_ROW,
                options(nostack),
            );
            if block.tiles == 2 {
                asm!(
                    "tilestored [{to} + {row}*1], tmm2",
                    "tilestored [{to} + {row}*1 + 64], tmm3",
                    to = in(reg) to.add(OUTPUTS / 2),
                    row = in(reg) SUM_ROW,
                    options(nostack),
                );
            }
        }
    }
}

/// The blocks of a tile of the image; machines with the unit have these vectors.
///
/// # Safety
/// The processor must have the unit, and the process the permission to use it.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512cd,avx2,fma")]
#[cfg_attr(test, allow(dead_code))] // the model stands in
pub(super) unsafe fn work(tile: &Tile<'_>, group: usize) {
    // SAFETY: the caller's promise.
    unsafe { blocks(&Amx::configured(group), tile, group) }
}

/// Whether the unit computes what its model does.
pub(crate) fn agrees() -> bool {
    const GROUP: usize = 5;
    const PLANE: usize = 40;
    let value = |number: usize| {
        // Numbers of few bits: all products and sums are exact.
        let half = |number: usize| (((number * 37 % 17) as f32 - 8.0).to_bits()) >> 16;
        f32::from_bits(half(number) << 16 | half(number + 3))
    };
    let weight = |row: usize| Row(std::array::from_fn(|place| value(row * SIDE + place)));
    let weights: Vec<Row> = (0..4 * SIDE).map(weight).collect();
    let pixels: Vec<f32> = (0..GROUP * PLANE + PLANE).map(|number| value(7 * number)).collect();
    let block = Block {
        weights: weights.as_ptr(),
        tiles: 2,
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
    got.0 == expected.0
}
