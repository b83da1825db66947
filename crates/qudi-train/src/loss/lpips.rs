//! LPIPS, a distance between images that follows human judgement (Zhang et al. 2018, "The Unreasonable
//! Effectiveness of Deep Features as a Perceptual Metric", version 0.1; docs/training.md).
//!
//! It compares the features of an image classifier, whose weights come from files. They are constants:
//! gradients flow to the images alone.

mod backbone;
mod convolution;
#[cfg(test)]
mod golden_tests;
mod input;
mod weight_files;

use backbone::{Backbone, Weights};
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::nearest::nearest;
use qudi_core::{Error, Result, Size};
use qudi_layers::StateDict;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

pub(crate) use backbone::Net;
pub use input::Images;
pub use weight_files::cache_folder;

/// The perceptual term of a recipe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "&'static str")]
pub enum PerceptualKind {
    /// No perceptual term.
    None,
    /// LPIPS on features of VGG16.
    LpipsVgg,
    /// LPIPS on features of AlexNet.
    LpipsAlex,
}

/// All kinds of perceptual terms.
pub const PERCEPTUAL_KINDS: &[PerceptualKind] =
    &[PerceptualKind::None, PerceptualKind::LpipsVgg, PerceptualKind::LpipsAlex];

impl PerceptualKind {
    /// Returns the name of the kind in recipes.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::LpipsVgg => "lpips-vgg",
            Self::LpipsAlex => "lpips-alex",
        }
    }

    /// Returns the kind of this name.
    ///
    /// # Errors
    /// [`Error::Request`] that lists the names.
    pub fn by_name(name: &str) -> Result<Self> {
        if let Some(kind) = PERCEPTUAL_KINDS.iter().find(|kind| kind.name() == name) {
            return Ok(*kind);
        }
        let names: Vec<_> = PERCEPTUAL_KINDS.iter().map(|kind| kind.name()).collect();
        let list = format!("use one of {}", names.join(", "));
        let hint =
            nearest(name, &names).map_or(String::new(), |name| format!("did you mean `{name}`?  "));
        let (what, help) = (format!("no perceptual term named `{name}`"), format!("{hint}{list}"));
        Err(Error::request(what, "train.loss.term", help))
    }

    fn net(self) -> Option<Net> {
        match self {
            Self::None => None,
            Self::LpipsVgg => Some(Net::Vgg),
            Self::LpipsAlex => Some(Net::Alex),
        }
    }
}

impl TryFrom<String> for PerceptualKind {
    type Error = String;

    fn try_from(name: String) -> std::result::Result<Self, String> {
        Self::by_name(&name).map_err(|error| match error.help() {
            Some(help) => format!("{error}; {help}"),
            None => error.to_string(),
        })
    }
}

impl From<PerceptualKind> for &'static str {
    fn from(kind: PerceptualKind) -> Self {
        kind.name()
    }
}

/// Added to the squared length of a feature vector, so that its root has a gradient where all features are
/// zero, as they often are after a ReLU.
const SQUARED_FLOOR: f32 = 1e-10;

/// The distance with its weights.
#[derive(Clone, Debug)]
pub struct Lpips {
    net: Net,
    backbone: Backbone,
    /// Weights of the channels of every tap, `[1, channels]`.
    heads: Vec<Tensor<2>>,
}

impl Lpips {
    /// Checks that the weights of `kind` are where [`load`](Self::load) looks for them.
    ///
    /// # Errors
    /// [`Error`] that says which are missing, and where to get them.
    pub fn find(kind: PerceptualKind, folder: Option<&Path>) -> Result<()> {
        kind.net().map_or(Ok(()), |net| weight_files::find(net, folder).map(drop))
    }

    /// Reads the weights of `kind` onto `device` to compare gray images: from `folder`, if one is given, or
    /// else from [`cache_folder`]. Gives nothing for [`PerceptualKind::None`].
    ///
    /// # Errors
    /// [`Error`] if weights are missing (it says which and where to get them), or do not fit.
    pub fn load(
        kind: PerceptualKind,
        folder: Option<&Path>,
        device: &Device,
    ) -> Result<Option<Self>> {
        Self::load_for(Images::Gray, kind, folder, device)
    }

    /// Reads the weights of `kind` as [`load`](Self::load) does, to compare `images` of a kind.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn load_for(
        images: Images,
        kind: PerceptualKind,
        folder: Option<&Path>,
        device: &Device,
    ) -> Result<Option<Self>> {
        let Some(net) = kind.net() else { return Ok(None) };
        let [backbone, heads] = weight_files::find(net, folder)?;
        let (backbone, heads) = (StateDict::open(&backbone)?, StateDict::open(&heads)?);
        let mut weights = |name: &str, shape: &[usize]| {
            let file = if name.starts_with("lin") { &heads } else { &backbone };
            file.read(name, shape)
        };
        Ok(Some(Self::new(net, images, &mut weights, &device.clone().inner())?))
    }

    /// Asks for the weights by name: torchvision's (`features.0.weight`) and LPIPS's (`lin0.model.1.weight`).
    ///
    /// # Errors
    /// Those of `weights`.
    fn new(net: Net, images: Images, weights: &mut Weights<'_>, device: &Device) -> Result<Self> {
        let backbone = Backbone::new(net.layers(), images, weights, device)?;
        let heads = backbone.taps.iter().enumerate().map(|(tap, &channels)| {
            let head = weights(&format!("lin{tap}.model.1.weight"), &[1, channels, 1, 1])?;
            Ok(Tensor::from_data(TensorData::new(head, [1, channels]), device))
        });
        Ok(Self { net, heads: heads.collect::<Result<_>>()?, backbone })
    }

    /// Checks that images of this size can be compared.
    ///
    /// # Errors
    /// [`Error::Request`] with both sizes if they are too small.
    pub fn check(&self, size: Size) -> Result<()> {
        let smallest = self.net.smallest_side();
        if size.height.min(size.width) >= smallest {
            return Ok(());
        }
        Err(Error::request(
            format!(
                "LPIPS needs images of at least {smallest} x {smallest} pixels, these are {size}"
            ),
            "train.loss.term",
            "take larger crops, or set the term to \"none\"",
        ))
    }

    /// Returns the mean over all images of the distance of `p` from `q`.
    ///
    /// # Shapes
    /// - p, q: `[images, 1, height, width]` in [0, 1] (3 planes of [`Images::Colour`]), of a size that
    ///   [`check`](Self::check) accepts, on the device of the weights, with autodiff or without
    /// - output: `[1]`
    pub fn loss(&self, p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
        self.distances(p, q).mean()
    }

    /// Returns the distance of every image of `p` from the image of `q`; 0 for equal images.
    ///
    /// # Shapes
    /// - p, q: as for [`loss`](Self::loss)
    /// - output: `[images]`
    pub fn distances(&self, p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
        assert_eq!(p.dims(), q.dims(), "images to compare");
        let images = p.dims()[0];
        let [p, q] = [p, q].map(|images| self.backbone.forward(input::with_ones(images)));
        let mut sum = Tensor::zeros([images, 1], &p[0].device());
        for ((p, q), head) in p.into_iter().zip(q).zip(&self.heads) {
            let [_, channels, height, width] = p.dims();
            let error = (unit(p) - unit(q)).powi_scalar(2);
            // The mean over the pixels first: it is as linear as the head, which is then a short product.
            let error = error.reshape([images, channels, height * width]).mean_dim(2);
            let error = error.reshape([images, channels]);
            sum = sum + (error * head.clone()).sum_dim(1);
        }
        sum.reshape([images])
    }
}

/// Feature vectors scaled to length one.
fn unit(x: Tensor<4>) -> Tensor<4> {
    let length = (x.clone().powi_scalar(2).sum_dim(1) + SQUARED_FLOOR).sqrt();
    x / length
}
