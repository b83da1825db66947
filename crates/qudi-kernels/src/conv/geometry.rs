//! Sizes of a convolution.

/// Sizes of a convolution over frames folded into the batch, with zero padding of half the kernel on every
/// side.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Geometry {
    /// Number of images: bursts times frames.
    pub images: usize,
    /// Frames per burst; the temporal kernel does not cross bursts.
    pub frames: usize,
    /// Channels of each input; the inputs are joined in this order.
    pub channels: Vec<usize>,
    /// Height of the inputs.
    pub height: usize,
    /// Width of the inputs.
    pub width: usize,
    /// Number of output channels.
    pub outputs: usize,
    /// Kernel size in frames, rows and columns; all odd.
    pub kernel: [usize; 3],
    /// Stride of the output in rows and columns: 1 or 2.
    pub stride: usize,
    /// True if a tensor of the output's shape is added.
    pub addend: bool,
    /// True if a ReLU follows.
    pub relu: bool,
    /// True if products use bfloat16; sums and all other operations have 32 bits.
    pub bf16: bool,
}

impl Geometry {
    /// Returns the number of channels of all inputs together.
    pub fn all_channels(&self) -> usize {
        self.channels.iter().sum()
    }

    /// Returns the rows and columns of the output.
    pub fn output_grid(&self) -> [usize; 2] {
        [self.height.div_ceil(self.stride), self.width.div_ceil(self.stride)]
    }

    /// Returns the number of kernel values per pair of input and output channel.
    pub fn taps(&self) -> usize {
        self.all_channels() * self.kernel.iter().product::<usize>()
    }

    /// Returns the number of multiplications of the convolution.
    pub fn multiplications(&self) -> usize {
        let [rows, columns] = self.output_grid();
        self.images * self.outputs * self.taps() * rows * columns
    }
}
