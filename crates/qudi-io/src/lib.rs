//! Files of counts and frames: captures in every format of the field, and what is written.
#![warn(missing_docs)]

pub mod burst;
pub mod capture;
pub mod codec;
pub mod frames;
pub mod record;
pub mod restore;
pub mod writer;
