//! The classification networks that LPIPS looks through, up to their last used layer, as torchvision builds
//! them.

use super::convolution::Convolution;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;

/// A layer by its sizes. Names of weights are those of torchvision's `features`.
#[derive(Clone, Copy, Debug)]
pub(super) enum Layer {
    /// A convolution and a ReLU.
    Convolution { index: usize, outputs: usize, kernel: usize, stride: usize, padding: usize },
    /// SqueezeNet's: 1x1 to `squeezed` channels, from there 1x1 and 3x3 to `expanded` each, joined.
    Fire { index: usize, squeezed: usize, expanded: usize },
    /// Maximum of squares of this side, every second pixel.
    Pool { side: usize, border: Border },
    /// What came before is compared.
    Tap,
}

/// What pooling does with a last square that is cut off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Border {
    Drop,
    Keep,
}

const fn plain(index: usize, outputs: usize) -> Layer {
    Layer::Convolution { index, outputs, kernel: 3, stride: 1, padding: 1 }
}

const fn fire(index: usize, squeezed: usize, expanded: usize) -> Layer {
    Layer::Fire { index, squeezed, expanded }
}

const fn pool(side: usize, border: Border) -> Layer {
    Layer::Pool { side, border }
}

/// VGG16 (Simonyan and Zisserman 2015), configuration D.
pub(super) const VGG: &[Layer] = &[
    plain(0, 64),
    plain(2, 64),
    Layer::Tap,
    pool(2, Border::Drop),
    plain(5, 128),
    plain(7, 128),
    Layer::Tap,
    pool(2, Border::Drop),
    plain(10, 256),
    plain(12, 256),
    plain(14, 256),
    Layer::Tap,
    pool(2, Border::Drop),
    plain(17, 512),
    plain(19, 512),
    plain(21, 512),
    Layer::Tap,
    pool(2, Border::Drop),
    plain(24, 512),
    plain(26, 512),
    plain(28, 512),
    Layer::Tap,
];

/// AlexNet in one column (Krizhevsky 2014).
pub(super) const ALEX: &[Layer] = &[
    Layer::Convolution { index: 0, outputs: 64, kernel: 11, stride: 4, padding: 2 },
    Layer::Tap,
    pool(3, Border::Drop),
    Layer::Convolution { index: 3, outputs: 192, kernel: 5, stride: 1, padding: 2 },
    Layer::Tap,
    pool(3, Border::Drop),
    plain(6, 384),
    Layer::Tap,
    plain(8, 256),
    Layer::Tap,
    plain(10, 256),
    Layer::Tap,
];

/// SqueezeNet 1.1 (Iandola et al. 2016).
pub(super) const SQUEEZE: &[Layer] = &[
    Layer::Convolution { index: 0, outputs: 64, kernel: 3, stride: 2, padding: 0 },
    Layer::Tap,
    pool(3, Border::Keep),
    fire(3, 16, 64),
    fire(4, 16, 64),
    Layer::Tap,
    pool(3, Border::Keep),
    fire(6, 32, 128),
    fire(7, 32, 128),
    Layer::Tap,
    pool(3, Border::Keep),
    fire(9, 48, 192),
    Layer::Tap,
    fire(10, 48, 192),
    Layer::Tap,
    fire(11, 64, 256),
    Layer::Tap,
    fire(12, 64, 256),
    Layer::Tap,
];

/// Gives the values of a weight of this name and shape.
pub(super) type Weights<'a> = dyn FnMut(&str, &[usize]) -> Result<Vec<f32>> + 'a;

/// A backbone with its weights.
#[derive(Clone, Debug)]
pub(super) struct Backbone {
    steps: Vec<Step>,
    /// Channels of every tap.
    pub(super) taps: Vec<usize>,
}

#[derive(Clone, Debug)]
enum Step {
    Convolution(Box<Convolution>),
    Fire(Box<[Convolution; 3]>),
    Pool(MaxPoolOptions<2>),
    Tap,
}

impl Backbone {
    /// Reads the weights of `layers` onto `device`.
    ///
    /// # Errors
    /// Those of `weights`.
    pub(super) fn new(
        layers: &[Layer],
        weights: &mut Weights<'_>,
        device: &Device,
    ) -> Result<Self> {
        let (mut channels, mut steps, mut taps) = (3, Vec::new(), Vec::new());
        for &layer in layers {
            steps.push(match layer {
                Layer::Convolution { index, outputs, kernel, stride, padding } => {
                    let name = format!("features.{index}");
                    let shape = [outputs, channels, kernel, kernel];
                    let mut weight = weights(&format!("{name}.weight"), &shape)?;
                    let bias = weights(&format!("{name}.bias"), &[outputs])?;
                    let mut inputs = channels;
                    if steps.is_empty() {
                        weight = super::gray::fold(&weight, kernel * kernel);
                        inputs = super::gray::PLANES;
                    }
                    channels = outputs;
                    let sizes = [outputs, inputs, kernel];
                    Step::Convolution(Box::new(if stride == 1 {
                        Convolution::new(weight, bias, sizes, device)
                    } else {
                        Convolution::strided(&weight, bias, sizes, [stride, padding], device)
                    }))
                }
                Layer::Fire { index, squeezed, expanded } => {
                    let mut part = |name: &str, [outputs, inputs, kernel]: [usize; 3]| {
                        let name = format!("features.{index}.{name}");
                        let shape = [outputs, inputs, kernel, kernel];
                        let weight = weights(&format!("{name}.weight"), &shape)?;
                        let bias = weights(&format!("{name}.bias"), &[outputs])?;
                        Ok(Convolution::new(weight, bias, [outputs, inputs, kernel], device))
                    };
                    let parts = [
                        part("squeeze", [squeezed, channels, 1])?,
                        part("expand1x1", [expanded, squeezed, 1])?,
                        part("expand3x3", [expanded, squeezed, 3])?,
                    ];
                    channels = 2 * expanded;
                    Step::Fire(Box::new(parts))
                }
                Layer::Pool { side, border } => {
                    let options = MaxPoolOptions::new([side, side]).with_stride([2, 2]);
                    Step::Pool(options.with_ceil_mode(border == Border::Keep))
                }
                Layer::Tap => {
                    taps.push(channels);
                    Step::Tap
                }
            });
        }
        Ok(Self { steps, taps })
    }

    /// The features at every tap, `[images, channels, height, width]` each, of the planes that
    /// [`super::gray::planes`] gives.
    pub(super) fn forward(&self, planes: Tensor<4>) -> Vec<Tensor<4>> {
        let (mut x, mut taps) = (planes, Vec::with_capacity(self.taps.len()));
        for step in &self.steps {
            x = match step {
                Step::Convolution(convolution) => convolution.forward(x),
                Step::Fire(parts) => {
                    let [squeeze, narrow, wide] = &**parts;
                    let squeezed = squeeze.forward(x);
                    Tensor::cat(vec![narrow.forward(squeezed.clone()), wide.forward(squeezed)], 1)
                }
                Step::Pool(options) => max_pool2d(x, options.clone()),
                Step::Tap => {
                    taps.push(x.clone());
                    x
                }
            };
        }
        taps
    }
}
