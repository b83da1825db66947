//! Files of counts and frames: captures in every format of the field, and what is written.
#![warn(missing_docs)]

pub mod capture;
pub mod codec;
pub mod description;
pub mod frames;
pub mod recognition;
pub mod restore;
pub mod sidecar;
pub mod writer;
