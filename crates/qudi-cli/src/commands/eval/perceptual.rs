//! LPIPS of restored frames, where its weights are given.

use crate::error::{CliError, Result};
use burn::tensor::Device;
use qudi_core::Frame;
use qudi_layers::tensor::{read, to_tensor};
use qudi_train::loss::lpips::{Lpips, PerceptualKind};
use std::path::Path;

/// The distances that are measured, in the order of [`Distances`].
const KINDS: [PerceptualKind; 2] = [PerceptualKind::LpipsAlex, PerceptualKind::LpipsVgg];

/// LPIPS with AlexNet and with VGG16; none where its weights are missing.
pub(super) type Distances = [Option<f64>; 2];

/// LPIPS with the weights that there are.
#[derive(Debug)]
pub(super) struct Perceptual {
    nets: [Option<Lpips>; 2],
    device: Device,
}

impl Perceptual {
    /// Reads the weights in `folder` onto `device`.
    ///
    /// # Errors
    /// [`CliError`] if there are none, or they do not fit.
    pub(super) fn load(folder: &Path, device: Device) -> Result<Self> {
        let mut nets = [None, None];
        for (net, kind) in nets.iter_mut().zip(KINDS) {
            if Lpips::find(kind, Some(folder)).is_ok() {
                *net = Lpips::load(kind, Some(folder), &device)?;
            }
        }
        if nets.iter().all(Option::is_none) {
            return Err(CliError::new(
                "there are no weights of LPIPS",
                folder.display(),
                "make them with scripts/convert/lpips.py, or leave --backbones out",
            ));
        }
        Ok(Self { nets, device })
    }

    /// The distances of an image from the truth.
    ///
    /// # Errors
    /// [`CliError`] if the frames are too small, or the device fails.
    pub(super) fn distances(&self, image: &Frame, truth: &Frame) -> Result<Distances> {
        let mut distances = [None, None];
        for (distance, net) in distances.iter_mut().zip(&self.nets) {
            let Some(net) = net else { continue };
            let small = |e| CliError::new(e, "--backbones", "use larger frames, or leave it out");
            net.check(truth.size).map_err(small)?;
            let tensor = |frame: &Frame| to_tensor(frame.data.clone(), frame.size, &self.device);
            let values = read(net.distances(tensor(image), tensor(truth)))?;
            *distance = values.first().map(|&value| f64::from(value));
        }
        Ok(distances)
    }
}
