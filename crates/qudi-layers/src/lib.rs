//! Building blocks shared by the networks: layers, named parameters in memory and in files, and tiling of
//! frames.
#![warn(missing_docs)]

#[cfg(test)]
#[path = "../../../tests/golden/cases.rs"]
mod cases;

mod conv;
mod dense_block;
mod group_norm;
mod layers;
mod linear;
mod parameters;
mod pickle;
mod provenance;
pub mod resample;
mod residual_stack;
mod state_dict;
pub mod tensor;
mod tiling;

pub use conv::{Bias, Conv2d, Conv3d};
pub use dense_block::DenseBlock;
pub use group_norm::GroupNorm;
pub use layers::Layers;
pub use linear::Linear;
pub use parameters::{init_parameters, parameter_shapes, zeros};
pub use provenance::Provenance;
pub use residual_stack::ResidualStack;
pub use state_dict::StateDict;
pub use tiling::{TILE, Tiles, Tiling, mirrored};
