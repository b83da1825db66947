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

    /// Multiplications of all convolutions in one reverse step that estimates the flow, over `frames` frames
    /// of `size`; nothing is computed on `device`. Norms, attention scores and the embedding, a few
    /// hundredths of it, are left out.
    pub fn multiplications(&self, size: Size, frames: usize, device: &Device) -> usize {
        let pixels = size.pixels() as f64;
        let mut sum = 0.0;
        // Names and shapes only: no weights are made.
        for (name, shape) in parameter_shapes(&self.uninitialized(device)) {
            if shape.len() < 4 {
                continue;
            }
            let (scale, times) = self.place(&name, frames);
            let weights = shape.iter().product::<usize>() as f64;
            sum += weights * pixels / (scale * scale) as f64 * times;
        }
        sum as usize
    }

    /// Pixels of a side of the cells that a layer computes, and how often it runs over them.
    fn place(&self, name: &str, frames: usize) -> (usize, f64) {
        let parts: Vec<&str> = name.split('.').collect();
        let frames = frames as f64;
        let number =
            |at: usize| parts.get(at).and_then(|part| part.parse::<usize>().ok()).unwrap_or(0);
        let last = self.unet.multipliers.len() - 1;
        let level = match (parts[0], parts[1]) {
            ("flow", _) => {
                let level = self.flow.levels - self.flow.networks + number(2);
                return (self.flow.scale << level, 2.0 * (frames - 1.0));
            }
            ("low" | "high", "half") => 1,
            ("low" | "high", "quarter") => 2,
            ("fusion", "cell") => self.fusion.level,
            ("fusion", _) | ("unet", "merge" | "encoder" | "decoder" | "up") => number(2),
            ("unet", "down") => number(2) + 1,
            ("unet", "middle") => last,
            _ => 0,
        };
        let both_ways = parts[0] == "fusion" && parts[1] == "cell" && parts[2] != "leave";
        (self.fold << level, if both_ways { 2.0 * frames } else { frames })
    }
}
