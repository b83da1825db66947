//! From maps to images, the coarse scale first.

use crate::parts::{ConvTranspose, renamed};
use burn::module::Module;
use burn::tensor::activation::{gelu, relu, sigmoid};
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d};
use std::slice::from_ref;

/// Reduction of channels inside the attention.
const REDUCTION: usize = 16;

/// The reconstruction of one scale.
#[derive(Module, Debug)]
pub(crate) struct Reconstructor {
    conv1x1: Conv2d,
    cab: ChannelBlock,
    flast0: Conv2d,
    flast2: Conv2d,
    flast4: Conv2d,
    flast6: ConvTranspose,
    out0: Conv2d,
    out2: Conv2d,
    out4: Conv2d,
    out6: Conv2d,
    out7: Conv2d,
    upconv_out: ConvTranspose,
}

/// Two convolutions whose channels are weighted by their means, and a residual.
#[derive(Module, Debug)]
struct ChannelBlock {
    ca0: Conv2d,
    ca2: Conv2d,
    body0: Conv2d,
    body2: Conv2d,
}

impl Reconstructor {
    pub(crate) fn zeros(features: usize, device: &Device) -> Self {
        let n = features;
        let conv = |sizes, kernel| Conv2d::zeros(sizes, kernel, Bias::Yes, device);
        let plain = |sizes| Conv2d::zeros(sizes, 1, Bias::No, device);
        let inner = 8 * n / REDUCTION;
        Self {
            conv1x1: conv([8 * n, 8 * n], 1),
            cab: ChannelBlock {
                ca0: plain([8 * n, inner]),
                ca2: plain([inner, 8 * n]),
                body0: conv([8 * n, 8 * n], 1),
                body2: conv([8 * n, 8 * n], 3),
            },
            flast0: conv([8 * n, 8 * n], 3),
            flast2: conv([8 * n, 6 * n], 3),
            flast4: conv([6 * n, 4 * n], 3),
            flast6: ConvTranspose::zeros([4 * n, 4 * n], 3, device),
            out0: conv([8 * n, 6 * n], 3),
            out2: conv([6 * n, 4 * n], 3),
            out4: conv([4 * n, 2 * n], 3),
            out6: conv([2 * n, n], 3),
            out7: conv([n, 1], 3),
            upconv_out: ConvTranspose::zeros([1, 1], 3, device),
        }
    }

    pub(crate) fn authors_name(name: &str) -> String {
        if !name.starts_with("recons") {
            return name.to_owned();
        }
        let mut name =
            renamed(name, &[(".cab.ca", ".cab.CA.conv_du."), (".cab.body", ".cab.body.")]);
        for list in [".flast", ".out"] {
            // The number of a layer stands apart from the list's name.
            if let Some((before, after)) = name.split_once(list)
                && after.starts_with(|c: char| c.is_ascii_digit())
            {
                name = format!("{before}{list}.{after}");
            }
        }
        name
    }

    /// Returns the image, and the input of the next finer scale: features and image at twice the size.
    pub(crate) fn forward(
        &self,
        h: Tensor<4>,
        f: Tensor<4>,
        image: Tensor<4>,
    ) -> (Tensor<4>, Tensor<4>, Tensor<4>) {
        let (image, a) = self.image(h, f, image);
        let f = [&self.flast0, &self.flast2, &self.flast4]
            .into_iter()
            .fold(a, |x, layer| gelu(layer.linear(&[x])));
        (image.clone(), self.flast6.forward(f), self.upconv_out.forward(image))
    }

    /// Returns the image alone, and the features that it was made of.
    pub(crate) fn image(
        &self,
        h: Tensor<4>,
        f: Tensor<4>,
        image: Tensor<4>,
    ) -> (Tensor<4>, Tensor<4>) {
        let a = self.cab.forward(self.conv1x1.linear(&[h, f]));
        let x = [&self.out0, &self.out2, &self.out4]
            .into_iter()
            .fold(a.clone(), |x, layer| gelu(layer.linear(&[x])));
        (self.out7.add(&[self.out6.linear(&[x])], image), a)
    }
}

impl ChannelBlock {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let y = self.body2.linear(&[gelu(self.body0.linear(from_ref(&x)))]);
        let mean = y.clone().mean_dim(2).mean_dim(3);
        let weight = sigmoid(self.ca2.linear(&[relu(self.ca0.linear(&[mean]))]));
        y * weight + x
    }
}
