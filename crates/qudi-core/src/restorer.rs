//! The interface of every method: windows of a burst in, restored frames out.

use crate::error::Result;
use crate::frame::{Frame, Size};
use crate::sensor::{DarkRate, Response, Sensor};

/// Counts of consecutive frames, `[frames][height][width]`.
#[derive(Clone, Copy, Debug)]
pub struct BurstView<'a> {
    /// The size of every frame.
    pub size: Size,
    /// The counts of each frame, row by row.
    pub frames: &'a [Vec<u16>],
}

/// The acquisition of a burst: what a method knows besides the counts.
#[derive(Clone, Debug)]
pub struct Acquisition {
    /// The seed of random draws.
    pub seed: u64,
    /// The number of the window's first frame in the capture.
    pub first_frame: u64,
    /// Incident photons per pixel and frame, where the image is `mean_level`.
    pub ppp: f64,
    /// Image value that receives `ppp` photons.
    pub mean_level: f64,
    /// The sensor of these frames, `frames_summed` included.
    pub sensor: Sensor,
    /// The gain in DN/e-.
    pub gain: f64,
    /// Dark electrons per frame of every pixel, where a map is known.
    pub dark: Option<Vec<f32>>,
    /// DN of every count that are pedestal, which the sensor's dark rate includes.
    pub pedestal: f64,
}

/// The restored frames of a window.
#[derive(Clone, Debug)]
pub struct Restored {
    /// The restored frames, one per frame of the window, in image units.
    pub frames: Vec<Frame>,
    /// The standard deviation (sigma) of each pixel's error, where the method predicts it.
    pub std: Option<Vec<Frame>>,
    /// Red, green and blue of each frame, of captures behind a colour filter; `frames` are their luma.
    pub colour: Option<Vec<[Frame; 3]>>,
    /// The standard deviations of `colour`, where the method predicts the errors of luma.
    pub colour_std: Option<Vec<[Frame; 3]>>,
}

/// A method: turns all frames of a window into images at once.
pub trait Restorer {
    /// Returns the name in tables and on the command line.
    fn name(&self) -> &'static str;

    /// Returns the number of frames that are restored together; shorter captures are one shorter window.
    fn window(&self) -> usize;

    /// Returns the numbers of frames at the beginning and at the end of a window that are used but not
    /// restored, unless the capture begins or ends there.
    fn context(&self) -> [usize; 2] {
        [0, 0]
    }

    /// Restores the frames `numbers` of `burst`, in that order. A frame does not depend on which others are
    /// restored. Methods that restore all frames at once select them with [`Restored::only`].
    ///
    /// # Errors
    /// [`Error`](crate::Error) if the method cannot work with this burst.
    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored>;

    /// Restores every frame of `burst`.
    ///
    /// # Errors
    /// As [`Self::restore_frames`].
    fn restore(&mut self, burst: BurstView<'_>, acquisition: &Acquisition) -> Result<Restored> {
        let all: Vec<usize> = (0..burst.frames.len()).collect();
        self.restore_frames(burst, acquisition, &all)
    }
}

impl Restored {
    /// Creates gray frames, with the standard deviations that the method predicts.
    pub fn gray(frames: Vec<Frame>, std: Option<Vec<Frame>>) -> Self {
        Self { frames, std, colour: None, colour_std: None }
    }

    /// Selects the frames `numbers` of a window that was restored whole, in that order.
    ///
    /// # Panics
    /// If the window has no such frame.
    #[must_use]
    pub fn only(self, numbers: &[usize]) -> Self {
        if numbers.iter().copied().eq(0..self.frames.len()) {
            return self;
        }
        let select = |frames: Vec<Frame>| numbers.iter().map(|&n| frames[n].clone()).collect();
        let of_colours =
            |colour: Vec<[Frame; 3]>| numbers.iter().map(|&n| colour[n].clone()).collect();
        Self {
            frames: select(self.frames),
            std: self.std.map(select),
            colour: self.colour.map(of_colours),
            colour_std: self.colour_std.map(of_colours),
        }
    }
}

impl Acquisition {
    /// Creates the acquisition of a capture by `sensor`, with the sensor's own gain at `ppp` incident photons
    /// per pixel and frame and an image of mean level `mean_level`; seed 0, first frame 0, no dark map. The
    /// sensor's pedestal is counted as dark electrons.
    ///
    /// # Errors
    /// [`Error`](crate::Error) if the sensor has no gain at this light.
    pub fn new(mut sensor: Sensor, ppp: f64, mean_level: f64) -> Result<Self> {
        let gain = sensor.gain_at(ppp)?;
        let (seed, first_frame, dark, pedestal) = (0, 0, None, 0.0);
        let offset = match sensor.response {
            Response::Linear => std::mem::take(&mut sensor.offset),
            Response::Binary => 0.0,
        };
        Self { seed, first_frame, ppp, mean_level, sensor, gain, dark, pedestal }
            .with_pedestal(offset)
    }

    /// Counts the cross-talk and the afterpulses of the sensor as light, as many as there are at the mean
    /// light.
    ///
    /// # Errors
    /// [`Error`](crate::Error) if the sensor's dark rate is unknown.
    pub fn without_echoes(mut self) -> Result<Self> {
        let summed = f64::from(self.sensor.frames_summed);
        let dark = self.sensor.dark_per_frame()?;
        let detections = (self.sensor.quantum_efficiency * self.ppp + dark) / summed;
        let factor = self.sensor.echo_factor(detections);
        if factor != 1.0 {
            self.sensor = self.sensor.without_echoes(detections);
            self.dark = self.dark.map(|map| map.iter().map(|v| v * factor as f32).collect());
        }
        Ok(self)
    }

    /// Counts a pedestal of `dn` per count as dark electrons, which all methods subtract, in place of as much
    /// of the read noise.
    ///
    /// # Errors
    /// [`Error`](crate::Error) if the sensor's dark rate is unknown.
    pub fn with_pedestal(mut self, dn: f64) -> Result<Self> {
        if dn > 0.0 {
            let electrons = dn / self.gain;
            self.sensor.dark = DarkRate::PerFrame(self.sensor.dark_per_frame()? + electrons);
            let noise = self.sensor.read_noise.powi(2) - electrons;
            self.sensor.read_noise = noise.max(0.0).sqrt();
            self.dark = self.dark.map(|map| map.iter().map(|v| v + electrons as f32).collect());
            self.pedestal = dn;
        }
        Ok(self)
    }

    /// Sets the seed of random draws.
    #[must_use]
    pub fn with_seed(self, seed: u64) -> Self {
        Self { seed, ..self }
    }

    /// Sets the number of the window's first frame in the capture.
    #[must_use]
    pub fn with_first_frame(self, first_frame: u64) -> Self {
        Self { first_frame, ..self }
    }

    /// Returns the incident photons per unit of image value.
    pub fn photons_per_unit(&self) -> f64 {
        self.ppp / self.mean_level
    }

    /// Returns the dark electrons per frame of pixel `i`; `typical` where no map is known.
    pub fn dark_of(&self, i: usize, typical: f64) -> f64 {
        self.dark.as_ref().map_or(typical, |map| f64::from(map[i]))
    }
}
