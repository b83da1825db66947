//! Bursts with their guides: drawn for every sample, or drawn once and cut into parts again and again.

use super::recipe::{PartsConfig, Recipe};
use crate::config::Part;
use crate::measurement::GuidePlanes;
use qudi_sim::dataset::{Dataset, Sample};
use qudi_sim::restore::BurstView;
use qudi_sim::{Frame, Result, Size, USUAL_EXPOSURE};
use rand::rngs::ChaCha8Rng;
use rand::{Rng, RngExt, SeedableRng};
use std::sync::{Arc, OnceLock};

/// A burst and what classical methods make of it.
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
    exposure: bool,
    parts: Option<(PartsConfig, Kept)>,
}

/// Bursts that all threads share, each computed by the first that needs it.
type Kept = Arc<Vec<OnceLock<Guided>>>;

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
        let Some((parts, kept)) = self.parts.clone() else { return self.draw(number) };
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(number);
        let place = random.random_range(0..parts.bursts);
        let cell = &kept[place as usize];
        if cell.get().is_none() {
            // Two threads may draw the same one: they draw the same.
            let drawn = self.draw(place)?;
            cell.get_or_init(|| drawn);
        }
        Ok(cell.get().expect("just filled").part(parts, &mut random))
    }

    /// Burst `number`, whole.
    fn draw(&mut self, number: u64) -> Result<Guided> {
        let size = Size { height: self.crop, width: self.crop };
        let mut sample = self.dataset.sample(self.seed, number)?;
        if !self.exposure {
            sample.context.exposure = USUAL_EXPOSURE;
        }
        let view = BurstView { size, frames: &sample.counts };
        let guide = GuidePlanes::of(view, &sample.context)?;
        Ok(Guided { size, sample, guide })
    }
}

impl Guided {
    /// Some frames, some square of them, turned and mirrored somehow.
    fn part(&self, parts: PartsConfig, random: &mut impl Rng) -> Self {
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
        let pixels = self.size.pixels();
        let mut context = self.sample.context.clone();
        context.seed = random.next_u64();
        let guide = self.guide.map(|plane| {
            let frames = plane.chunks_exact(pixels).take(range.end).skip(range.start);
            frames.flat_map(|frame| picked(frame, &places)).collect()
        });
        Self { size, sample: Sample { truth, counts, context }, guide }
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
        let mut bursts = bursts("{ bursts = 2, frames = 3, side = 32 }");
        let whole = [0, 1].map(|place| bursts.draw(place).unwrap_or_else(|e| panic!("{e}")));
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
    fn parts_are_parts_and_always_the_same() {
        let mut one = bursts("{ bursts = 1, frames = 3, side = 16 }");
        let whole = pixels(&one.draw(0).unwrap_or_else(|e| panic!("{e}")));
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
