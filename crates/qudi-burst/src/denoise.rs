//! Removing noise from single images.

pub(crate) mod bm3d;
pub(crate) mod plane;
pub(crate) mod stabilizer;
