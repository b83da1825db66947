//! The fused stack on the machine's own matrix unit, where it has one.
#![allow(clippy::unwrap_used)]

use qudi_kernels::conv::Activation;
use qudi_kernels::{
    ComputePrecision, MatrixUnits, residual_stack, with_matrix_units, with_precision,
};

#[path = "../src/residual_stack/tests.rs"]
mod same;
