//! Flow from warped features and their correlation (Sun et al., "PWC-Net", CVPR 2018).

use crate::parts::{ConvTranspose, leaky, renamed, same_flow, warp_zeros};
use burn::module::{Module, Param};
use burn::tensor::module::conv2d;
use burn::tensor::ops::{ConvOptions, PadMode};
use burn::tensor::{Device, Tensor};
use qudi_layers::{Bias, Conv2d, zeros};

/// Scale of the flow, in pixels of the full size.
pub(super) const FLOW_SCALE: f32 = 20.0;

/// Largest distance of compared features, in cells.
const RADIUS: usize = 4;

/// Places where they are compared.
const PLACES: usize = (2 * RADIUS + 1) * (2 * RADIUS + 1);

/// Names of levels in files, the finest first.
const LEVELS: [&str; 6] = ["One", "Two", "Thr", "Fou", "Fiv", "Six"];

/// Channels of the features of all levels.
const PYRAMID_WIDTHS: [usize; 6] = [16, 32, 64, 96, 128, 196];

/// Channels that the dense layers of a decoder add.
const DENSE_WIDTHS: [usize; 5] = [128, 128, 96, 64, 32];

/// Channels of the refining layers, and their dilations.
const REFINER_LAYERS: [(usize, usize); 7] =
    [(128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1), (2, 1)];

/// The flow network.
#[derive(Module, Debug)]
pub(super) struct PwcNet {
    /// The finest level first.
    extractor: Vec<Features>,
    /// The coarsest level first; the finest has none.
    decoders: Vec<Decoder>,
    refiner: Vec<Dilated>,
}

#[derive(Module, Debug)]
struct Features {
    first: Conv2d,
    second: Conv2d,
    third: Conv2d,
}

#[derive(Module, Debug)]
struct Decoder {
    upflow: Option<ConvTranspose>,
    upfeat: Option<ConvTranspose>,
    dense: Vec<Conv2d>,
    last: Conv2d,
    /// Cells of this level that flow times this is in.
    scale: f32,
}

/// A convolution of 3 x 3 with its taps apart.
#[derive(Module, Debug)]
struct Dilated {
    /// `[outputs, inputs, 3, 3]`
    weight: Param<Tensor<4>>,
    /// `[outputs]`
    bias: Param<Tensor<1>>,
    apart: usize,
}

impl PwcNet {
    pub(super) fn zeros(device: &Device) -> Self {
        let conv = |sizes| Conv2d::zeros(sizes, 3, Bias::Yes, device);
        let mut inputs = 3;
        let mut extractor = Vec::new();
        for width in PYRAMID_WIDTHS {
            let same = || conv([width, width]);
            extractor.push(Features {
                first: conv([inputs, width]),
                second: same(),
                third: same(),
            });
            inputs = width;
        }
        let mut coarser = None;
        let mut decoders = Vec::new();
        for level in (1..LEVELS.len()).rev() {
            let up = |size| ConvTranspose::zeros([size, 2], 4, device);
            let mut size = PLACES + coarser.map_or(0, |_| PYRAMID_WIDTHS[level] + 4);
            let mut dense = Vec::new();
            for growth in DENSE_WIDTHS {
                dense.push(conv([size, growth]));
                size += growth;
            }
            decoders.push(Decoder {
                upflow: coarser.map(|_| up(2)),
                upfeat: coarser.map(up),
                dense,
                last: conv([size, 2]),
                scale: FLOW_SCALE / (2 << level) as f32,
            });
            coarser = Some(size);
        }
        let mut inputs = coarser.expect("five decoders");
        let mut refiner = Vec::new();
        for (width, apart) in REFINER_LAYERS {
            let weight = zeros([width, inputs, 3, 3], device);
            refiner.push(Dilated { weight, bias: zeros([width], device), apart });
            inputs = width;
        }
        Self { extractor, decoders, refiner }
    }

    pub(super) fn authors_name(name: &str) -> String {
        let Some(rest) = name.strip_prefix("pwcnet.") else { return name.to_owned() };
        let (part, rest) = rest.split_once('.').unwrap_or((rest, ""));
        let (number, rest) = rest.split_once('.').unwrap_or((rest, ""));
        let number: usize = number.parse().unwrap_or(0);
        let name = match part {
            "extractor" => {
                let pairs = [("first.", "0."), ("second.", "2."), ("third.", "4.")];
                format!("netExtractor.net{}.{}", LEVELS[number], renamed(rest, &pairs))
            }
            "decoders" => {
                let level = LEVELS[LEVELS.len() - 1 - number];
                let rest = match rest.strip_prefix("dense.") {
                    Some(rest) => {
                        let (layer, rest) = rest.split_once('.').unwrap_or((rest, ""));
                        format!("net{}.0.{rest}", LEVELS[layer.parse::<usize>().unwrap_or(0)])
                    }
                    None => renamed(
                        rest,
                        &[
                            ("upflow.", "netUpflow."),
                            ("upfeat.", "netUpfeat."),
                            ("last.", "netSix.0."),
                        ],
                    ),
                };
                format!("net{level}.{rest}")
            }
            _ => format!("netRefiner.netMain.{}.{rest}", 2 * number),
        };
        format!("pwcnet.{name}")
    }

    /// Computes the flow at a quarter of the size, in units of [`FLOW_SCALE`] pixels of the full one. Sides
    /// are multiples of 64.
    pub(super) fn forward(&self, first: Tensor<4>, second: Tensor<4>) -> Tensor<4> {
        let levels = |image: Tensor<4>| {
            let mut levels = Vec::with_capacity(LEVELS.len());
            let mut x = image;
            for features in &self.extractor {
                x = features.forward(x);
                levels.push(x.clone());
            }
            levels.reverse();
            levels
        };
        let mut before: Option<(Tensor<4>, Tensor<4>)> = None;
        for ((first, second), decoder) in
            levels(first).into_iter().zip(levels(second)).zip(&self.decoders)
        {
            before = Some(decoder.forward(first, second, before));
        }
        let (flow, mut x) = before.expect("five decoders");
        let (last, layers) = self.refiner.split_last().expect("seven layers");
        for layer in layers {
            x = leaky(layer.forward(x));
        }
        flow + last.forward(x)
    }
}

impl Features {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let x = leaky(self.first.stride2(&[x]));
        leaky(self.third.linear(&[leaky(self.second.linear(&[x]))]))
    }
}

impl Decoder {
    /// Returns flow and features, from the flow and features of the coarser level.
    fn forward(
        &self,
        first: Tensor<4>,
        second: Tensor<4>,
        before: Option<(Tensor<4>, Tensor<4>)>,
    ) -> (Tensor<4>, Tensor<4>) {
        let up = self.upflow.as_ref().zip(self.upfeat.as_ref()).zip(before);
        let mut x = match up {
            None => leaky(correlation(first, second)),
            Some(((upflow, upfeat), (flow, features))) => {
                let (flow, features) = (upflow.forward(flow), upfeat.forward(features));
                let second = warp(second, flow.clone() * self.scale);
                let similar = leaky(correlation(first.clone(), second));
                Tensor::cat(vec![similar, first, flow, features], 1)
            }
        };
        for layer in &self.dense {
            x = Tensor::cat(vec![leaky(layer.linear(&[x.clone()])), x], 1);
        }
        (self.last.linear(&[x.clone()]), x)
    }
}

impl Dilated {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let apart = [self.apart, self.apart];
        let options = ConvOptions::new([1, 1], apart, apart, 1);
        conv2d(x, self.weight.val(), Some(self.bias.val()), options)
    }
}

/// Computes means over channels of the products of `first` and of `second` up to four cells away, zeros
/// outside: row by row.
///
/// # Shapes
/// - first, second: `[images, channels, height, width]`
/// - result: `[images, 81, height, width]`
pub fn correlation(first: Tensor<4>, second: Tensor<4>) -> Tensor<4> {
    let [_, _, height, width] = first.dims();
    let around = (RADIUS, RADIUS);
    let padded = second.pad([(0, 0), (0, 0), around, around], PadMode::Constant(0.0));
    let side = 2 * RADIUS + 1;
    let place = |place: usize| {
        let there = padded.clone().narrow(2, place / side, height).narrow(3, place % side, width);
        (first.clone() * there).mean_dim(1)
    };
    Tensor::cat((0..PLACES).map(place).collect(), 1)
}

/// Warps as the network was trained: places of pixels and flow differ in convention, so that flow counts
/// `N / (N - 1)` of itself on a side of `N` pixels; zero where any part comes from outside.
fn warp(x: Tensor<4>, flow: Tensor<4>) -> Tensor<4> {
    const MIN_WEIGHT: f32 = 0.999;
    let [_, _, height, width] = x.dims();
    let factor = |side: usize| side as f32 / (side - 1) as f32;
    let flow = flow * same_flow([factor(width), factor(height)], &x.device());
    let ones = x.clone().narrow(1, 0, 1).ones_like();
    let inside = warp_zeros(ones, flow.clone()).greater_elem(MIN_WEIGHT).float();
    warp_zeros(x, flow) * inside
}
