//! Classical restoration of single-photon bursts, written from the papers.
#![warn(missing_docs)]

mod bm3d;

pub use bm3d::Bm3d;
