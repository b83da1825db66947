//! Samples with their reference estimates: drawn one by one, or cut from cached bursts.

use super::burst::ConditionedBurst;
use super::{BurstCache, CachedBurst};
use crate::dataset::Dataset;
use crate::recipe::{CropsConfig, Recipe};
use qudi_core::restorer::BurstView;
use qudi_core::{Error, Result, Size, USUAL_MEAN_LEVEL};
use qudi_model::diffusion::Part;
use qudi_model::regression::BurstAligner;
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, OnceLock};

/// The source of samples. Clones share pack and bursts.
#[derive(Clone, Debug)]
pub struct BurstSampler {
    dataset: Dataset,
    seed: u64,
    crop: usize,
    /// True if samples come with the mean level of their scene.
    mean_level: bool,
    crops: Option<(CropsConfig, Cached)>,
    /// Aligns the samples of the regression.
    aligner: Option<BurstAligner>,
    cache: Option<Arc<BurstCache>>,
}

/// Bursts that all threads share, each computed by the first that needs it.
type Cached = Arc<Vec<OnceLock<CachedBurst>>>;

impl BurstSampler {
    /// Creates the sampler of a recipe, with what aligns the samples of the network that learns.
    pub fn new(recipe: &Recipe, dataset: Dataset, aligner: Option<BurstAligner>) -> Self {
        let cells = |crops: CropsConfig| {
            let cached = (0..crops.bursts).map(|_| OnceLock::new()).collect();
            (crops, Arc::new(cached))
        };
        Self {
            dataset,
            seed: recipe.train.seed,
            crop: recipe.data.crop,
            mean_level: !recipe.train.ablate.removes(Part::MeanLevel),
            crops: recipe.train.crops.map(cells),
            aligner,
            cache: None,
        }
    }

    /// Writes drawn bursts into `folder`, which exists, and reads those that are there.
    ///
    /// # Errors
    /// [`Error`](qudi_core::Error) if the recipe has no `train.crops`.
    pub fn with_cache(self, folder: &Path, recipe: &Recipe) -> Result<Self> {
        let pack = self.dataset.pack_sha256();
        let cache = BurstCache::new(folder, recipe, pack, self.aligner.as_ref())?;
        Ok(Self { cache: Some(Arc::new(cache)), ..self })
    }

    /// Sample `number`.
    pub(crate) fn sample(&mut self, number: u64) -> Result<ConditionedBurst> {
        let Some((crops, cached)) = self.crops.clone() else { return self.draw(number, None) };
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(number);
        let place = random.random_range(0..crops.bursts);
        let cell = &cached[place as usize];
        if cell.get().is_none() {
            // Two threads may draw the same one: they draw the same.
            let burst = self.cached(place, crops.cached_frames)?;
            cell.get_or_init(|| burst);
        }
        Ok(cell.get().expect("just filled").crop(crops, &mut random))
    }

    /// Burst `number` from the cache, or drawn and cached.
    fn cached(&mut self, number: u64, frames: usize) -> Result<CachedBurst> {
        let cache = self.cache.clone();
        if let Some(burst) = cache.as_ref().map(|cache| cache.read(number)).transpose()?.flatten() {
            return Ok(burst);
        }
        let burst = CachedBurst::new(self.draw(number, Some(frames))?);
        if let Some(cache) = cache {
            cache.write(number, &burst)?;
        }
        Ok(burst)
    }

    /// Draws every burst of the cache on `workers` threads; does nothing for a recipe without `train.crops`.
    pub(super) fn draw_all(
        &self,
        workers: usize,
        on: &mut dyn FnMut([u64; 2]) -> ControlFlow<()>,
    ) -> Result<()> {
        let Some((CropsConfig { bursts: all, cached_frames, .. }, _)) = self.crops else {
            return Ok(());
        };
        let next = AtomicU64::new(0);
        // Threads stop where nobody hears of their bursts any more.
        let (sender, receiver) = sync_channel(1);
        std::thread::scope(|scope| {
            for _ in 0..workers.max(1) {
                let (mut bursts, sender, next) = (self.clone(), sender.clone(), &next);
                scope.spawn(move || {
                    loop {
                        let number = next.fetch_add(1, Ordering::Relaxed);
                        let mut drawn = || bursts.cached(number, cached_frames).map(drop);
                        if number >= all || sender.send(drawn()).is_err() {
                            break;
                        }
                    }
                });
            }
            drop(sender);
            for (done, drawn) in (1..).zip(receiver) {
                drawn?;
                if on([done, all]).is_break() {
                    return Err(Error::Interrupted);
                }
            }
            Ok(())
        })
    }

    /// Burst `number`, or some of its frames.
    fn draw(&mut self, number: u64, frames: Option<usize>) -> Result<ConditionedBurst> {
        let size = Size { height: self.crop, width: self.crop };
        let mut sample = self.dataset.sample(self.seed, number)?;
        if !self.mean_level {
            sample.acquisition.mean_level = USUAL_MEAN_LEVEL;
        }
        let all = sample.counts.len();
        let frames = frames.unwrap_or(all).min(all);
        let mut random = ChaCha8Rng::seed_from_u64(sample.acquisition.seed);
        let first = random.random_range(0..=all - frames);
        let view = BurstView { size, frames: &sample.counts };
        let range = first..first + frames;
        let aligner = self.aligner.as_ref();
        let planes =
            aligner.map(|aligner| aligner.planes(view, &sample.acquisition, range.clone()));
        let aligned = planes.transpose()?;
        sample.truth = sample.truth[range.clone()].to_vec();
        sample.counts = sample.counts[range].to_vec();
        Ok(ConditionedBurst { size, sample, aligned })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_layers::TILE;
    use qudi_model::regression::{AlignmentFrames, Refinement};

    fn recipe(crops: &str) -> Recipe {
        let changes = [("data.crop", "32"), ("data.frames", "3"), ("train.crops", crops)];
        let changes = changes.map(|(key, value)| (key.to_owned(), value.to_owned()));
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/regression.toml");
        let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{e}"));
        Recipe::parse(&text, "regression", &changes).unwrap_or_else(|e| panic!("{e}"))
    }

    fn of(recipe: &Recipe) -> BurstSampler {
        let dataset = Dataset::new(&recipe.data, None).unwrap_or_else(|e| panic!("{e}"));
        let config = recipe.network.regression().unwrap_or_else(|e| panic!("{e}"));
        BurstSampler::new(recipe, dataset, Some(BurstAligner::first(config)))
    }

    fn bursts(crops: &str) -> BurstSampler {
        of(&recipe(crops))
    }

    fn sample(bursts: &mut BurstSampler, number: u64) -> ConditionedBurst {
        bursts.sample(number).unwrap_or_else(|e| panic!("{e}"))
    }

    /// Truth, count and restored value of every pixel, in the order of their values.
    fn pixels(burst: &ConditionedBurst) -> Vec<(u32, u16, u32)> {
        let truth = burst.sample.truth.iter().flat_map(|frame| frame.data.clone());
        let counts = burst.sample.counts.iter().flatten();
        let aligned = burst.aligned.as_ref().unwrap_or_else(|| panic!("not aligned"));
        let pixels = truth.zip(counts).zip(&aligned.reference);
        let mut list: Vec<_> = pixels.map(|((t, &y), c)| (t.to_bits(), y, c.to_bits())).collect();
        list.sort_unstable();
        list
    }

    #[test]
    fn rotated_crops_move_all_planes_alike() {
        let mut bursts = bursts("{ bursts = 2, cached_frames = 3, frames = 3, side = 32 }");
        let whole = [0, 1].map(|place| bursts.draw(place, None).unwrap_or_else(|e| panic!("{e}")));
        let whole = whole.map(|burst| pixels(&burst));
        let mut corners = std::collections::HashSet::new();
        for number in 0..16 {
            let crop = sample(&mut bursts, number);
            assert!(whole.contains(&pixels(&crop)), "sample {number}");
            let aligned = crop.aligned.as_ref().unwrap_or_else(|| panic!("not aligned"));
            corners.insert(aligned.reference[0].to_bits());
        }
        assert!(corners.len() > 4, "two bursts in eight positions, and {} corners", corners.len());
    }

    #[test]
    fn cached_frames_are_aligned_with_all_frames() {
        let mut bursts = bursts("{ bursts = 1, cached_frames = 3, frames = 3, side = 32 }");
        let whole = bursts.draw(0, None).unwrap_or_else(|e| panic!("{e}"));
        let cached = bursts.draw(0, Some(2)).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!((cached.sample.truth.len(), cached.sample.counts.len()), (2, 2));
        let pixels = whole.size.pixels();
        let first = whole.sample.truth.iter().position(|frame| *frame == cached.sample.truth[0]);
        let first = first.unwrap_or_else(|| panic!("no frame of the whole"));
        let part = |all: &Vec<f32>| all[first * pixels..][..2 * pixels].to_vec();
        assert!(whole.aligned.map(|planes| planes.map(part, part)) == cached.aligned);
    }

    #[test]
    fn crops_are_crops_of_the_burst_and_reproducible() {
        let mut one = bursts("{ bursts = 1, cached_frames = 3, frames = 3, side = 16 }");
        let whole = pixels(&one.draw(0, None).unwrap_or_else(|e| panic!("{e}")));
        let mut other = one.clone();
        let mut seen = Vec::new();
        for number in [3, 1, 2] {
            let crop = sample(&mut one, number);
            assert_eq!((crop.size.pixels(), crop.sample.truth.len()), (256, 3));
            let list = pixels(&crop);
            assert!(list.iter().all(|pixel| whole.binary_search(pixel).is_ok()));
            assert_eq!(list, pixels(&sample(&mut other, number)));
            seen.push(list);
        }
        assert!(seen[0] != seen[1] && seen[1] != seen[2]);
    }

    #[test]
    fn cached_bursts_equal_drawn_ones_and_damage_is_refused() {
        let recipe = recipe("{ bursts = 2, cached_frames = 3, frames = 3, side = 16 }");
        let folder = tempfile::tempdir().unwrap_or_else(|e| panic!("{e}"));
        let cached = |recipe: &Recipe| {
            of(recipe).with_cache(folder.path(), recipe).unwrap_or_else(|e| panic!("{e}"))
        };
        let same = |a: &ConditionedBurst, b: &ConditionedBurst| {
            let (one, other) = (&a.sample.acquisition, &b.sample.acquisition);
            a.aligned == b.aligned
                && a.sample.truth == b.sample.truth
                && a.sample.counts == b.sample.counts
                && one.seed == other.seed
                && (one.ppp.to_bits(), one.mean_level.to_bits(), one.gain.to_bits())
                    == (other.ppp.to_bits(), other.mean_level.to_bits(), other.gain.to_bits())
                && one.sensor == other.sensor
        };
        let (mut drawn, mut first, mut second) = (of(&recipe), cached(&recipe), cached(&recipe));
        for number in 0..6 {
            let expected = sample(&mut drawn, number);
            assert!(same(&expected, &sample(&mut first, number)), "written, sample {number}");
            assert!(same(&expected, &sample(&mut second, number)), "read, sample {number}");
        }
        let list = std::fs::read_dir(folder.path()).unwrap_or_else(|e| panic!("{e}"));
        let mut files: Vec<_> = list.map(|entry| entry.unwrap_or_else(|e| panic!("{e}"))).collect();
        files.sort_by_key(std::fs::DirEntry::file_name);
        let names: Vec<_> = files.iter().map(std::fs::DirEntry::file_name).collect();
        assert_eq!(names, ["1-000000.safetensors", "1-000001.safetensors"]);

        let mut other = recipe.clone();
        other.data.source[0].speed = 1.0;
        let error = (0..6).find_map(|number| cached(&other).sample(number).err());
        assert!(error.is_some_and(|e| e.to_string().contains("was drawn with other")));
        for file in files {
            let bytes = std::fs::read(file.path()).unwrap_or_else(|e| panic!("{e}"));
            for broken in [
                &bytes[..bytes.len() - 1],
                &bytes[..40],
                &[],
                &[&bytes[..], &vec![0; 1 << 17]].concat(),
            ] {
                std::fs::write(file.path(), broken).unwrap_or_else(|e| panic!("{e}"));
                let error = (0..6).find_map(|number| cached(&recipe).sample(number).err());
                assert!(error.is_some_and(|e| e.place().is_some()), "{} bytes", broken.len());
            }
            let mut dark = bytes.clone();
            let label = b"mean_level = 0.";
            let at = dark.windows(label.len()).position(|part| part == label);
            let at = at.unwrap_or_else(|| panic!("no mean level in the label"));
            dark[at..at + label.len()].copy_from_slice(b"mean_level =-0.");
            std::fs::write(file.path(), dark).unwrap_or_else(|e| panic!("{e}"));
            let error = (0..6).find_map(|number| cached(&recipe).sample(number).err());
            assert!(error.is_some_and(|e| e.to_string().contains("above 0")));
            let mut flipped = bytes.clone();
            flipped[bytes.len() - 1] ^= 4;
            std::fs::write(file.path(), flipped).unwrap_or_else(|e| panic!("{e}"));
            let error = (0..6).find_map(|number| cached(&recipe).sample(number).err());
            assert!(error.is_some_and(|e| e.to_string().contains("digest")));
            std::fs::write(file.path(), bytes).unwrap_or_else(|e| panic!("{e}"));
        }
        let path = |number: u64| folder.path().join(format!("1-{number:06}.safetensors"));
        let kept = std::fs::read(path(1)).unwrap_or_else(|e| panic!("{e}"));
        std::fs::copy(path(0), path(1)).unwrap_or_else(|e| panic!("{e}"));
        let error = (0..6).find_map(|number| cached(&recipe).sample(number).err());
        assert!(error.is_some_and(|e| e.to_string().contains("it holds burst 0, and not 1")));
        std::fs::write(path(1), kept).unwrap_or_else(|e| panic!("{e}"));
        // What other weights restored is something else, too.
        let device = burn::tensor::Device::flex();
        let config = recipe.network.regression().unwrap_or_else(|e| panic!("{e}"));
        let network = config.init(1, &device);
        let refinement = network.refinement().unwrap_or_else(|| panic!("no first pre-denoiser"));
        let refinement = Refinement::new(refinement, config, TILE, &device);
        let frames = AlignmentFrames::Refinement(Box::new(refinement));
        let aligner = Some(BurstAligner::second(config, frames));
        let refined = BurstSampler { aligner, ..of(&recipe) };
        let mut refined =
            refined.with_cache(folder.path(), &recipe).unwrap_or_else(|e| panic!("{e}"));
        let error = (0..6).find_map(|number| refined.sample(number).err());
        assert!(error.is_some_and(|e| e.to_string().contains("was drawn with other")));

        other.train.crops = None;
        assert!(of(&other).with_cache(folder.path(), &other).is_err());
    }
}
