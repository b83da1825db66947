//! Pieces that several networks are made of.

mod deformable;
mod names;
mod warping;

pub use deformable::deform_conv;
pub use names::renamed;
pub use warping::warp_zeros;
