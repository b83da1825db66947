//! Single-photon cameras, simulated exactly.
//!
//! The way of the data: a [`source`] yields [`Frame`]s in [0, 1]; a [`Camera`], which is a
//! [`sensor::Sensor`] under a certain [`Light`], turns each into photon counts; [`burst`] writes
//! them in the formats of the field, with a [`record`] that reproduces them.
//!
//! ```
//! use qudi_sim::{Camera, Frame, Light, Size, sensor::Sensor};
//!
//! let size = Size::new(32, 48, "example")?;
//! let scene = Frame::filled(size, 0.45);
//! let sensor = Sensor::load("qudi-paper")?;
//! let light = Light { ppp: 3.25, exposure: 0.45 };
//! let mut camera = Camera::new(&sensor, size, light, 7)?;
//! let counts = camera.expose(0, &[&scene])?;
//! assert!(counts.iter().all(|&count| count <= sensor.max_count()));
//! # Ok::<(), qudi_sim::SimError>(())
//! ```
#![warn(missing_docs)]

pub mod burst;
mod camera;
pub mod capture;
pub mod dataset;
pub mod error;
mod frame;
mod light;
pub mod metrics;
mod natural_order;
pub mod nearest;
pub mod npy;
pub mod output;
mod random;
pub mod record;
pub mod restore;
pub mod scene;
pub mod sensor;
mod simulate;
pub mod source;
mod transfer;

pub use camera::Camera;
pub use error::{Result, SimError};
pub use frame::{Frame, Size};
pub use light::{
    ClipStatistics, Light, PppDefinition, Spectrum, USUAL_EXPOSURE, ppp_from_lux, resolve_light,
    sensor_lux,
};
pub use simulate::{Exposed, Progress, Simulation, Sink, Stage, Start, Summary, simulate};
pub use transfer::{Transfer, linear_to_srgb, srgb_to_linear};
