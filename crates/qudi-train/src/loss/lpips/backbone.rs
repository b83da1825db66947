//! The image classifiers whose features LPIPS compares, up to the last layer that it uses, as torchvision
//! builds them.

use super::convolution::Convolution;
use super::input::Images;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor};
use qudi_core::Result;

/// A classifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Net {
    Vgg,
    Alex,
}

impl Net {
    pub(super) fn layers(self) -> &'static [Layer] {
        match self {
            Self::Vgg => VGG,
            Self::Alex => ALEX,
        }
    }

    /// Returns the shortest side of an image that reaches the last layer, in pixels.
    pub(super) fn smallest_side(self) -> usize {
        match self {
            Self::Vgg => 16,
            Self::Alex => 31,
        }
    }
}

/// A layer by its sizes. Weights have the names of torchvision's `features`.
#[derive(Clone, Copy, Debug)]
pub(super) enum Layer {
    /// A convolution and a ReLU.
    Convolution { index: usize, outputs: usize, kernel: usize, stride: usize, padding: usize },
    /// The maximum over squares of `side` pixels, at every second pixel; squares that are cut off are
    /// dropped.
    Pool { side: usize },
    /// A tap: the output of the layer before is compared.
    Tap,
}

const fn plain(index: usize, outputs: usize) -> Layer {
    Layer::Convolution { index, outputs, kernel: 3, stride: 1, padding: 1 }
}

const fn pool(side: usize) -> Layer {
    Layer::Pool { side }
}

/// VGG16 (Simonyan and Zisserman 2015), configuration D.
const VGG: &[Layer] = &[
    plain(0, 64),
    plain(2, 64),
    Layer::Tap,
    pool(2),
    plain(5, 128),
    plain(7, 128),
    Layer::Tap,
    pool(2),
    plain(10, 256),
    plain(12, 256),
    plain(14, 256),
    Layer::Tap,
    pool(2),
    plain(17, 512),
    plain(19, 512),
    plain(21, 512),
    Layer::Tap,
    pool(2),
    plain(24, 512),
    plain(26, 512),
    plain(28, 512),
    Layer::Tap,
];

/// AlexNet in one column (Krizhevsky 2014).
const ALEX: &[Layer] = &[
    Layer::Convolution { index: 0, outputs: 64, kernel: 11, stride: 4, padding: 2 },
    Layer::Tap,
    pool(3),
    Layer::Convolution { index: 3, outputs: 192, kernel: 5, stride: 1, padding: 2 },
    Layer::Tap,
    pool(3),
    plain(6, 384),
    Layer::Tap,
    plain(8, 256),
    Layer::Tap,
    plain(10, 256),
    Layer::Tap,
];

/// Gives the values of the weight of a name and a shape.
pub(super) type Weights<'a> = dyn FnMut(&str, &[usize]) -> Result<Vec<f32>> + 'a;

/// A backbone with its weights.
#[derive(Clone, Debug)]
pub(super) struct Backbone {
    steps: Vec<Step>,
    /// The number of channels of every tap.
    pub(super) taps: Vec<usize>,
}

#[derive(Clone, Debug)]
enum Step {
    Convolution(Box<Convolution>),
    Pool(MaxPoolOptions<2>),
    Tap,
}

impl Backbone {
    /// Reads the weights of `layers` onto `device`, for images of a kind.
    ///
    /// # Errors
    /// Those of `weights`.
    pub(super) fn new(
        layers: &[Layer],
        images: Images,
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
                        weight = images.fold(&weight, kernel * kernel);
                        inputs = images.planes();
                    }
                    channels = outputs;
                    let sizes = [outputs, inputs, kernel];
                    Step::Convolution(Box::new(if stride == 1 {
                        Convolution::new(weight, bias, sizes, device)
                    } else {
                        Convolution::strided(&weight, bias, sizes, [stride, padding], device)
                    }))
                }
                Layer::Pool { side } => {
                    Step::Pool(MaxPoolOptions::new([side, side]).with_stride([2, 2]))
                }
                Layer::Tap => {
                    taps.push(channels);
                    Step::Tap
                }
            });
        }
        Ok(Self { steps, taps })
    }

    /// Computes the features at every tap.
    ///
    /// # Shapes
    /// - planes: `[images, planes, height, width]`, as [`super::input::with_ones`] gives them
    /// - output: `[images, channels, rows, columns]` per tap
    pub(super) fn forward(&self, planes: Tensor<4>) -> Vec<Tensor<4>> {
        let (mut x, mut taps) = (planes, Vec::with_capacity(self.taps.len()));
        for step in &self.steps {
            x = match step {
                Step::Convolution(convolution) => convolution.forward(x),
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
