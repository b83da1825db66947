//! The report of a command: what is printed, and the tables, plots and pages that are written.
//!
//! Commands describe results as a [`Table`], a [`Plot`](svg::Plot) or the context of a page; every format has
//! one exporter.

mod console;
mod counted;
pub(crate) mod csv;
mod duration;
pub(crate) mod grid;
pub(crate) mod html;
pub(crate) mod json;
pub(crate) mod markdown;
mod message;
pub(crate) mod middle;
mod output;
pub(crate) mod player;
mod printable;
pub(crate) mod svg;
mod table;

pub(crate) use console::{Bar, Report, print};
pub(crate) use counted::counted;
pub(crate) use duration::duration;
pub use message::{Listener, Message};
pub(crate) use output::Output;
pub(crate) use printable::printable;
pub(crate) use table::{Cell, Column, Table};
