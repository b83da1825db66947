//! Colour clips, seen through a colour filter array.

use super::{ClipInfo, Exposure, ExposureSource, Input, Sampling, decode_image};
use qudi_core::colour::{ColourFilter, FilterChoice, SensorColour};
use qudi_core::flow::Flow;
use qudi_core::limits::IMAGE_PIXELS;
use qudi_core::regular_file::require_regular;
use qudi_core::{Error, Frame, Result, Size, Transfer};
use std::path::Path;

/// A colour clip behind a filter: exposures hold what every pixel sees.
pub(crate) struct MosaicClip {
    planes: [Box<dyn ExposureSource>; 3],
    filter: ColourFilter,
}

/// Returns true if a clip of `input` is decoded from sRGB: images and videos are, arrays are as they are
/// unless `transfer` says otherwise.
pub(crate) fn decodes(input: &Input, transfer: Transfer) -> bool {
    transfer.decodes() || !matches!(input, Input::Npy { .. } | Input::Procedural(_))
}

impl MosaicClip {
    /// Opens the red, green and blue planes of `input` in linear light behind the filter `choice`.
    ///
    /// # Errors
    /// [`Error`] if the clip cannot be read in colour, or the filter does not fit it.
    pub(crate) fn open(
        input: &Input,
        sampling: &Sampling,
        choice: &FilterChoice,
        colour: &SensorColour,
    ) -> Result<Self> {
        if matches!(input, Input::Y4m { .. } | Input::Pipe { .. }) {
            return Err(Error::request(
                "Y4M is read in gray, and a colour filter needs the colours of the clip",
                input.place(),
                "use a video file, a folder of images, a still, or a .npy of shape (frames, height, width, 3)",
            ));
        }
        let decodes = decodes(input, sampling.transfer);
        let plane = |index| {
            input.open(&Sampling { transfer: Transfer::Plane { index, decodes }, ..*sampling })
        };
        let planes = [plane(0)?, plane(1)?, plane(2)?];
        let size = planes[0].info().size;
        let filter = match choice {
            FilterChoice::Tile(mosaic) => ColourFilter::tiled(mosaic, size)?,
            FilterChoice::Picture(path) => {
                let (of, pixels) = filter_picture(path)?;
                if of != size {
                    return Err(Error::data(
                        format!("a filter of {of} for a clip of {size}"),
                        path,
                        "use a picture of the clip's size, one pixel for each pixel",
                    ));
                }
                ColourFilter::from_picture(size, &pixels, &path.display().to_string())?
            }
        };
        Ok(Self { planes, filter: colour.applied_to(filter) })
    }
}

impl ExposureSource for MosaicClip {
    fn info(&self) -> ClipInfo {
        self.planes[0].info()
    }

    fn next(&mut self) -> Result<Option<Exposure>> {
        let [red, green, blue] = &mut self.planes;
        let (Some(red), Some(green), Some(blue)) = (red.next()?, green.next()?, blue.next()?)
        else {
            return Ok(None);
        };
        let truth = [&red, &green, &blue].map(|plane| plane.truth().clone());
        let instants = red.instants.into_iter().zip(green.instants).zip(blue.instants);
        let instants = instants.map(|((r, g), b)| self.filter.mosaic(&[r, g, b])).collect();
        let middle = Some(self.filter.mosaic(&truth));
        Ok(Some(Exposure { instants, middle, colour: Some(Box::new(truth)) }))
    }

    fn flow(&self, index: u64) -> Option<Flow> {
        self.planes[0].flow(index)
    }
}

/// Reads the picture of a filter: its size and its pixels.
///
/// # Errors
/// [`Error`] if it cannot be read.
pub fn filter_picture(path: &Path) -> Result<(Size, Vec<[u8; 3]>)> {
    require_regular(path, "read the filter")?;
    let image = decode_image(path, IMAGE_PIXELS)?.to_rgb8();
    let size = Size { height: image.height() as usize, width: image.width() as usize };
    Ok((size, image.pixels().map(|pixel| pixel.0).collect()))
}

impl Exposure {
    /// Returns red, green and blue of the scene in the middle of the exposure, of clips behind a colour
    /// filter.
    pub fn colour_truth(&self) -> Option<&[Frame; 3]> {
        self.colour.as_deref()
    }
}
