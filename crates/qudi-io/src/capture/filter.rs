//! The colour filter of a capture, turned and cropped with its frames.

use super::view::View;
use qudi_core::colour::{ColourFilter, FilterChoice};
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Result, Size};
use qudi_sim::clip::filter_picture;
use std::path::Path;

/// Returns the filter of frames in `view`, which are stored with size `stored`. A picture of the filter is of
/// the stored frames, or of frames in the `usual` view.
pub(super) fn filter_of(
    choice: &FilterChoice,
    sensor: Option<&Sensor>,
    stored: Size,
    usual: &View,
    view: &View,
) -> Result<ColourFilter> {
    let whole = match choice {
        FilterChoice::Tile(mosaic) => ColourFilter::tiled(mosaic, stored)?,
        FilterChoice::Picture(path) => picture(path, stored, usual)?,
    };
    let filter = whole.seen(view.size, view.from.as_deref())?;
    let colour = sensor.and_then(|sensor| sensor.colour.as_ref());
    Ok(match colour {
        Some(colour) => colour.applied_to(filter),
        None => filter,
    })
}

/// Reads the picture of a filter.
fn picture(path: &Path, stored: Size, usual: &View) -> Result<ColourFilter> {
    let (size, pixels) = filter_picture(path)?;
    let place = path.display().to_string();
    if size == stored {
        return ColourFilter::from_picture(size, &pixels, &place);
    }
    if size == usual.size {
        // What the usual view leaves out is never seen; white is as good as any colour there.
        let pixels = usual.stored(&pixels, stored, [255; 3]);
        return ColourFilter::from_picture(stored, &pixels, &place);
    }
    Err(Error::data(
        format!("a filter of {size} for frames that are stored as {stored}"),
        path,
        "use the picture of this camera's filter, one pixel for each pixel of the array",
    ))
}
