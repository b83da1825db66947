//! One verb per file.

pub(crate) mod bench;
mod bench_network;
pub(crate) mod calibrate;
mod capture_info;
mod capture_light;
pub(crate) mod completions;
pub(crate) mod config;
pub(crate) mod convert;
pub(crate) mod demo;
mod demo_html;
pub(crate) mod eval;
mod eval_capture;
mod eval_clip;
mod eval_exposing;
mod eval_html;
mod eval_score;
mod eval_table;
pub(crate) mod info;
pub(crate) mod light;
mod methods;
mod network;
pub(crate) mod publish;
pub(crate) mod restore;
mod restore_deviation;
mod restore_output;
pub(crate) mod selftest;
#[cfg(feature = "remote")]
pub(crate) mod serve;
pub(crate) mod simulate;
mod tiff_samples;
pub(crate) mod train;
mod train_environment;
mod train_events;
mod train_pictures;
mod train_report;
mod train_resume;
mod train_watch;
