//! A gray method, applied to captures behind a colour filter.

use super::chroma::Colours;
use super::{Chroma, CountResponse, GrayCounts, MergedColours, QuadMotion};
use qudi_core::colour::ColourFilter;
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::windows::LONGEST_HALF;
use qudi_core::{Error, Frame, Result};
use rayon::prelude::*;
use std::fmt;

/// Counts of the rarest colour over which chroma is averaged, in a Gaussian's effective area.
const CHROMA_COUNTS: f64 = 600.0;

/// Range of the standard deviation of that Gaussian in pixels.
const CHROMA_SIGMAS: [f64; 2] = [1.5, 6.0];

/// Least light of a colour, in units of luma's mean.
const MIN_LIGHT: f32 = 1e-2;

/// A method for gray captures that restores the luma of a capture behind a colour filter, with its colours.
pub struct ColourRestorer {
    method: Box<dyn Restorer>,
    filter: ColourFilter,
    /// True if colours are restored, and not luma alone.
    with_chroma: bool,
}

impl fmt::Debug for ColourRestorer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ColourRestorer")
            .field("method", &self.method.name())
            .finish_non_exhaustive()
    }
}

impl ColourRestorer {
    /// Creates a method that restores luma with `method`, and colours too if `with_chroma` is set.
    pub fn new(method: Box<dyn Restorer>, filter: ColourFilter, with_chroma: bool) -> Self {
        Self { method, filter, with_chroma }
    }

    /// Returns the standard deviation in pixels over which chroma is averaged: smaller in more light.
    fn chroma_sigma(&self, frames: usize, detections: f64) -> f32 {
        let rarest = self.filter.shares()[..3].iter().copied().fold(1.0, f64::min);
        let counts = (rarest * frames.min(2 * LONGEST_HALF + 1) as f64 * detections).max(1e-9);
        let sigma = (CHROMA_COUNTS / (2.0 * std::f64::consts::PI * counts)).sqrt();
        sigma.clamp(CHROMA_SIGMAS[0], CHROMA_SIGMAS[1]) as f32
    }
}

impl Restorer for ColourRestorer {
    fn name(&self) -> &'static str {
        self.method.name()
    }

    fn window(&self) -> usize {
        self.method.window()
    }

    fn context(&self) -> [usize; 2] {
        self.method.context()
    }

    fn restore_frames(
        &mut self,
        burst: BurstView<'_>,
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<Restored> {
        if burst.size != self.filter.size() {
            return Err(Error::request(
                format!("a filter of {} on frames of {}", self.filter.size(), burst.size),
                "cfa",
                "use the filter of this camera, of its frames' size",
            ));
        }
        if burst.size.height < 2 || burst.size.width < 2 {
            return Err(Error::request(
                format!("colours in frames of {}", burst.size),
                "crop",
                "read a larger part of the frames, or one colour as gray with `channel`",
            ));
        }
        let response = CountResponse::new(acquisition)?;
        let means = MergedColours::means(burst.frames, &self.filter);
        let light = means.map(|mean| response.image(mean));
        let shares = self.filter.shares();
        let mean_luma: f32 =
            shares.iter().zip(light).map(|(&share, light)| share as f32 * light).sum();
        let mean_luma = mean_luma.max(1e-6);
        let mean = light.map(|light| light.max(MIN_LIGHT * mean_luma));
        let sigma = self.chroma_sigma(burst.frames.len(), f64::from(mean_luma * response.per_unit));
        let colours = Colours { filter: &self.filter, response: &response, mean, sigma };
        let motion = QuadMotion::find(burst, acquisition, &self.filter, &response, mean)?;
        let merged = |frame: usize| {
            let displaced = motion.to(frame);
            let filter = &self.filter;
            MergedColours::new(burst, acquisition, filter, &response, &displaced, mean_luma)
        };
        let gray = |frame: usize| {
            let (luma, chroma) = colours.first(&merged(frame));
            let gray = GrayCounts {
                filter: &self.filter,
                response: &response,
                luma: &luma,
                chroma: &chroma,
            };
            gray.of(&burst.frames[frame], frame, acquisition)
        };
        let counts: Vec<Vec<u16>> = (0..burst.frames.len()).into_par_iter().map(gray).collect();
        let view = BurstView { size: burst.size, frames: &counts };
        let restored = self.method.restore_frames(view, acquisition, numbers)?;
        if !self.with_chroma {
            return Ok(restored);
        }
        let coloured = |(&frame, luma): (&usize, &Frame)| {
            let chroma: Chroma = colours.refined(&merged(frame), luma);
            chroma.coloured(luma)
        };
        let colour = numbers.par_iter().zip(&restored.frames).map(coloured).collect();
        Ok(Restored { colour: Some(colour), ..restored })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Average, QbpRefined};
    use qudi_core::metrics::gain_aligned_psnr;
    use qudi_core::sensor::Sensor;
    use qudi_core::{Camera, Light, Size};

    const SIZE: Size = Size { height: 64, width: 80 };
    const LIGHT: Light = Light { ppp: 3.25, mean_level: 0.3 };

    /// Red, green and blue of a texture of slowly changing colour, moved by `t` steps.
    fn scene(t: usize, saturation: f32) -> [Frame; 3] {
        let plane = |k: usize| {
            Frame::from_fn(SIZE, |x, y| {
                let (x, y) = (x as f32 - 0.6 * t as f32, y as f32 + 0.3 * t as f32);
                let luma = 0.3 + 0.1 * (0.5 * x + 0.2 * y).sin() + 0.1 * (0.3 * y - 0.4 * x).sin();
                let hue = 0.08 * x - 0.05 * y + 2.1 * k as f32;
                luma * (1.0 + saturation * hue.sin())
            })
        };
        [plane(0), plane(1), plane(2)]
    }

    fn counts(filter: &ColourFilter, saturation: f32) -> (Vec<Vec<u16>>, Acquisition) {
        let sensor = Sensor::load("qudi-paper").unwrap();
        let mut camera = Camera::new(&sensor, SIZE, LIGHT, 5).unwrap();
        let expose =
            |t: usize| camera.expose(t as u64, &[&filter.mosaic(&scene(t, saturation))]).unwrap();
        let frames = (0..11).map(expose).collect();
        (frames, Acquisition::new(sensor, LIGHT.ppp, LIGHT.mean_level).unwrap())
    }

    fn filter(pattern: &str) -> ColourFilter {
        ColourFilter::tiled(&pattern.parse().unwrap(), SIZE).unwrap()
    }

    #[test]
    fn colours_of_a_moving_texture_are_restored() {
        for pattern in ["rggb", "gbrg@1,0", "wwrwwgwwbwwwwwgw"] {
            let filter = filter(pattern);
            let (frames, acquisition) = counts(&filter, 0.5);
            let view = BurstView { size: SIZE, frames: &frames };
            let mut restorer = ColourRestorer::new(Box::new(QbpRefined), filter, true);
            let restored = restorer.restore_frames(view, &acquisition, &[5]).unwrap();
            let colour = &restored.colour.unwrap()[0];
            for (plane, truth) in colour.iter().zip(scene(5, 0.5)) {
                let psnr = gain_aligned_psnr(plane, &truth);
                assert!(psnr > 27.0, "{pattern}: {psnr}");
            }
        }
    }

    #[test]
    fn static_gray_scenes_have_no_colour() {
        let filter = filter("rggb");
        let (_, acquisition) = counts(&filter, 0.0);
        let gray = filter.mosaic(&scene(0, 0.0));
        let mut camera = Camera::new(&acquisition.sensor, SIZE, LIGHT, 6).unwrap();
        let frames: Vec<_> = (0..11).map(|t| camera.expose(t, &[&gray]).unwrap()).collect();
        let view = BurstView { size: SIZE, frames: &frames };
        let mut restorer = ColourRestorer::new(Box::new(QbpRefined), filter, true);
        let restored = restorer.restore_frames(view, &acquisition, &[5]).unwrap();
        let colour = &restored.colour.unwrap()[0];
        let luma = restored.frames[0].mean();
        for plane in colour {
            let error = (plane.mean() / luma - 1.0).abs();
            assert!(error < 0.01, "{error}");
        }
    }

    #[test]
    fn luma_alone_has_no_planes_and_other_sizes_are_refused() {
        let filter = filter("rggb");
        let (frames, acquisition) = counts(&filter, 0.3);
        let view = BurstView { size: SIZE, frames: &frames };
        let mut restorer = ColourRestorer::new(Box::new(Average), filter, false);
        let restored = restorer.restore_frames(view, &acquisition, &[5]).unwrap();
        assert!(restored.colour.is_none() && restored.frames.len() == 1);
        let size = Size { height: 80, width: 64 };
        let view = BurstView { size, frames: &frames };
        assert!(restorer.restore_frames(view, &acquisition, &[5]).is_err());
    }
}
