//! Numbers that convolutions multiply (Micikevicius et al. 2018, section 3): of 16 bits, graphics cards and
//! the matrix units of processors multiply several times as many. Weights, sums and all between convolutions
//! have 32 bits.
//!
//! Of the two kinds of 16 bits only that with the range of 32 will do: nothing holds the U-Net's residual
//! sums below what the other one can hold (docs/notes/training/sixteen-bits.md).

use crate::backend::{Switch, is_flex};
use crate::matrix_units::MatrixUnits;
use burn::tensor::{DType, Device, FloatDType, Tensor};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::cell::Cell;
use std::fmt;

/// The numbers that convolutions multiply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ComputePrecision {
    /// 32 bits.
    #[default]
    F32,
    /// 16 bits, 8 of them for the value: exact to 4e-3, from 1e-38 to 3e38 as with 32 bits.
    Bf16,
}

thread_local! {
    static PRECISION: Cell<ComputePrecision> = const { Cell::new(ComputePrecision::F32) };
}

/// Runs `run` with convolutions of this precision on this thread; gradients of what it computes have it, too.
pub fn with_precision<T>(precision: ComputePrecision, run: impl FnOnce() -> T) -> T {
    let _switch = Switch::turn(&PRECISION, precision);
    run()
}

impl ComputePrecision {
    /// Whether a device computes with such numbers. A processor without units for them rounds to them, at no
    /// better speed.
    pub fn is_supported(self, device: &Device) -> bool {
        device.supports_dtype(self.dtype())
    }

    /// The fastest of those that restore equally well on this device: 16 bits on a processor with units for
    /// them, else 32.
    pub fn fastest(device: &Device) -> Self {
        let has_units = MatrixUnits::current() != MatrixUnits::F32;
        if is_flex(device) && has_units { Self::Bf16 } else { Self::F32 }
    }

    /// Whether a convolution of `input` on this thread has fewer bits than `input`.
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

/// As recipes and options name it.
impl fmt::Display for ComputePrecision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
        })
    }
}

/// Numbers of the thread's precision around one of Burn's convolutions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reduced {
    dtype: FloatDType,
}

impl Reduced {
    /// For a convolution of `input`; none if it is computed as it is.
    pub(crate) fn of(input: &Tensor<4>) -> Option<Self> {
        ComputePrecision::reduces(input).then(|| Self { dtype: PRECISION.get().dtype() })
    }

    /// What is multiplied.
    pub(crate) fn narrow<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        x.cast(self.dtype)
    }

    /// What comes of it, in 32 bits.
    pub(crate) fn widen(sum: Tensor<4>) -> Tensor<4> {
        sum.cast(FloatDType::F32)
    }
}
