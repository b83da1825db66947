//! The learned methods of the paper's table, written from their papers.
//!
//! Parameters have the names of the authors' files, so that these can be read. [`learning`] has what training
//! needs.
#![warn(missing_docs)]

#[cfg(test)]
#[path = "../../../tests/golden/cases.rs"]
mod cases;

pub mod emvd;
pub mod flornn;
#[cfg(test)]
mod golden_tests;
pub mod import;
pub mod learning;
pub mod memdeblur;
pub mod method;
pub mod parts;
pub mod quiver;
pub mod restorer;
pub mod rvrt;
pub mod spk2imgnet;
pub mod student_teacher;
pub mod weights;
