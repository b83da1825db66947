//! Motion between the frames of a burst.

pub(crate) mod affine;
pub(crate) mod align;
mod block_flow;
pub(crate) mod camera;
pub(crate) mod closest;
pub(crate) mod grid;
pub(crate) mod paths;
pub(crate) mod pyramid;
pub(crate) mod velocity;
mod warping_error;

pub use block_flow::estimate_flow;
pub use warping_error::warping_error;
