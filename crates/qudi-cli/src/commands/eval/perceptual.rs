//! LPIPS of restored frames, where its weights are given.

use crate::error::{CliError, Result};
use burn::tensor::{Device, Tensor};
use qudi_core::Frame;
use qudi_layers::tensor::{read, to_tensor};
use qudi_train::loss::lpips::{Images, Lpips, PerceptualKind};
use std::path::Path;

/// LPIPS with the weights that there are.
#[derive(Debug)]
pub(crate) struct Perceptual {
    nets: Vec<(PerceptualKind, Lpips)>,
    device: Device,
}

impl Perceptual {
    /// Reads the weights in `folder` onto `device`, for images of a kind.
    ///
    /// # Errors
    /// [`CliError`] if there are none, or they do not fit.
    pub(super) fn load(folder: &Path, images: Images, device: Device) -> Result<Self> {
        let mut nets = Vec::new();
        for kind in [PerceptualKind::LpipsAlex, PerceptualKind::LpipsVgg] {
            if Lpips::find(kind, Some(folder)).is_ok() {
                nets.extend(
                    Lpips::load_for(images, kind, Some(folder), &device)?.map(|net| (kind, net)),
                );
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
        self.distance_of_planes(kind, [image], [truth])
    }

    /// Computes the distance of an image of several planes, as [`distance`](Self::distance) does.
    pub(super) fn distance_of_planes<const N: usize>(
        &self,
        kind: PerceptualKind,
        image: [&Frame; N],
        truth: [&Frame; N],
    ) -> Result<Option<f64>> {
        let Some((_, net)) = self.nets.iter().find(|(of, _)| *of == kind) else { return Ok(None) };
        let small = |e| CliError::new(e, "--backbones", "use larger frames, or leave it out");
        net.check(truth[0].size).map_err(small)?;
        let plane = |frame: &Frame| to_tensor(frame.data.clone(), frame.size, &self.device);
        let tensor = |planes: [&Frame; N]| Tensor::cat(planes.map(plane).to_vec(), 1);
        let values = read(net.distances(tensor(image), tensor(truth)))?;
        Ok(values.first().map(|&value| f64::from(value)))
    }
}
