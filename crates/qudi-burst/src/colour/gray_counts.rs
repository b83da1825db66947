//! Counts behind a filter, turned into counts that gray pixels would have.

use super::chroma::{Chroma, responses};
use super::{CountResponse, MergedColours};
use qudi_core::colour::ColourFilter;
use qudi_core::random::{Domain, Streams, uniform};
use qudi_core::restorer::Acquisition;
use qudi_core::{Frame, Size};

/// Separates the streams that round from all others of a seed.
const ROUNDING: u64 = 0x636f_6c6f_7572;

/// Least share of luma that a pixel sees.
const MIN_SEEN: f32 = 0.02;

/// Luma and chroma of a frame, with which its counts become gray.
pub(super) struct GrayCounts<'a> {
    pub(super) filter: &'a ColourFilter,
    pub(super) response: &'a CountResponse,
    pub(super) luma: &'a Frame,
    pub(super) chroma: &'a Chroma,
}

impl GrayCounts<'_> {
    /// Turns the counts of frame `frame` into gray ones. The difference of a count from the one that luma and
    /// chroma let expect is scaled to the difference that a gray count would have. Where that has more noise
    /// than a gray count, it is scaled down to as much noise: the law of the result is the gray pixel's.
    pub(super) fn of(&self, counts: &[u16], frame: usize, acquisition: &Acquisition) -> Vec<u16> {
        let Self { filter, response, luma, chroma } = self;
        let seen = responses(filter);
        let typical = f64::from(response.dark);
        let value = |(i, &count): (usize, &u16)| {
            let dark = acquisition.dark_of(i, typical) as f32;
            let share = chroma.seen(i, seen[filter.colours()[i] as usize]).max(MIN_SEEN);
            let gray = response.at(luma.data[i], dark);
            let own = response.at(share * luma.data[i], dark);
            let scale = gray.slope / (share * own.slope);
            let noise = (gray.variance / own.variance).sqrt();
            gray.mean + scale.min(noise) * (f32::from(count) - own.mean)
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

impl MergedColours {
    /// Returns the mean count behind each colour over a window, 0 of colours that there are not.
    pub(super) fn means(frames: &[Vec<u16>], filter: &ColourFilter) -> [f32; 4] {
        let (mut sums, mut numbers) = ([0.0f64; 4], [0.0f64; 4]);
        for counts in frames {
            for (&count, &colour) in counts.iter().zip(filter.colours()) {
                sums[colour as usize] += f64::from(count);
                numbers[colour as usize] += 1.0;
            }
        }
        std::array::from_fn(|k| (sums[k] / numbers[k].max(1.0)) as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_core::sensor::Sensor;
    use qudi_core::{Camera, Light};

    /// A flat scene of saturated colour: counts of all pixels get the mean and, at most, the noise of a gray
    /// pixel.
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
        let (luma, chroma) = (Frame::filled(size, 0.45), Chroma { size, ratios });
        let gray =
            GrayCounts { filter: &filter, response: &response, luma: &luma, chroma: &chroma };
        let gray = gray.of(&counts, 0, &acquisition);
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
            assert!((0.4..1.25).contains(&ratio), "{colour}: {ratio}");
        }
    }
}
