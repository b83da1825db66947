//! Colour filter arrays: the colour of every pixel, and its response to light.
//!
//! A scene has three planes in linear light, red, green and blue. Behind a filter, a pixel sees one of them,
//! or, behind a white filter, their mean. Luma is the mean over all pixels of what they see.

mod choice;
mod filter;
mod mosaic;
mod sensor_colour;

pub use choice::FilterChoice;
pub use filter::{Colour, ColourFilter};
pub use mosaic::{Mosaic, MosaicPlane};
pub use sensor_colour::SensorColour;
