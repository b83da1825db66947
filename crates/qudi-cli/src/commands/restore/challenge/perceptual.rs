//! LPIPS as the challenge's site computes it: features of AlexNet, of sRGB values from 0 to 1 that are not
//! mapped to -1 to 1, where torchmetrics by default takes them.

use crate::device;
use crate::error::{CliError, Result};
use burn::tensor::{Device, Tensor};
use image::RgbImage;
use qudi_core::Size;
use qudi_layers::tensor::{read, to_tensor};
use qudi_train::loss::lpips::{Images, Lpips, PerceptualKind};
use std::path::Path;

/// LPIPS with its weights.
pub(super) struct Perceptual {
    net: Lpips,
    device: Device,
}

impl Perceptual {
    /// Reads the weights in `folder`.
    ///
    /// # Errors
    /// [`CliError`] if they are missing or do not fit.
    pub(super) fn load(folder: &Path, device: &str) -> Result<Self> {
        let device = device::open(device)?.device;
        let missing = || {
            let help = "make them with scripts/convert/lpips.py, or leave --backbones out";
            CliError::new("there are no weights of LPIPS on AlexNet", folder.display(), help)
        };
        let kind = PerceptualKind::LpipsAlex;
        Lpips::find(kind, Some(folder)).map_err(|_| missing())?;
        let net =
            Lpips::load_for(Images::Colour, kind, Some(folder), &device)?.ok_or_else(missing)?;
        Ok(Self { net, device })
    }

    /// Computes the distance of a picture from the truth; none for pictures that are too small.
    ///
    /// # Errors
    /// [`CliError`] if the device fails.
    pub(super) fn distance(&self, picture: &RgbImage, truth: &RgbImage) -> Result<Option<f64>> {
        let size = Size { height: truth.height() as usize, width: truth.width() as usize };
        if self.net.check(size).is_err() {
            return Ok(None);
        }
        let plane = |image: &RgbImage, colour: usize| {
            let values = image.as_raw().iter().skip(colour).step_by(3);
            // The distance maps [0, 1] to [-1, 1] itself: this undoes it.
            let value = |&value: &u8| (f32::from(value) / 255.0 + 1.0) * 0.5;
            to_tensor(values.map(value).collect(), size, &self.device)
        };
        let planes = |image| Tensor::cat((0..3).map(|colour| plane(image, colour)).collect(), 1);
        let values = read(self.net.distances(planes(picture), planes(truth)))?;
        Ok(values.first().map(|&value| f64::from(value)))
    }
}
