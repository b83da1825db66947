//! Numbers that convolutions multiply (Micikevicius et al. 2018, section 3): of 16 bits, graphics cards
//! multiply several times as many, and what is kept for the gradient is half as large. Weights, sums and all
//! between convolutions have 32 bits.
//!
//! Of the two kinds of 16 bits only that with the range of 32 will do: nothing holds the U-Net's residual
//! sums below what the other one can hold (docs/notes/training/sixteen-bits.md).

use crate::backend::{Switch, is_native};
use burn::tensor::{DType, Device, FloatDType, Tensor};
use serde::{Deserialize, Serialize};
use std::cell::Cell;
use std::fmt;

/// The numbers that convolutions multiply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
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
    /// Whether a device computes with such numbers. The flex backend does not, but rounds to them: results
    /// are those of a card that does, at no better speed.
    pub fn is_supported(self, device: &Device) -> bool {
        device.supports_dtype(self.dtype())
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

/// Numbers of the thread's precision around one convolution.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reduced {
    dtype: FloatDType,
    /// Whether they are only rounded: our own operations take numbers of 32 bits.
    rounded: bool,
}

impl Reduced {
    /// For a convolution of `input`; none if it is computed as it is.
    pub(crate) fn of(input: &Tensor<4>) -> Option<Self> {
        let precision = PRECISION.get();
        let reduces = precision != ComputePrecision::F32 && input.dtype() == DType::F32;
        reduces.then(|| Self { dtype: precision.dtype(), rounded: is_native(input) })
    }

    /// What is multiplied.
    pub(crate) fn narrow<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        let x = x.cast(self.dtype);
        if self.rounded { x.cast(FloatDType::F32) } else { x }
    }

    /// What comes of it, rounded as a device stores it, in 32 bits.
    pub(crate) fn widen(self, sum: Tensor<4>) -> Tensor<4> {
        let sum = if self.rounded { sum.cast(self.dtype) } else { sum };
        sum.cast(FloatDType::F32)
    }
}
