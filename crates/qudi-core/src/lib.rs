//! The basic types: frames, sensors, light, cameras, metrics, and the interface of restoration methods.
//!
//! A [`Camera`], which is a [`sensor::Sensor`] under a certain [`Light`], turns [`Frame`]s in [0, 1] into
//! photon counts. A [`restorer::Restorer`] turns counts into frames, and [`metrics`] compare them with the
//! truth.
//!
//! ```
//! use qudi_core::{Camera, Frame, Light, Size, sensor::Sensor};
//!
//! let size = Size::new(32, 48, "example")?;
//! let scene = Frame::filled(size, 0.45);
//! let sensor = Sensor::load("qudi-paper")?;
//! let light = Light { ppp: 3.25, mean_level: 0.45 };
//! let mut camera = Camera::new(&sensor, size, light, 7)?;
//! let counts = camera.expose(0, &[&scene])?;
//! assert!(counts.iter().all(|&count| count <= sensor.max_count()));
//! # Ok::<(), qudi_core::Error>(())
//! ```
#![warn(missing_docs)]

mod camera;
pub mod colour;
pub mod error;
mod files;
pub mod flow;
mod frame;
mod light;
pub mod limits;
pub mod metrics;
pub mod progress;
pub mod random;
pub mod restorer;
pub mod sensor;
mod transfer;
pub mod windows;

pub use camera::{Camera, RollingShutter};
pub use error::{Error, Result, nearest};
pub use files::{atomic_file, ffmpeg, natural_order, npy, regular_file};
pub use frame::{Frame, Size};
pub use light::mean_level::fitting_mean_level;
pub use light::{
    Checksum, ClipStatistics, Light, PppDefinition, Spectrum, USUAL_MEAN_LEVEL, ppp_from_lux,
    resolve_light, sensor_lux,
};
pub use sensor::bad_pixels;
pub use transfer::{Transfer, linear_to_srgb, srgb_to_linear};
