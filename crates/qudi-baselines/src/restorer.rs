//! The learned methods as restorers of video: every frame of a window, tile by tile.

mod brightness;

use crate::flornn::FloRnn;
use crate::import::{Loaded, Method, Network, load};
use crate::sizes::Sizes;
use crate::spk2imgnet::{Block, Spk2ImgNet};
use crate::{memdeblur, rvrt, spk2imgnet};
use burn::tensor::{Device, Tensor};
use qudi_core::progress::progress;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::{Error, Result, Size};
use qudi_layers::tensor::to_tensor;
use qudi_layers::{TILE, Tiling, mirrored};
use std::collections::VecDeque;
use std::ops::Range;
use std::path::Path;

pub use brightness::ExpectedCounts;

/// Frames that are restored at once, and of EMVD, whose recurrence starts anew with every window.
const FRAMES: usize = 11;
const MANY_FRAMES: usize = 64;

/// The side of the smallest tiles, in pixels: a multiple of what every network needs.
pub const SMALLEST_TILE: usize = 64;

/// Frames before the first one that EMVD goes on from: its protocol scores the last of eleven.
const HISTORY: usize = 10;

/// A learned method with weights, as its authors used it: counts over full scale in, images out. Weights of authors
/// know the brightness of their own light, and the image is not scaled to that of this acquisition. Weights that were
/// trained here give images in the units of counts, and the acquisition says what these are.
#[derive(Debug)]
pub struct LearnedRestorer {
    network: Network,
    sizes: Sizes,
    brightness: Brightness,
    tile: usize,
    device: Device,
}

/// The units of the images that a network gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Brightness {
    /// Those of images at the light that its authors trained it for.
    OfAuthors,
    /// Those of counts over full scale.
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

    /// The restorer of a loaded network, on the device that it was loaded onto.
    pub fn of(loaded: Loaded, device: &Device) -> Self {
        let Loaded { network, sizes, description } = loaded;
        let of_authors = description.is_none();
        let brightness = if of_authors { Brightness::OfAuthors } else { Brightness::OfCounts };
        Self::new(network, sizes, brightness, device)
    }

    /// The restorer of a network of these sizes on `device`.
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

    /// Bytes that restoring tiles of `size` takes on the processor at most, about.
    pub fn memory(&self, size: Size) -> u64 {
        self.sizes.memory(size)
    }

    fn method(&self) -> Method {
        self.sizes.method()
    }

    /// The frames before and after a frame that the network sees to restore it; none of networks that see all
    /// frames.
    fn reach(&self) -> [usize; 2] {
        match &self.network {
            Network::Quiver(network) => network.reach().into(),
            Network::Emvd(_) => [HISTORY, 0],
            Network::FloRnn(network) => [1, network.window() - 2],
            Network::Spk2ImgNet(_) => {
                [spk2imgnet::RESTORED, spk2imgnet::FRAMES - 1 - spk2imgnet::RESTORED]
            }
            Network::MemDeblur(_) | Network::Rvrt(_) => [0, 0],
            Network::StudentTeacher(network) => {
                let length = network.frames();
                [length / 2, length - 1 - length / 2]
            }
        }
    }

    /// Restores the frames `numbers` of all `frames` of a window, `[1, 1, height, width]` each.
    fn images(&self, frames: &[Tensor<4>], numbers: Range<usize>) -> Result<Vec<Tensor<4>>> {
        let count = numbers.len();
        let [before, after] = self.reach();
        // These frames and those around them, mirrored at the first and the last frame of all.
        let around: Vec<Tensor<4>> = (0..before + count + after)
            .map(|i| (numbers.start + i) as i64 - before as i64)
            .map(|place| frames[mirrored(place, frames.len())].clone())
            .collect();
        let copies = |frames: Vec<Tensor<4>>, channels: usize| {
            Tensor::cat(frames, 0).repeat(&[1, channels, 1, 1])
        };
        // Copies of one picture are averaged.
        let split = |images: Tensor<4>, first: usize| {
            let images = images.mean_dim(1);
            (0..count).map(|i| images.clone().narrow(0, first + i, 1)).collect::<Vec<_>>()
        };
        Ok(match &self.network {
            Network::Quiver(network) => {
                let frames = around.len();
                split(network.forward(Tensor::cat(around, 0), frames).full, 0)
            }
            Network::Emvd(network) => network.restore(around).into_iter().skip(before).collect(),
            Network::FloRnn(network) => self.second_frames(network, &around)?,
            Network::Spk2ImgNet(network) => self.by_blocks(network, &around)?,
            Network::MemDeblur(network) => {
                let images = copies(frames.to_vec(), network.channels());
                let [_, _, full] = network.forward(&images, frames.len(), memdeblur::Mode::Use);
                split(full, numbers.start)
            }
            Network::Rvrt(network) => {
                // An even number of frames.
                let even = frames.len().next_multiple_of(rvrt::CLIP) as i64;
                let all = (0..even).map(|place| frames[mirrored(place, frames.len())].clone());
                let all: Vec<_> = all.collect();
                let count = all.len();
                split(network.forward(copies(all, network.channels()), count), numbers.start)
            }
            Network::StudentTeacher(network) => {
                self.sliding(&around, network.frames(), |window| network.forward(window).image)?
            }
        })
    }

    /// One image of every window of frames; every block of frames is looked at once.
    fn by_blocks(&self, network: &Spk2ImgNet, frames: &[Tensor<4>]) -> Result<Vec<Tensor<4>>> {
        let total = frames.len() - spk2imgnet::FRAMES + 1;
        let mut blocks: VecDeque<Block> = VecDeque::new();
        let mut images = Vec::with_capacity(total);
        for first in 0..total {
            progress(self.method().name(), first, total)?;
            while first + blocks.len() < (first + spk2imgnet::FRAMES - 1).min(frames.len() - 1) {
                let start = first + blocks.len();
                let pair = frames[start..start + spk2imgnet::BLOCK].to_vec();
                blocks.push_back(network.block(Tensor::cat(pair, 1)));
            }
            let window: [&Block; spk2imgnet::BLOCKS] =
                std::array::from_fn(|number| &blocks[number * spk2imgnet::BLOCK]);
            images.push(network.image(window) / spk2imgnet::SCALE);
            blocks.pop_front();
        }
        Ok(images)
    }

    /// The second frame of every window of frames; the flow from a frame to the next is found once.
    fn second_frames(&self, network: &FloRnn, frames: &[Tensor<4>]) -> Result<Vec<Tensor<4>>> {
        let copies = |frame: &Tensor<4>| frame.clone().repeat(&[1, network.channels(), 1, 1]);
        let frames: Vec<_> = frames.iter().map(copies).collect();
        let windows = frames.windows(network.window());
        let total = windows.len();
        let mut flows = Vec::new();
        let mut images = Vec::with_capacity(total);
        for (done, window) in windows.enumerate() {
            progress(self.method().name(), done, total)?;
            flows.extend(network.flows(&window[flows.len()..]));
            images.push(network.forward(window, &flows).mean_dim(1));
            flows.drain(..flows.len().min(1));
        }
        Ok(images)
    }

    /// One image of every window of frames, which are the channels of one input.
    fn sliding(
        &self,
        frames: &[Tensor<4>],
        length: usize,
        restore: impl Fn(Tensor<4>) -> Tensor<4>,
    ) -> Result<Vec<Tensor<4>>> {
        let windows = frames.windows(length);
        let total = windows.len();
        let mut images = Vec::with_capacity(total);
        for (done, window) in windows.enumerate() {
            progress(self.method().name(), done, total)?;
            images.push(restore(Tensor::cat(window.to_vec(), 1)));
        }
        Ok(images)
    }
}

impl Restorer for LearnedRestorer {
    fn name(&self) -> &'static str {
        self.method().name()
    }

    fn window(&self) -> usize {
        let frames = if self.method() == Method::Emvd { MANY_FRAMES } else { FRAMES };
        frames + self.context().iter().sum::<usize>()
    }

    fn context(&self) -> [usize; 2] {
        self.reach()
    }

    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored> {
        let (Some(&first), Some(&last)) = (numbers.iter().min(), numbers.iter().max()) else {
            return Ok(Restored { frames: Vec::new(), std: None });
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
            let images = self.images(&frames, first..last + 1)?;
            Ok(numbers.iter().map(|number| images[number - first].clone()).collect())
        })?;
        let expected = match self.brightness {
            Brightness::OfAuthors => None,
            Brightness::OfCounts => Some(ExpectedCounts::of(acquisition)),
        };
        for value in frames.iter_mut().flat_map(|frame| &mut frame.data) {
            let image = expected.map_or(*value, |expected| expected.image(*value));
            *value = image.clamp(0.0, 1.0);
        }
        Ok(Restored { frames, std: None })
    }
}
