//! What a step costs, from the sizes alone.

use crate::config::NetworkConfig;
use crate::network::parameter_shapes;
use burn::tensor::Device;
use qudi_core::Size;

impl NetworkConfig {
    /// Number of parameters.
    pub fn parameters(&self, device: &Device) -> usize {
        let list = parameter_shapes(&self.uninitialized(device));
        list.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum()
    }

    /// Bytes that restoring a window of `frames` frames of `size` takes on the processor at most, about:
    /// activations of the finest level, `PLANES` times its widths at once. Just what `small` took at 256 x
    /// 256 where it was measured, half as much again at 512 x 512.
    pub fn memory(&self, size: Size, frames: usize) -> u64 {
        const PLANES: f64 = 6.5;
        let widths = self.unet.width + self.fusion.widths[0] + self.pre.width;
        let cells = (size.pixels() * frames) as f64 / (self.fold * self.fold) as f64;
        // What the program holds besides, planes of the whole window among it.
        let others = 50.0 * (1 << 20) as f64 + 80.0 * (size.pixels() * frames) as f64;
        (4.0 * PLANES * widths as f64 * cells + others) as u64
    }
}
