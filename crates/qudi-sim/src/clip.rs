//! Sources of scenes: files of all kinds, pipes, stills in motion, procedural scenes.
//!
//! An [`Input`] says what to read and can be opened as often as needed; an [`ExposureSource`]
//! yields, for each output frame, the instants that one exposure sees.

mod combs;
mod gif;
mod image_file;
mod images;
mod input;
mod mosaic;
mod npy;
mod ppm;
mod recorded;
mod synthetic;
mod tiff_pages;
mod video;
mod y4m;

pub(crate) use combs::Combs;
pub use image_file::{AssumedWhite, decode_image, is_image, read_still};
pub use input::{Input, Sampling};
pub use mosaic::filter_picture;
pub(crate) use mosaic::{MosaicClip, decodes};
pub use video::{Video, VideoStream, video_stream};

use qudi_core::Result;
use qudi_core::flow::Flow;
use qudi_core::{Frame, Size};

/// Properties of a clip that are known before it is read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClipInfo {
    /// Frame size.
    pub size: Size,
    /// Number of exposures, if known.
    pub frames: Option<u64>,
    /// White of deep samples, if it is assumed.
    pub assumed_white: AssumedWhite,
}

/// The scene during one output frame.
#[derive(Clone, Debug)]
pub struct Exposure {
    /// The scene at evenly spaced instants of the exposure.
    pub instants: Vec<Frame>,
    /// The scene in the middle of the exposure, where it is none of the instants.
    middle: Option<Frame>,
    /// Red, green and blue of the scene in the middle of the exposure, behind a colour filter.
    colour: Option<Box<[Frame; 3]>>,
}

impl Exposure {
    /// Returns the sharp scene in the middle of the exposure, which a restoration should show.
    pub fn truth(&self) -> &Frame {
        self.middle.as_ref().unwrap_or(&self.instants[self.instants.len() / 2])
    }
}

/// A clip, exposure by exposure.
pub trait ExposureSource {
    /// Returns its size and length.
    fn info(&self) -> ClipInfo;

    /// Reads the next exposure; `None` at the end.
    fn next(&mut self) -> Result<Option<Exposure>>;

    /// Returns the true flow from exposure `index` to the next; `None` for recorded clips.
    fn flow(&self, index: u64) -> Option<Flow>;
}

/// Single frames of a recorded clip, one after another.
pub trait FrameReader {
    /// Returns the size of every frame.
    fn size(&self) -> Size;

    /// Returns the number of frames, if known.
    fn frames(&self) -> Option<u64>;

    /// Returns the white of deep samples, if it is assumed.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the file cannot be read.
    fn assumed_white(&mut self) -> Result<AssumedWhite> {
        Ok(None)
    }

    /// Reads the next frame; `None` at the end.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if it cannot be read.
    fn next(&mut self) -> Result<Option<Frame>>;
}
