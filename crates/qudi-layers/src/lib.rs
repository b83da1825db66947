//! Layers that several networks are made of, and their parameters by name.
#![warn(missing_docs)]

mod conv;
mod dense_block;
mod group_norm;
mod linear;
mod parameters;
pub mod resample;

pub use conv::{Bias, Conv2d, Conv3d};
pub use dense_block::DenseBlock;
pub use group_norm::GroupNorm;
pub use linear::Linear;
pub use parameters::{init_parameters, parameter_shapes, zeros};
