//! A gray method, applied to captures behind a colour filter.

use super::chroma::Colours;
use super::exposures::Exposure;
use super::{
    Chroma, ColourCorrector, CountResponse, Exposures, GrayCounts, MergedColours, QuadMotion,
};
use qudi_core::colour::{Colour, ColourFilter};
use qudi_core::restorer::{Acquisition, BurstView, Restored, Restorer};
use qudi_core::windows::LONGEST_HALF;
use qudi_core::{Error, Frame, Result, Size};
use rayon::prelude::*;
use std::fmt;

/// Counts of the rarest colour over which chroma is averaged, in a Gaussian's effective area.
const CHROMA_COUNTS: f64 = 600.0;

/// Range of the standard deviation of that Gaussian in pixels.
const CHROMA_SIGMAS: [f64; 2] = [1.5, 6.0];

/// Least light of a colour, in units of luma's mean.
const MIN_LIGHT: f32 = 1e-2;

/// A reader of the planes of red and blue of a capture of three full planes.
pub trait PlaneFrames {
    /// Reads the counts of red and of blue in `frames` frames of the capture, from frame `first` on.
    ///
    /// # Errors
    /// [`Error`] if they cannot be read.
    fn read(&mut self, first: u64, frames: usize) -> Result<[Vec<Vec<u16>>; 2]>;
}

/// The place of the colours.
enum Source {
    /// Pixels behind a colour filter array.
    Mosaic(ColourFilter),
    /// Full planes: red and blue are read apart from green.
    Planes(Box<dyn PlaneFrames>),
}

/// A method for gray captures that restores the luma of a capture with colours, and its colours.
pub struct ColourRestorer {
    method: Box<dyn Restorer>,
    source: Source,
    /// True if colours are restored, and not luma alone.
    with_chroma: bool,
    corrector: Option<Box<dyn ColourCorrector>>,
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
        Self { method, source: Source::Mosaic(filter), with_chroma, corrector: None }
    }

    /// Creates a method for captures of three full planes; it restores bursts of the green one, and reads
    /// the others from `planes`.
    pub fn of_planes(
        method: Box<dyn Restorer>,
        planes: Box<dyn PlaneFrames>,
        with_chroma: bool,
    ) -> Self {
        Self { method, source: Source::Planes(planes), with_chroma, corrector: None }
    }

    /// Sets the network that corrects restored colours.
    #[must_use]
    pub fn with_corrector(self, corrector: Box<dyn ColourCorrector>) -> Self {
        Self { corrector: Some(corrector), ..self }
    }

    /// Restores luma from the gray counts of each exposure apart, and averages it.
    fn restored_luma(
        &mut self,
        size: Size,
        counts: &[Vec<Vec<u16>>],
        acquisition: &Acquisition,
        numbers: &[usize],
    ) -> Result<(Vec<Frame>, Option<Vec<Frame>>)> {
        let mut all = Vec::new();
        for frames in counts {
            let view = BurstView { size, frames };
            all.push(self.method.restore_frames(view, acquisition, numbers)?);
        }
        let mean = |each: Vec<&Frame>| {
            let value =
                |i: usize| each.iter().map(|frame| frame.data[i]).sum::<f32>() / each.len() as f32;
            Frame { size, data: (0..size.pixels()).map(value).collect() }
        };
        let frames = (0..numbers.len())
            .map(|n| mean(all.iter().map(|restored| &restored.frames[n]).collect()));
        let of_std = |n: usize| {
            let each: Option<Vec<&Frame>> =
                all.iter().map(|restored| Some(&restored.std.as_ref()?[n])).collect();
            each.map(mean)
        };
        Ok((frames.collect(), (0..numbers.len()).map(of_std).collect()))
    }
}

/// Returns the standard deviation in pixels over which chroma is averaged: smaller in more light.
fn chroma_sigma(exposures: &Exposures<'_>, detections: f64) -> f32 {
    let rarest = exposures.shares()[..3].iter().copied().fold(1.0, f64::min);
    let frames = exposures.frames().min(2 * LONGEST_HALF + 1) * exposures.each.len();
    let counts = (rarest * frames as f64 * detections).max(1e-9);
    let sigma = (CHROMA_COUNTS / (2.0 * std::f64::consts::PI * counts)).sqrt();
    sigma.clamp(CHROMA_SIGMAS[0], CHROMA_SIGMAS[1]) as f32
}

/// Refuses frames of another size than the filter's, and frames that hold no 2 x 2 pixels.
fn checked(filter: &ColourFilter, size: Size) -> Result<()> {
    if size != filter.size() {
        return Err(Error::request(
            format!("a filter of {} on frames of {size}", filter.size()),
            "cfa",
            "use the filter of this camera, of its frames' size",
        ));
    }
    if size.height < 2 || size.width < 2 {
        return Err(Error::request(
            format!("colours in frames of {size}"),
            "crop",
            "read a larger part of the frames, or one colour as gray with `channel`",
        ));
    }
    Ok(())
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
        let size = burst.size;
        let (filters, others) = match &mut self.source {
            Source::Mosaic(filter) => (vec![filter.clone()], Vec::new()),
            Source::Planes(planes) => {
                let others = planes.read(acquisition.first_frame, burst.frames.len())?;
                let colours = [Colour::Green, Colour::Red, Colour::Blue];
                (colours.map(|colour| ColourFilter::uniform(colour, size)).to_vec(), others.into())
            }
        };
        checked(&filters[0], size)?;
        let counts = [burst.frames].into_iter().chain(others.iter().map(Vec::as_slice));
        let each = filters
            .iter()
            .zip(counts)
            .map(|(filter, frames)| Exposure { frames, filter })
            .collect();
        let exposures = Exposures { size, each };
        let response = CountResponse::new(acquisition)?;
        let light = exposures.means().map(|mean| response.image(mean));
        let shares = exposures.shares();
        let mean_luma: f32 =
            shares.iter().zip(light).map(|(&share, light)| share as f32 * light).sum();
        let mean_luma = mean_luma.max(1e-6);
        let mean = light.map(|light| light.max(MIN_LIGHT * mean_luma));
        let sigma = chroma_sigma(&exposures, f64::from(mean_luma * response.per_unit));
        let colours = Colours { exposures: &exposures, response: &response, mean, sigma };
        let motion = QuadMotion::find(&exposures, acquisition, &response, mean)?;
        let merged = |frame: usize| {
            let displaced = motion.to(frame);
            MergedColours::new(&exposures, acquisition, &response, &displaced, mean_luma)
        };
        let seen = exposures.responses();
        let gray = |frame: usize| {
            let (luma, chroma) = colours.first(&merged(frame));
            let gray = GrayCounts { seen, response: &response, luma: &luma, chroma: &chroma };
            let of = |exposure: &Exposure<'_>| {
                gray.of(&exposure.frames[frame], exposure.filter, frame, acquisition)
            };
            exposures.each.iter().map(of).collect()
        };
        let by_frame: Vec<Vec<Vec<u16>>> =
            (0..exposures.frames()).into_par_iter().map(gray).collect();
        let mut counts = vec![Vec::new(); exposures.each.len()];
        for frame in by_frame {
            for (counts, of_exposure) in counts.iter_mut().zip(frame) {
                counts.push(of_exposure);
            }
        }
        let (frames, std) = self.restored_luma(size, &counts, acquisition, numbers)?;
        let completed = |(&frame, luma): (&usize, Frame)| {
            let merged = merged(frame);
            let chroma = colours.refined(&merged, &luma);
            let luma = colours.completed(&merged, luma, &chroma);
            match &self.corrector {
                None => Ok((luma, chroma)),
                Some(network) => {
                    colours.corrected_by(network.as_ref(), &merged, (luma, chroma), frame)
                }
            }
        };
        let restored: Vec<(Frame, Chroma)> =
            numbers.par_iter().zip(frames).map(completed).collect::<Result<_>>()?;
        let (colour, colour_std) = if self.with_chroma {
            let colour = restored.iter().map(|(luma, chroma)| chroma.coloured(luma)).collect();
            let uncertainty = |((luma, chroma), sigma): (&(Frame, Chroma), &Frame)| {
                chroma.uncertainty(luma, sigma)
            };
            let colour_std = |std: &Vec<Frame>| restored.iter().zip(std).map(uncertainty).collect();
            (Some(colour), std.as_ref().map(colour_std))
        } else {
            (None, None)
        };
        let frames = restored.into_iter().map(|(luma, _)| luma).collect();
        Ok(Restored { frames, std, colour, colour_std })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Average, QbpRefined};
    use qudi_core::metrics::gain_aligned_psnr;
    use qudi_core::sensor::Sensor;
    use qudi_core::{Camera, Light};

    const SIZE: Size = Size { height: 64, width: 80 };
    const LIGHT: Light = Light { ppp: 3.25, mean_level: 0.3 };

    /// Red, green and blue of a texture of slowly changing colour, moved by `t` steps. It does not repeat
    /// itself: motion is known.
    fn scene(t: usize, saturation: f32) -> [Frame; 3] {
        let plane = |k: usize| {
            Frame::from_fn(SIZE, |x, y| {
                let (x, y) = (x as f32 - 0.6 * t as f32, y as f32 + 0.3 * t as f32);
                let (u, v) = (0.5 * x + 3.0 * (0.13 * x).sin(), 0.4 * y + 2.0 * (0.17 * y).cos());
                let luma = 0.3 + 0.1 * (u + 0.5 * v).sin() + 0.1 * (v - 0.6 * u).sin();
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
        let luma = &restored.frames[0];
        for plane in colour {
            let error = |(value, luma): (&f32, &f32)| f64::from(value / luma - 1.0).powi(2);
            let errors = plane.data.iter().zip(&luma.data).map(error);
            let error = (errors.sum::<f64>() / luma.data.len() as f64).sqrt();
            assert!(error < 0.01, "{error}");
        }
    }

    /// A method whose errors have a known size.
    struct Certain;

    const SIGMA: f32 = 0.01;

    impl Restorer for Certain {
        fn name(&self) -> &'static str {
            "certain"
        }

        fn window(&self) -> usize {
            11
        }

        fn restore_frames(
            &mut self,
            burst: BurstView<'_>,
            acquisition: &Acquisition,
            numbers: &[usize],
        ) -> Result<Restored> {
            let Restored { frames, .. } = QbpRefined.restore_frames(burst, acquisition, numbers)?;
            let std = frames.iter().map(|frame| Frame::filled(frame.size, SIGMA)).collect();
            Ok(Restored::gray(frames, Some(std)))
        }
    }

    #[test]
    fn every_colour_has_its_uncertainty() {
        let filter = filter("rggb");
        let (frames, acquisition) = counts(&filter, 0.5);
        let view = BurstView { size: SIZE, frames: &frames };
        let mut restorer = ColourRestorer::new(Box::new(Certain), filter, true);
        let restored = restorer.restore_frames(view, &acquisition, &[5]).unwrap();
        let (colour, std) = (&restored.colour.unwrap()[0], &restored.colour_std.unwrap()[0]);
        for (k, truth) in scene(5, 0.5).iter().enumerate() {
            let mut sum = 0.0;
            for i in 0..SIZE.pixels() {
                let of_luma = SIGMA * colour[k].data[i] / restored.frames[0].data[i];
                assert!(std[k].data[i] >= 0.999 * of_luma, "{k}: {} {of_luma}", std[k].data[i]);
                sum += f64::from((colour[k].data[i] - truth.data[i]) / std[k].data[i]).powi(2);
            }
            // Blur of chroma at edges of colour is not among the errors that are known.
            let ratio = (sum / SIZE.pixels() as f64).sqrt();
            assert!((0.4..3.0).contains(&ratio), "{k}: {ratio}");
        }
    }

    /// Planes of red and blue in memory.
    struct InMemory([Vec<Vec<u16>>; 2]);

    impl PlaneFrames for InMemory {
        fn read(&mut self, first: u64, frames: usize) -> Result<[Vec<Vec<u16>>; 2]> {
            let part = first as usize..first as usize + frames;
            Ok(self.0.each_ref().map(|plane| plane[part.clone()].to_vec()))
        }
    }

    #[test]
    fn three_planes_together_are_better_than_apart() {
        let (_, acquisition) = counts(&filter("rggb"), 0.0);
        let mut camera = Camera::new(&acquisition.sensor, SIZE, LIGHT, 7).unwrap();
        let mut expose = |k: usize| -> Vec<Vec<u16>> {
            let frame =
                |t: usize| camera.expose((11 * k + t) as u64, &[&scene(t, 0.5)[k]]).unwrap();
            (0..11).map(frame).collect()
        };
        let [red, green, blue] = [expose(0), expose(1), expose(2)];
        let apart = [&red, &green, &blue].map(|frames| {
            let view = BurstView { size: SIZE, frames };
            QbpRefined.restore_frames(view, &acquisition, &[5]).unwrap().frames.remove(0)
        });
        let planes = Box::new(InMemory([red.clone(), blue.clone()]));
        let mut restorer = ColourRestorer::of_planes(Box::new(QbpRefined), planes, true);
        let view = BurstView { size: SIZE, frames: &green };
        let restored = restorer.restore_frames(view, &acquisition, &[5]).unwrap();
        let colour = &restored.colour.unwrap()[0];
        for (k, truth) in scene(5, 0.5).iter().enumerate() {
            let together = gain_aligned_psnr(&colour[k], truth);
            let apart = gain_aligned_psnr(&apart[k], truth);
            assert!(together > apart + 1.0, "{k}: {together} {apart}");
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
