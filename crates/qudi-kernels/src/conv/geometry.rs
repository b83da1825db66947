//! The sizes of one convolution.

/// A convolution over frames folded into the batch, zero padding of half the kernel on every side.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Geometry {
    /// Images: bursts times frames.
    pub images: usize,
    /// Frames of one burst; the temporal kernel does not reach past them.
    pub frames: usize,
    /// Channels of each input; the inputs are joined in this order.
    pub channels: Vec<usize>,
    /// Grid of the inputs.
    pub height: usize,
    /// Grid of the inputs.
    pub width: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// Kernel: frames, rows, columns; all odd.
    pub kernel: [usize; 3],
    /// Step of the output grid in rows and columns: 1 or 2.
    pub stride: usize,
    /// Whether a tensor of the output's shape is added.
    pub addend: bool,
    /// Whether negative results become zero.
    pub relu: bool,
    /// Whether products take bfloat16; sums and all besides have 32 bits.
    pub bf16: bool,
}

impl Geometry {
    /// Channels of all inputs.
    pub fn all_channels(&self) -> usize {
        self.channels.iter().sum()
    }

    /// Rows and columns of the output.
    pub fn output_grid(&self) -> [usize; 2] {
        [self.height.div_ceil(self.stride), self.width.div_ceil(self.stride)]
    }

    /// Values of one output channel's kernel.
    pub fn taps(&self) -> usize {
        self.all_channels() * self.kernel.iter().product::<usize>()
    }

    /// Multiplications of the whole convolution.
    pub fn multiplications(&self) -> usize {
        let [rows, columns] = self.output_grid();
        self.images * self.outputs * self.taps() * rows * columns
    }
}
