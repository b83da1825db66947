//! Restoring with the learned methods: every frame of a window, tile by tile.

mod brightness;
mod window;

use crate::import::{Loaded, load};
use crate::method::{Method, Network, Sizes};
use burn::tensor::{Device, Tensor};
use qudi_core::progress::progress;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::{Error, Result, Size};
use qudi_layers::tensor::to_tensor;
use qudi_layers::{TILE, Tiling};
use std::path::Path;

pub use brightness::ExpectedCounts;
pub(crate) use window::{Window, copies};

/// The side of the smallest tiles, in pixels: a multiple of what every network needs.
pub const SMALLEST_TILE: usize = 64;

/// A learned method with weights, as its authors used it, from counts over full scale to images. Authors'
/// weights return images for the light level of their training, which are not scaled to the level of the
/// acquisition. Weights that were trained here return images in units of counts, which the acquisition
/// converts.
#[derive(Debug)]
pub struct LearnedRestorer {
    network: Network,
    sizes: Sizes,
    brightness: Brightness,
    tile: usize,
    device: Device,
}

/// Units of the images that a network returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Brightness {
    /// Image values at the light level that its authors trained it for.
    OfAuthors,
    /// Counts over full scale.
    OfCounts,
}

impl LearnedRestorer {
    /// Loads the weights of a method onto `device`.
    ///
    /// # Errors
    /// [`Error`] if the file does not hold them.
    pub fn load(path: &Path, method: Method, device: &Device) -> Result<Self> {
        Ok(Self::of(load(path, method, device)?, device))
    }

    /// Makes the restorer of a loaded network, on the device that it was loaded onto.
    pub fn of(loaded: Loaded, device: &Device) -> Self {
        let Loaded { network, sizes, description } = loaded;
        let of_authors = description.is_none();
        let brightness = if of_authors { Brightness::OfAuthors } else { Brightness::OfCounts };
        Self::new(network, sizes, brightness, device)
    }

    /// Makes the restorer of a network of these sizes on `device`.
    pub fn new(network: Network, sizes: Sizes, brightness: Brightness, device: &Device) -> Self {
        Self { network, sizes, brightness, tile: TILE, device: device.clone() }
    }

    /// Restores in tiles of `tile` pixels instead of [`TILE`]: memory grows with their square.
    ///
    /// # Errors
    /// [`Error`] if they are smaller than [`SMALLEST_TILE`].
    pub fn with_tile(self, tile: usize) -> Result<Self> {
        if tile < SMALLEST_TILE {
            let what = format!("tiles of {tile} pixels");
            let help = format!("{} needs at least {SMALLEST_TILE}", self.method().name());
            return Err(Error::request(what, "tile", help));
        }
        Ok(Self { tile, ..self })
    }

    /// Returns the bytes that restoring tiles of `size` takes on the processor, at most, about.
    pub fn memory(&self, size: Size) -> u64 {
        self.sizes.memory(size)
    }

    fn method(&self) -> Method {
        self.sizes.method()
    }
}

impl Restorer for LearnedRestorer {
    fn name(&self) -> &'static str {
        self.method().name()
    }

    fn window(&self) -> usize {
        self.sizes.frames_at_once() + self.context().iter().sum::<usize>()
    }

    fn context(&self) -> [usize; 2] {
        self.network.context()
    }

    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        requested: &[usize],
    ) -> Result<Restored> {
        let (Some(&first), Some(&last)) = (requested.iter().min(), requested.iter().max()) else {
            return Ok(Restored::gray(Vec::new(), None));
        };
        progress(self.method().name(), 0, burst.frames.len())?;
        let tiling = Tiling::new(burst.size, self.sizes.multiple(), self.tile);
        let full = f32::from(acquisition.sensor.max_count());
        let plane = |counts: &Vec<u16>| {
            let values: Vec<f32> = counts.iter().map(|&count| f32::from(count) / full).collect();
            tiling.padded(&values)
        };
        let planes: Vec<Vec<f32>> = burst.frames.iter().map(plane).collect();
        let mut frames = tiling.joined(|tile| {
            let part = |plane: &Vec<f32>| {
                to_tensor(tiling.tiles.crop(tile, plane), tiling.tiles.tile, &self.device)
            };
            let frames: Vec<Tensor<4>> = planes.iter().map(part).collect();
            let name = self.method().name();
            let window = Window { name, all: &frames, requested: first..last + 1 };
            let images = self.network.restore(window)?;
            Ok(requested.iter().map(|number| images[number - first].clone()).collect())
        })?;
        let expected = match self.brightness {
            Brightness::OfAuthors => None,
            Brightness::OfCounts => Some(ExpectedCounts::of(acquisition)),
        };
        for value in frames.iter_mut().flat_map(|frame| &mut frame.data) {
            let image = expected.map_or(*value, |expected| expected.image(*value));
            *value = image.clamp(0.0, 1.0);
        }
        Ok(Restored::gray(frames, None))
    }
}
