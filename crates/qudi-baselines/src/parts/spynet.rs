//! Flow in a pyramid (Ranjan and Black, "Optical flow estimation using a spatial pyramid network", CVPR
//! 2017).

use super::resize::{Corners, resize};
use super::same_flow;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use qudi_kernels::warp;
use qudi_layers::Layers;
use qudi_layers::resample::avg_pool2;

/// Sides of images inside are multiples of this.
const MULTIPLE: usize = 32;

/// The flow network.
#[derive(Module, Debug)]
pub struct SpyNet {
    /// Returns a pyramid, the coarsest level first.
    levels: Vec<Layers>,
    /// Mean and standard deviation of every channel that images are made into.
    #[module(skip)]
    channels: Vec<[f32; 2]>,
}

impl SpyNet {
    /// Makes the network, all weights zero. Every channel of the images inside is the image less a mean, over
    /// a standard deviation.
    pub fn zeros(
        levels: usize,
        widths: [usize; 4],
        channels: Vec<[f32; 2]>,
        device: &Device,
    ) -> Self {
        let [a, b, c, d] = widths;
        let sizes = [[2 * channels.len() + 2, a], [a, b], [b, c], [c, d], [d, 2]];
        let level = |_| Layers::zeros(&sizes, 7, device);
        Self { levels: (0..levels).map(level).collect(), channels }
    }

    /// Returns the name of a parameter in the authors' files.
    pub fn authors_name(name: &str) -> String {
        let Some((before, after)) = name.split_once("spynet.levels.") else {
            return name.to_owned();
        };
        let name =
            format!("{before}spynet.basic_module.{}", after.replace("layers", "basic_module"));
        // The last number before weight or bias is a layer's, which counts activations, too.
        let mut parts: Vec<String> = name.split('.').map(str::to_owned).collect();
        if let Some(layer) = parts.iter_mut().rev().nth(1)
            && let Ok(number) = layer.parse::<usize>()
        {
            *layer = (2 * number).to_string();
        }
        parts.join(".")
    }

    /// Computes the flow from `reference` to `supporting` at the size of the images over each of `scales`,
    /// powers of two from 1 on: `warp(supporting, flow)` resembles `reference`.
    ///
    /// # Shapes
    /// - reference, supporting: `[images, 1, height, width]`
    /// - results: `[images, 2, height / scale, width / scale]`, in pixels of that size
    pub fn forward(
        &self,
        reference: Tensor<4>,
        supporting: Tensor<4>,
        scales: &[usize],
    ) -> Vec<Tensor<4>> {
        let [images, _, height, width] = reference.dims();
        let padded = [height, width].map(|side| side.next_multiple_of(MULTIPLE));
        let [reference, supporting] = [reference, supporting]
            .map(|image| self.pyramid(resize(image, padded, Corners::Edges)));
        let mut flows: Vec<Tensor<4>> = Vec::with_capacity(self.levels.len());
        let pairs = reference.into_iter().zip(supporting);
        for (level, (reference, supporting)) in self.levels.iter().zip(pairs) {
            let [_, _, h, w] = reference.dims();
            let up = match flows.last() {
                Some(flow) => resize(flow.clone(), [h, w], Corners::Centres) * 2.0,
                None => Tensor::zeros([images, 2, h, w], &reference.device()),
            };
            let warped = warp(supporting, up.clone());
            flows.push(level.forward(vec![reference, warped, up.clone()]) + up);
        }
        let finest_first = flows.into_iter().rev();
        let scaled = |(flow, &scale): (Tensor<4>, &usize)| {
            let size = [height / scale, width / scale];
            let factor = |axis: usize| size[axis] as f32 / (padded[axis] / scale) as f32;
            let factors = same_flow([factor(1), factor(0)], &flow.device());
            resize(flow, size, Corners::Edges) * factors
        };
        finest_first.zip(scales).map(scaled).collect()
    }

    /// Returns a pyramid, the coarsest level first.
    fn pyramid(&self, image: Tensor<4>) -> Vec<Tensor<4>> {
        // An image of one channel serves for all.
        let last = image.dims()[1] - 1;
        let channel = |(number, &[mean, deviation]): (usize, &[f32; 2])| {
            (image.clone().narrow(1, number.min(last), 1) - mean) / deviation
        };
        let channels = self.channels.iter().enumerate();
        let mut images = vec![Tensor::cat(channels.map(channel).collect(), 1)];
        for _ in 1..self.levels.len() {
            let coarser = avg_pool2(images[images.len() - 1].clone());
            images.push(coarser);
        }
        images.reverse();
        images
    }
}
