//! Options of `qudi light`.

use crate::args::number;
use clap::Args as ClapArgs;

/// Convert between lux and photons per pixel for a sensor
#[derive(Debug, ClapArgs)]
pub(crate) struct Light {
    /// Illuminance on the sensor plane in lux
    #[arg(long, value_name = "LX", allow_negative_numbers = true, required_unless_present_any = ["ppp", "scene_lux"], conflicts_with_all = ["ppp", "scene_lux"], value_parser = number::real(0.0..=1e9))]
    pub(crate) lux: Option<f64>,
    /// Incident photons per pixel and frame
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, conflicts_with = "scene_lux", value_parser = number::real(0.0..=1e9))]
    pub(crate) ppp: Option<f64>,
    /// Illuminance on a diffuse scene in lux, seen through a lens
    #[arg(long, value_name = "LX", allow_negative_numbers = true, value_parser = number::real(0.0..=1e9))]
    pub(crate) scene_lux: Option<f64>,
    /// Sensor: a name or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = "qudi-paper")]
    pub(crate) sensor: String,
    /// Exposure time in seconds [default: one frame of the sensor]
    #[arg(long, value_name = "S", allow_negative_numbers = true, value_parser = number::real(1e-12..=1e6))]
    pub(crate) exposure_time: Option<f64>,
    /// Pixel pitch in micrometres [default: the sensor's]
    #[arg(long, value_name = "UM", allow_negative_numbers = true, value_parser = number::real(1e-3..=1e6))]
    pub(crate) pitch: Option<f64>,
    /// Light of one wavelength in nanometres
    #[arg(long, value_name = "NM", default_value_t = 555.0, conflicts_with = "daylight", allow_negative_numbers = true, value_parser = number::real(380.0..=780.0))]
    pub(crate) wavelength: f64,
    /// Daylight, 395 to 718 nm
    #[arg(long)]
    pub(crate) daylight: bool,
    /// Reflectance of the scene, for --scene-lux
    #[arg(long, value_name = "0..1", allow_negative_numbers = true, default_value_t = 0.18, value_parser = number::real(0.0..=1.0))]
    pub(crate) reflectance: f64,
    /// Transmission of the lens, for --scene-lux
    #[arg(long, value_name = "0..1", allow_negative_numbers = true, default_value_t = 0.9, value_parser = number::real(0.0..=1.0))]
    pub(crate) transmission: f64,
    /// f-number of the lens, for --scene-lux
    #[arg(long, value_name = "N", default_value_t = 2.8, allow_negative_numbers = true, value_parser = number::real(0.1..=1000.0))]
    pub(crate) f_number: f64,
    /// Magnification of the lens, for --scene-lux
    #[arg(long, value_name = "M", default_value_t = 0.0, allow_negative_numbers = true, value_parser = number::real(0.0..=1000.0))]
    pub(crate) magnification: f64,
}
