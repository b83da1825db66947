//! LPIPS (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", version
//! 0.1): distances of features of a classification network, weighted as people judge.

use super::backbone::{ALEX, Backbone, Layer, SQUEEZE, VGG, Weights};
use super::gray;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::Result;

/// Added to the squared length of a feature vector, so that its root has a gradient where all features are
/// zero, as they often are after a ReLU.
const SQUARED_FLOOR: f32 = 1e-10;

/// Which network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Net {
    Vgg,
    Alex,
    Squeeze,
}

impl Net {
    fn layers(self) -> &'static [Layer] {
        match self {
            Self::Vgg => VGG,
            Self::Alex => ALEX,
            Self::Squeeze => SQUEEZE,
        }
    }

    /// Shortest side of an image that reaches the last layer.
    pub(super) fn smallest_side(self) -> usize {
        match self {
            Self::Vgg => 16,
            Self::Alex => 31,
            Self::Squeeze => 25,
        }
    }
}

/// The distance with its weights, which are constants.
#[derive(Clone, Debug)]
pub(super) struct Lpips {
    backbone: Backbone,
    /// Weights of the channels of every tap, `[1, channels]`.
    heads: Vec<Tensor<2>>,
}

impl Lpips {
    /// Reads the weights; names are torchvision's (`features.0.weight`) and LPIPS's
    /// (`lin0.model.1.weight`).
    ///
    /// # Errors
    /// Those of `weights`.
    pub(super) fn new(net: Net, weights: &mut Weights<'_>, device: &Device) -> Result<Self> {
        let backbone = Backbone::new(net.layers(), weights, device)?;
        let heads = backbone.taps.iter().enumerate().map(|(tap, &channels)| {
            let head = weights(&format!("lin{tap}.model.1.weight"), &[1, channels, 1, 1])?;
            Ok(Tensor::from_data(TensorData::new(head, [1, channels]), device))
        });
        Ok(Self { heads: heads.collect::<Result<_>>()?, backbone })
    }

    /// `[images]`, from images `[images, 1, height, width]` in [0, 1].
    pub(super) fn distances(&self, p: Tensor<4>, q: Tensor<4>) -> Tensor<1> {
        let images = p.dims()[0];
        let [p, q] = [p, q].map(|images| self.backbone.forward(gray::planes(images)));
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

/// Feature vectors of length one.
fn unit(x: Tensor<4>) -> Tensor<4> {
    let length = (x.clone().powi_scalar(2).sum_dim(1) + SQUARED_FLOOR).sqrt();
    x / length
}
