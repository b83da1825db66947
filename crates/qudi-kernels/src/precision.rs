//! Precision of the numbers that convolutions multiply (Micikevicius et al. 2018, section 3). Graphics cards
//! and the matrix units of processors multiply 16-bit numbers several times as fast. Weights, sums and all
//! other operations have 32 bits.
//!
//! Only bfloat16, which has the range of 32 bits, is supported: nothing bounds the U-Net's residual sums to
//! the range of half precision (docs/notes/training/sixteen-bits.md).

use crate::backend::{Switch, is_flex};
use crate::matrix_units::MatrixUnits;
use burn::tensor::{DType, Device, FloatDType, Tensor};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::cell::Cell;
use std::fmt;

/// Precision of the numbers that convolutions multiply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ComputePrecision {
    /// Single precision (32 bits).
    #[default]
    F32,
    /// Bfloat16: 16 bits with a relative precision of 4e-3 and the range of 32 bits, 1e-38 to 3e38.
    Bf16,
}

thread_local! {
    static PRECISION: Cell<ComputePrecision> = const { Cell::new(ComputePrecision::F32) };
}

/// Runs `run` with convolutions of this precision on this thread. Gradients of its results have the same
/// precision.
pub fn with_precision<T>(precision: ComputePrecision, run: impl FnOnce() -> T) -> T {
    let _switch = Switch::turn(&PRECISION, precision);
    run()
}

impl ComputePrecision {
    /// Returns true if the device computes with this precision. A processor without matrix units rounds to
    /// bfloat16 ([`is_emulated`](Self::is_emulated)).
    pub fn is_supported(self, device: &Device) -> bool {
        device.supports_dtype(self.dtype())
    }

    /// Returns true if the device rounds to this precision without units for it, which is slower than `F32`.
    pub fn is_emulated(self, device: &Device) -> bool {
        self == Self::Bf16 && is_flex(device) && MatrixUnits::current() == MatrixUnits::F32
    }

    /// Returns the fastest precision that restores equally well on this device: bfloat16 on a processor with
    /// matrix units, single precision otherwise.
    pub fn fastest(device: &Device) -> Self {
        let has_units = MatrixUnits::current() != MatrixUnits::F32;
        if is_flex(device) && has_units { Self::Bf16 } else { Self::F32 }
    }

    /// Returns true if a convolution of `input` on this thread has fewer bits than `input`.
    pub(crate) fn reduces(input: &Tensor<4>) -> bool {
        PRECISION.get() != Self::F32 && input.dtype() == DType::F32
    }

    fn dtype(self) -> FloatDType {
        match self {
            Self::F32 => FloatDType::F32,
            Self::Bf16 => FloatDType::BF16,
        }
    }
}

/// Formats the precision as recipes and options name it.
impl fmt::Display for ComputePrecision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
        })
    }
}

/// Conversion to the thread's precision around one of Burn's convolutions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reduced {
    dtype: FloatDType,
}

impl Reduced {
    /// Creates the conversion for a convolution of `input`; `None` if it has full precision.
    pub(crate) fn of(input: &Tensor<4>) -> Option<Self> {
        ComputePrecision::reduces(input).then(|| Self { dtype: PRECISION.get().dtype() })
    }

    /// Casts an operand to the reduced precision.
    pub(crate) fn narrow<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        x.cast(self.dtype)
    }

    /// Casts a result to 32 bits.
    pub(crate) fn widen(sum: Tensor<4>) -> Tensor<4> {
        sum.cast(FloatDType::F32)
    }
}
