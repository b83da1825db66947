//! One verb per file.

pub(crate) mod completions;
pub(crate) mod config;
pub(crate) mod demo;
pub(crate) mod info;
pub(crate) mod light;
pub(crate) mod simulate;
