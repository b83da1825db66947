//! Frames that another program made of exported photons.

use super::args::External;
use super::exposed_clip::burst_name;
use crate::error::{CliError, Result};
use crate::methods::Method;
use qudi_core::Frame;
use qudi_core::npy::read_clip;
use qudi_sim::clip::{Input, Sampling};
use std::path::{Path, PathBuf};

/// Range of values of frames whose white is 1; restored frames go beyond black and white by a little.
const RANGE: std::ops::RangeInclusive<f32> = -1.0..=2.0;

/// Frames of a clip, where they lie, and the range of their values.
pub(super) struct ExternalFrames {
    pub(super) frames: Vec<Frame>,
    pub(super) place: PathBuf,
    pub(super) range: [f32; 2],
}

/// Refuses names of methods, and names that come twice.
pub(super) fn check_names(external: &[External]) -> Result<()> {
    for (n, External { name, .. }) in external.iter().enumerate() {
        let help = "give it a name of its own";
        if Method::by_name(name).is_some() {
            let what = format!("`{name}` is a method of this program");
            return Err(CliError::new(what, "--external", help));
        }
        if external[..n].iter().any(|other| other.name == *name) {
            return Err(CliError::new(format!("`{name}` comes twice"), "--external", help));
        }
    }
    Ok(())
}

impl ExternalFrames {
    /// Reads the frames of a clip at a light level: `NAME.npy`, `NAME.tif`, or a folder of that name.
    pub(super) fn read(external: &External, clip: &str, ppp: f64) -> Result<Self> {
        let place = external.folder.join(burst_name(clip, ppp));
        let file = |extension: &str| Some(place.with_extension(extension)).filter(|p| p.is_file());
        let (place, frames) = match (file("npy"), file("tif").or(file("tiff"))) {
            (Some(array), _) => {
                let frames = read_clip(&array, usize::MAX)?;
                (array, frames)
            }
            (None, Some(stack)) => {
                let frames = clip_frames(&stack)?;
                (stack, frames)
            }
            (None, None) => {
                let frames = clip_frames(&place)?;
                (place, frames)
            }
        };
        let values = || frames.iter().flat_map(|frame| &frame.data).copied();
        let range = [values().fold(f32::MAX, f32::min), values().fold(f32::MIN, f32::max)];
        if !range.iter().all(|value| RANGE.contains(value)) {
            let [low, high] = range;
            return Err(CliError::new(
                format!("values from {low} to {high}, where 0 is black and 1 is white"),
                place.display(),
                "divide the frames by their value of white, such as 255",
            ));
        }
        Ok(Self { frames, place, range })
    }
}

fn clip_frames(path: &Path) -> Result<Vec<Frame>> {
    let input = Input::clip(path)?;
    // A stack of one page is a still, which shows one frame and not as many as any scene.
    let frames = matches!(input, Input::Still { .. }).then_some(1);
    let mut source = input.open(&Sampling { frames, ..Sampling::default() })?;
    let mut list = Vec::new();
    while let Some(exposure) = source.next()? {
        list.push(exposure.truth().clone());
    }
    Ok(list)
}
