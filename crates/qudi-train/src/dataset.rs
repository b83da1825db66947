//! Training data: clips, stills and procedural scenes, drawn sample by sample.
//!
//! Files are decoded once, into a [`Pack`], which threads share; a [`Dataset`] draws from it. Sample `k` of
//! seed `s` is the same on any machine and for any number of threads.

mod config;
mod content;
mod crop;
mod frame_codec;
mod pack;
mod pack_index;
mod pack_writer;
mod sample;

pub(crate) use config::refuse_dark_map;
pub use config::{DataConfig, LightRange, SensorMix, SourceConfig, SourceKind};
pub use pack::{Pack, PackedFrame};
pub use pack_index::{Clip, ClipWindow, PackedSource};
pub use pack_writer::{PackProgress, write_pack};
pub(crate) use sample::acquisition;
pub use sample::{Dataset, Sample};
