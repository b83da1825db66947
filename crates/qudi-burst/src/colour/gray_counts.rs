//! Counts behind a filter, turned into counts that gray pixels would have.

use super::{Chroma, CountResponse};
use qudi_core::colour::ColourFilter;
use qudi_core::random::{Domain, Streams, uniform};
use qudi_core::restorer::Acquisition;
use qudi_core::{Frame, Size};

/// Separates the streams that round from all others of a seed.
const ROUNDING: u64 = 0x636f_6c6f_7572;

/// Least share of luma that a pixel sees.
pub(super) const MIN_SEEN: f32 = 0.02;

/// Largest factor on differences: saturated counts have hardly any noise, and tell nothing.
const MAX_SCALE: f32 = 3.0;

/// Luma and chroma of a frame, with which its counts become gray.
pub(super) struct GrayCounts<'a> {
    /// Weights of red, green and blue light in what a pixel behind each colour sees.
    pub(super) seen: [[f32; 3]; 4],
    pub(super) response: &'a CountResponse,
    pub(super) luma: &'a Frame,
    pub(super) chroma: &'a Chroma,
}

impl GrayCounts<'_> {
    /// Turns the counts of frame `frame` behind `filter` into gray ones. The difference of a count from the
    /// one that luma and chroma let expect is scaled to the noise of a gray count: the law of the result is
    /// the gray pixel's, and it tells nearly as much of luma as a gray count does.
    pub(super) fn of(
        &self,
        counts: &[u16],
        filter: &ColourFilter,
        frame: usize,
        acquisition: &Acquisition,
    ) -> Vec<u16> {
        let Self { seen, response, luma, chroma } = self;
        let typical = f64::from(response.dark);
        let value = |(i, &count): (usize, &u16)| {
            let dark = acquisition.dark_of(i, typical) as f32;
            let share = chroma.seen(i, seen[filter.colours()[i] as usize]).max(MIN_SEEN);
            let gray = response.at(luma.data[i], dark);
            let own = response.at(share * luma.data[i], dark);
            let noise = (gray.variance / own.variance).sqrt();
            gray.mean + noise.min(MAX_SCALE) * (f32::from(count) - own.mean)
        };
        let values: Vec<f32> = counts.iter().enumerate().map(value).collect();
        rounded(&values, luma.size, frame, acquisition)
    }
}

/// Rounds values to counts at random, so that their means stay.
pub(super) fn rounded(
    values: &[f32],
    size: Size,
    frame: usize,
    acquisition: &Acquisition,
) -> Vec<u16> {
    let streams = Streams::new(acquisition.seed ^ ROUNDING);
    let number = acquisition.first_frame + frame as u64;
    let most = f32::from(acquisition.sensor.max_count());
    let mut out = Vec::with_capacity(values.len());
    for (y, row) in values.chunks(size.width).enumerate() {
        let mut rng = streams.row(Domain::Photons, number, y);
        let count =
            |value: &f32| (value + uniform(&mut rng) as f32).floor().clamp(0.0, most) as u16;
        out.extend(row.iter().map(count));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::colour::Exposures;
    use crate::colour::exposures::Exposure;
    use qudi_core::sensor::Sensor;
    use qudi_core::{Camera, Light};

    /// A flat scene of saturated colour: counts of all pixels get the mean and the noise of a gray pixel.
    #[test]
    fn counts_of_a_coloured_scene_become_gray() {
        let size = Size { height: 64, width: 64 };
        let filter = ColourFilter::tiled(&"rggb".parse().unwrap(), size).unwrap();
        let scene = [0.7, 0.3, 0.5].map(|value| Frame::filled(size, value));
        let sensor = Sensor::load("qudi-paper").unwrap();
        let light = Light { ppp: 3.25, mean_level: 0.45 };
        let acquisition = Acquisition::new(sensor.clone(), light.ppp, light.mean_level).unwrap();
        let mut camera = Camera::new(&sensor, size, light, 3).unwrap();
        let counts = camera.expose(0, &[&filter.mosaic(&scene)]).unwrap();
        let response = CountResponse::new(&acquisition).unwrap();
        let ratios = [0.7, 0.3, 0.5].map(|value| vec![value / 0.45; size.pixels()]);
        let variances = std::array::from_fn(|_| vec![0.0; size.pixels()]);
        let (luma, chroma) = (Frame::filled(size, 0.45), Chroma { size, ratios, variances });
        let each = vec![Exposure { frames: &[], filter: &filter }];
        let seen = Exposures { size, each }.responses();
        let gray = GrayCounts { seen, response: &response, luma: &luma, chroma: &chroma };
        let gray = gray.of(&counts, &filter, 0, &acquisition);
        let expected = response.at(0.45, response.dark);
        for colour in 0..3 {
            let of: Vec<f64> = (0..size.pixels())
                .filter(|&i| filter.colours()[i] as usize == colour)
                .map(|i| f64::from(gray[i]))
                .collect();
            let mean = of.iter().sum::<f64>() / of.len() as f64;
            let variance = of.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / of.len() as f64;
            assert!(
                (mean - f64::from(expected.mean)).abs() < 0.15,
                "{colour}: {mean} {expected:?}"
            );
            let ratio = variance / f64::from(expected.variance);
            assert!((0.8..1.25).contains(&ratio), "{colour}: {ratio}");
        }
    }
}
