//! The colour filter of a capture, turned and cropped with its frames.

use super::view::View;
use crate::description::CaptureInfo;
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

/// Returns the filter that the file or its record names.
pub(super) fn recorded_filter(info: &CaptureInfo) -> Option<FilterChoice> {
    let of_sensor = || info.sensor.as_ref()?.colour.as_ref()?.cfa.clone();
    info.cfa.clone().or_else(of_sensor)
}

/// Returns a sentence on the filter in use, if the `given` one is not the `recorded` one, or none is in use.
pub(super) fn contradiction(
    recorded: &FilterChoice,
    given: Option<&FilterChoice>,
    used: Option<&FilterChoice>,
    stored: Size,
    usual: &View,
) -> Option<String> {
    let Some(used) = used else {
        return Some(format!(
            "the capture records the colour filter {recorded}, and the named sensor has none: frames are read as gray; name the filter with --cfa {recorded}"
        ));
    };
    let given = given.filter(|&given| given != recorded)?;
    let whole = View { size: stored, from: None };
    let filter = |choice| filter_of(choice, None, stored, usual, &whole).ok();
    if filter(given).is_some_and(|given| filter(recorded) == Some(given)) {
        return None;
    }
    Some(format!(
        "the capture records the colour filter {recorded}, and {given} is named: {used} is used; colours are wrong if that is not the camera's"
    ))
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
