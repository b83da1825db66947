//! LPIPS of restored frames, where its weights are given.

use crate::error::{CliError, Result};
use burn::tensor::Device;
use qudi_core::Frame;
use qudi_layers::tensor::{read, to_tensor};
use qudi_train::loss::lpips::{Lpips, PerceptualKind};
use std::path::Path;

/// LPIPS with the weights that there are.
#[derive(Debug)]
pub(crate) struct Perceptual {
    nets: Vec<(PerceptualKind, Lpips)>,
    device: Device,
}

impl Perceptual {
    /// Reads the weights in `folder` onto `device`.
    ///
    /// # Errors
    /// [`CliError`] if there are none, or they do not fit.
    pub(super) fn load(folder: &Path, device: Device) -> Result<Self> {
        let mut nets = Vec::new();
        for kind in [PerceptualKind::LpipsAlex, PerceptualKind::LpipsVgg] {
            if Lpips::find(kind, Some(folder)).is_ok() {
                nets.extend(Lpips::load(kind, Some(folder), &device)?.map(|net| (kind, net)));
            }
        }
        if nets.is_empty() {
            return Err(CliError::new(
                "there are no weights of LPIPS",
                folder.display(),
                "make them with scripts/convert/lpips.py, or leave --backbones out",
            ));
        }
        Ok(Self { nets, device })
    }

    /// Computes the distance of an image from the truth; none if the weights of `kind` are missing.
    ///
    /// # Errors
    /// [`CliError`] if the frames are too small, or the device fails.
    pub(super) fn distance(
        &self,
        kind: PerceptualKind,
        image: &Frame,
        truth: &Frame,
    ) -> Result<Option<f64>> {
        let Some((_, net)) = self.nets.iter().find(|(of, _)| *of == kind) else { return Ok(None) };
        let small = |e| CliError::new(e, "--backbones", "use larger frames, or leave it out");
        net.check(truth.size).map_err(small)?;
        let tensor = |frame: &Frame| to_tensor(frame.data.clone(), frame.size, &self.device);
        let values = read(net.distances(tensor(image), tensor(truth)))?;
        Ok(values.first().map(|&value| f64::from(value)))
    }
}
