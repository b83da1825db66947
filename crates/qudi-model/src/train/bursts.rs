//! Bursts with their guides: drawn for every sample, or drawn once and cut into parts again and again.

use super::recipe::{PartsConfig, Recipe};
use crate::config::Part;
use crate::measurement::{GuidePlanes, IMAGES};
use qudi_sim::dataset::{Dataset, Sample};
use qudi_sim::restore::BurstView;
use qudi_sim::{Frame, Result, Size, USUAL_EXPOSURE};
use rand::rngs::ChaCha8Rng;
use rand::{Rng, RngExt, SeedableRng};
use std::sync::{Arc, OnceLock};

/// Frames of a burst and what classical methods make of all of them.
#[derive(Clone, Debug)]
pub(super) struct Guided {
    pub(super) size: Size,
    pub(super) sample: Sample,
    pub(super) guide: GuidePlanes,
}

/// Where samples come from, for one thread.
#[derive(Debug)]
pub struct Bursts {
    dataset: Dataset,
    seed: u64,
    crop: usize,
    neighbours: usize,
    exposure: bool,
    parts: Option<(PartsConfig, Kept)>,
}

/// Bursts that all threads share, each computed by the first that needs it.
type Kept = Arc<Vec<OnceLock<KeptBurst>>>;

impl Bursts {
    /// Those of a recipe.
    pub fn new(recipe: &Recipe, dataset: Dataset) -> Self {
        let keep = |parts: PartsConfig| {
            let kept = (0..parts.bursts).map(|_| OnceLock::new()).collect();
            (parts, Arc::new(kept))
        };
        Self {
            dataset,
            seed: recipe.train.seed,
            crop: recipe.data.crop,
            neighbours: recipe.network.pre.neighbours,
            exposure: !recipe.network.lacks(Part::Exposure),
            parts: recipe.train.parts.map(keep),
        }
    }

    /// The same for another thread.
    ///
    /// # Errors
    /// [`SimError`](qudi_sim::SimError) if the data cannot be opened again.
    pub fn again(&self) -> Result<Self> {
        Ok(Self { dataset: self.dataset.again()?, parts: self.parts.clone(), ..*self })
    }

    /// Sample `number`.
    pub(super) fn sample(&mut self, number: u64) -> Result<Guided> {
        let Some((parts, kept)) = self.parts.clone() else { return self.draw(number, None) };
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(number);
        let place = random.random_range(0..parts.bursts);
        let cell = &kept[place as usize];
        if cell.get().is_none() {
            // Two threads may draw the same one: they draw the same.
            let drawn = self.draw(place, Some(parts.kept))?;
            cell.get_or_init(|| KeptBurst::new(drawn));
        }
        Ok(cell.get().expect("just filled").part(parts, &mut random))
    }

    /// Burst `number`, or some of its frames.
    fn draw(&mut self, number: u64, frames: Option<usize>) -> Result<Guided> {
        let size = Size { height: self.crop, width: self.crop };
        let mut sample = self.dataset.sample(self.seed, number)?;
        if !self.exposure {
            sample.context.exposure = USUAL_EXPOSURE;
        }
        let all = sample.counts.len();
        let frames = frames.unwrap_or(all).min(all);
        let mut random = ChaCha8Rng::seed_from_u64(sample.context.seed);
        let first = random.random_range(0..=all - frames);
        let view = BurstView { size, frames: &sample.counts };
        let range = first..first + frames;
        let guide = GuidePlanes::of_frames(view, &sample.context, self.neighbours, range.clone())?;
        sample.truth = sample.truth[range.clone()].to_vec();
        sample.counts = sample.counts[range].to_vec();
        Ok(Guided { size, sample, guide })
    }
}

/// A burst in a third of the memory: planes of deviations in bytes, finer than any noise.
#[derive(Debug)]
struct KeptBurst {
    size: Size,
    sample: Sample,
    images: Vec<Vec<f32>>,
    deviations: Vec<Vec<i8>>,
}

/// Steps of a byte: a 64th of a deviation near zero, wider far from it.
const STEPS: f32 = 32.0;

fn compressed(deviation: f32) -> i8 {
    (STEPS * (2.0 * deviation).asinh()).round() as i8
}

fn expanded(byte: i8) -> f32 {
    0.5 * (f32::from(byte) / STEPS).sinh()
}

impl KeptBurst {
    fn new(burst: Guided) -> Self {
        let Guided { size, sample, guide: GuidePlanes(mut images) } = burst;
        let deviations = images.split_off(IMAGES).into_iter();
        let deviations = deviations.map(|plane| plane.into_iter().map(compressed).collect());
        Self { size, sample, images, deviations: deviations.collect() }
    }

    /// Some frames, some square of them, turned and mirrored somehow.
    fn part(&self, parts: PartsConfig, random: &mut impl Rng) -> Guided {
        let (frames, side) = (parts.frames, parts.side);
        let first = random.random_range(0..=self.sample.truth.len() - frames);
        let top = random.random_range(0..=self.size.height - side);
        let left = random.random_range(0..=self.size.width - side);
        let [mirrored, flipped, turned]: [bool; 3] = std::array::from_fn(|_| random.random());
        let places: Vec<usize> = (0..side * side)
            .map(|place| {
                let (y, x) = (place / side, place % side);
                let (y, x) = if turned { (x, y) } else { (y, x) };
                let y = if flipped { side - 1 - y } else { y };
                let x = if mirrored { side - 1 - x } else { x };
                (top + y) * self.size.width + left + x
            })
            .collect();
        let size = Size { height: side, width: side };
        let range = first..first + frames;
        let truth = self.sample.truth[range.clone()].iter();
        let truth = truth.map(|frame| Frame { size, data: picked(&frame.data, &places) }).collect();
        let counts = &self.sample.counts[range.clone()];
        let counts = counts.iter().map(|frame| picked(frame, &places)).collect();
        let mut context = self.sample.context.clone();
        context.seed = random.next_u64();
        let pixels = self.size.pixels();
        let place = |frame: usize| frame * pixels..(frame + 1) * pixels;
        let image = |plane: &Vec<f32>| -> Vec<f32> {
            range.clone().flat_map(|frame| picked(&plane[place(frame)], &places)).collect()
        };
        let deviation = |plane: &Vec<i8>| -> Vec<f32> {
            let bytes = range.clone().flat_map(|frame| picked(&plane[place(frame)], &places));
            bytes.map(expanded).collect()
        };
        let planes = self.images.iter().map(image).chain(self.deviations.iter().map(deviation));
        let guide = GuidePlanes(planes.collect());
        Guided { size, sample: Sample { truth, counts, context }, guide }
    }
}

fn picked<T: Copy>(values: &[T], places: &[usize]) -> Vec<T> {
    places.iter().map(|&place| values[place]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bursts(parts: &str) -> Bursts {
        let changes = [("data.crop", "32"), ("data.frames", "3"), ("train.parts", parts)];
        let changes = changes.map(|(key, value)| (key.to_owned(), value.to_owned()));
        let recipe = Recipe::load("tiny", &changes).unwrap_or_else(|e| panic!("{e}"));
        let dataset = Dataset::new(&recipe.data, None).unwrap_or_else(|e| panic!("{e}"));
        Bursts::new(&recipe, dataset)
    }

    fn sample(bursts: &mut Bursts, number: u64) -> Guided {
        bursts.sample(number).unwrap_or_else(|e| panic!("{e}"))
    }

    /// Truth, count and restored value of every pixel, in the order of their values.
    fn pixels(burst: &Guided) -> Vec<(u32, u16, u32)> {
        let truth = burst.sample.truth.iter().flat_map(|frame| frame.data.clone());
        let counts = burst.sample.counts.iter().flatten();
        let pixels = truth.zip(counts).zip(&burst.guide.0[0]);
        let mut list: Vec<_> = pixels.map(|((t, &y), c)| (t.to_bits(), y, c.to_bits())).collect();
        list.sort_unstable();
        list
    }

    #[test]
    fn turned_bursts_keep_their_pixels_together() {
        let mut bursts = bursts("{ bursts = 2, kept = 3, frames = 3, side = 32 }");
        let whole = [0, 1].map(|place| bursts.draw(place, None).unwrap_or_else(|e| panic!("{e}")));
        let whole = whole.map(|burst| pixels(&burst));
        let mut corners = std::collections::HashSet::new();
        for number in 0..16 {
            let part = sample(&mut bursts, number);
            assert!(whole.contains(&pixels(&part)), "sample {number}");
            corners.insert(part.guide.0[0][0].to_bits());
        }
        assert!(corners.len() > 4, "two bursts in eight positions, and {} corners", corners.len());
    }

    #[test]
    fn bytes_are_finer_than_noise() {
        for i in -800..=800 {
            let deviation = i as f32 * 0.01;
            let error = (expanded(compressed(deviation)) - deviation).abs();
            assert!(error <= 0.008 + 0.016 * deviation.abs(), "{deviation}: {error}");
        }
        let far = [1e9, -1e9, f32::NAN].map(|value| expanded(compressed(value)));
        assert!(far[0] > 13.0 && far[1] < -13.0 && far[2] == 0.0, "{far:?}");
    }

    #[test]
    fn kept_frames_know_the_others() {
        let mut bursts = bursts("{ bursts = 1, kept = 3, frames = 3, side = 32 }");
        let whole = bursts.draw(0, None).unwrap_or_else(|e| panic!("{e}"));
        let kept = bursts.draw(0, Some(2)).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!((kept.sample.truth.len(), kept.sample.counts.len()), (2, 2));
        let pixels = whole.size.pixels();
        let first = whole.sample.truth.iter().position(|frame| *frame == kept.sample.truth[0]);
        let first = first.unwrap_or_else(|| panic!("no frame of the whole"));
        for (all, some) in whole.guide.0.iter().zip(&kept.guide.0) {
            assert!(all[first * pixels..][..2 * pixels] == some[..]);
        }
    }

    #[test]
    fn parts_are_parts_and_always_the_same() {
        let mut one = bursts("{ bursts = 1, kept = 3, frames = 3, side = 16 }");
        let whole = pixels(&one.draw(0, None).unwrap_or_else(|e| panic!("{e}")));
        let mut other = one.again().unwrap_or_else(|e| panic!("{e}"));
        let mut seen = Vec::new();
        for number in [3, 1, 2] {
            let part = sample(&mut one, number);
            assert_eq!((part.size.pixels(), part.sample.truth.len()), (256, 3));
            let list = pixels(&part);
            assert!(list.iter().all(|pixel| whole.binary_search(pixel).is_ok()));
            assert_eq!(list, pixels(&sample(&mut other, number)));
            seen.push(list);
        }
        assert!(seen[0] != seen[1] && seen[1] != seen[2]);
    }
}
