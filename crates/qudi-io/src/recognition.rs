//! Recognition of formats: facts about a path, from its name, its length, and the statistics of its bytes.

mod bit_order;
mod byte_kind;
mod probe;
mod raw_sample;
mod sequence;

pub use bit_order::{Z_SCORE_THRESHOLD, bit_order_z_score};
pub(crate) use byte_kind::ByteKind;
pub(crate) use probe::Probe;
pub(crate) use raw_sample::{Convention, SWISSSPAD_FILE_BYTES, stem};
pub(crate) use sequence::{Numbered, numbered};
