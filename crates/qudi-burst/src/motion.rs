//! Motion estimation between the frames of a burst.

mod affine;
pub(crate) mod block_alignment;
pub(crate) mod cells;
pub(crate) mod constant_velocity;
pub(crate) mod flow;
pub(crate) mod global_motion;
pub(crate) mod grid;
pub(crate) mod hypotheses;
pub(crate) mod patch_matching;
mod patch_refinement;
pub(crate) mod per_pixel_selection;
pub(crate) mod pyramid;
pub(crate) mod reference_frames;
mod velocity_search;
mod warping_error;

pub use flow::estimate_flow;
pub use warping_error::warping_error;
