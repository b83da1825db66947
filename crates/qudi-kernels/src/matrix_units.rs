//! The processor's units for products of bfloat16, and their selection for convolutions.
#![allow(unsafe_code)]

use crate::backend::Switch;
use std::cell::Cell;
use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;

/// Units that multiply bfloat16 in convolutions on the processor. All sum in 32 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MatrixUnits {
    /// No unit: numbers are rounded to bfloat16 and multiplied in 32 bits, which is slower than not to round.
    F32,
    /// Products of pairs on the vector unit (AVX512-BF16).
    Avx512Bf16,
    /// Tiles of 16 x 32 values (AMX).
    Amx,
}

/// Error for units that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MatrixUnitsError {
    /// No units have this name.
    Unknown(String),
    /// The processor or its operating system does not provide these units.
    Unavailable(MatrixUnits),
}

impl fmt::Display for MatrixUnitsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unknown(name) => write!(f, "there are no matrix units called `{name}`"),
            Self::Unavailable(units) => {
                write!(f, "this processor or its operating system lacks the matrix units {units}")
            }
        }
    }
}

impl std::error::Error for MatrixUnitsError {}

impl fmt::Display for MatrixUnits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::Avx512Bf16 => "avx512bf16",
            Self::Amx => "amx",
        })
    }
}

impl FromStr for MatrixUnits {
    type Err = MatrixUnitsError;

    fn from_str(name: &str) -> Result<Self, MatrixUnitsError> {
        [Self::F32, Self::Avx512Bf16, Self::Amx]
            .into_iter()
            .find(|units| units.to_string() == name)
            .ok_or_else(|| MatrixUnitsError::Unknown(name.into()))
    }
}

thread_local! {
    /// Units forced on this thread.
    static FORCED_UNITS: Cell<Option<MatrixUnits>> = const { Cell::new(None) };
}

impl MatrixUnits {
    /// Environment variable that forces one of the units.
    pub const VARIABLE: &str = "QUDI_KERNELS";

    /// Returns true if this machine has these units.
    pub fn is_available(self) -> bool {
        match self {
            Self::F32 => true,
            Self::Avx512Bf16 => vectors_of_pairs(),
            Self::Amx => {
                static AMX: OnceLock<bool> = OnceLock::new();
                // Tests of this crate run a model of the unit.
                cfg!(test) || *AMX.get_or_init(|| vectors_of_pairs() && tiles())
            }
        }
    }

    /// Returns true if the units, where available, are faster than 32 bits. Intel's vector units take twice
    /// as long for a product of pairs as for one of 32 bits (docs/notes/engineering/bfloat16.md).
    fn pays(self) -> bool {
        self != Self::Avx512Bf16 || made_by_amd()
    }

    /// Returns the units that `QUDI_KERNELS` names, or else the fastest ones of this machine.
    ///
    /// # Errors
    /// [`MatrixUnitsError`] if the variable names no units, or units that this machine lacks.
    pub fn chosen() -> Result<Self, MatrixUnitsError> {
        static CHOSEN: OnceLock<Result<MatrixUnits, MatrixUnitsError>> = OnceLock::new();
        let choose = || match std::env::var(Self::VARIABLE) {
            Ok(name) => {
                let units: Self = name.parse()?;
                let available = units.is_available();
                if available { Ok(units) } else { Err(MatrixUnitsError::Unavailable(units)) }
            }
            Err(_) => Ok([Self::Amx, Self::Avx512Bf16]
                .into_iter()
                .find(|units| units.is_available() && units.pays())
                .unwrap_or(Self::F32)),
        };
        CHOSEN.get_or_init(choose).clone()
    }

    /// Returns the units that convolutions on this thread use.
    pub(crate) fn current() -> Self {
        FORCED_UNITS.get().unwrap_or_else(|| Self::chosen().unwrap_or(Self::F32))
    }
}

/// Runs `run` with these units on this thread.
///
/// # Errors
/// [`MatrixUnitsError::Unavailable`] if this machine lacks them.
pub fn with_matrix_units<T>(
    units: MatrixUnits,
    run: impl FnOnce() -> T,
) -> Result<T, MatrixUnitsError> {
    if !units.is_available() {
        return Err(MatrixUnitsError::Unavailable(units));
    }
    let _switch = Switch::turn(&FORCED_UNITS, Some(units));
    Ok(run())
}

#[cfg(target_arch = "x86_64")]
fn vectors_of_pairs() -> bool {
    pulp::x86::V4::is_available() && is_x86_feature_detected!("avx512bf16")
}

#[cfg(not(target_arch = "x86_64"))]
fn vectors_of_pairs() -> bool {
    false
}

#[cfg(target_arch = "x86_64")]
fn made_by_amd() -> bool {
    let maker = std::arch::x86_64::__cpuid(0);
    [maker.ebx, maker.edx, maker.ecx].map(u32::to_le_bytes).concat() == b"AuthenticAMD"
}

#[cfg(not(target_arch = "x86_64"))]
fn made_by_amd() -> bool {
    false
}

/// Returns true if the processor has tiles, and the operating system lets this process use them.
#[cfg(all(feature = "flex", target_arch = "x86_64", target_os = "linux"))]
fn tiles() -> bool {
    use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
    /// Bits of CPUID leaf 7: tiles, and their products of bfloat16.
    const AMX: u32 = 1 << 24 | 1 << 22;
    /// Bits of the tile state in XCR0: configuration and data.
    const STATE: u64 = 1 << 17 | 1 << 18;
    /// Linux's `ARCH_REQ_XCOMP_PERM`.
    const REQUEST: libc::c_long = 0x1023;
    /// State component of tile data.
    const TILE_DATA: libc::c_long = 18;

    #[target_feature(enable = "xsave")]
    fn enabled() -> u64 {
        // SAFETY: register 0 exists wherever the instruction does.
        unsafe { _xgetbv(0) }
    }
    let present = __cpuid(0).eax >= 7 && __cpuid_count(7, 0).edx & AMX == AMX;
    if !present || !is_x86_feature_detected!("xsave") {
        return false;
    }
    // SAFETY: the processor has the instruction, as checked above.
    if unsafe { enabled() } & STATE != STATE {
        return false;
    }
    // SAFETY: the call takes two integers and accesses no memory of this process.
    let permitted = unsafe { libc::syscall(libc::SYS_arch_prctl, REQUEST, TILE_DATA) } == 0;
    permitted && crate::conv::tiles_multiply()
}

#[cfg(not(all(feature = "flex", target_arch = "x86_64", target_os = "linux")))]
fn tiles() -> bool {
    false
}
