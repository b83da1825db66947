//! Cached bursts, small in memory, and on disk: a reference estimate takes ten times as long as a training
//! step.

pub(crate) mod burst;
mod draw;
mod sampler;

use crate::dataset::{DataConfig, Pack, Sample, SensorMix};
use crate::digest::Digest;
use crate::parameters::parameters;
use crate::recipe::{CropsConfig, Recipe};
use burn::module::Module;
use burst::ConditionedBurst;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::regular_file::read_limited;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::Sensor;
use qudi_core::{Error, Frame, Result, Size};
use qudi_layers::tensor::read as read_tensor;
use qudi_model::aligned::{Aligned, AlignedNeighbours};
use qudi_model::diffusion::Part;
use qudi_model::regression::{AlignmentFrames, BurstAligner};
use rand::{Rng, RngExt};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

pub use draw::draw_bursts;
pub use sampler::BurstSampler;

/// The files that a run learns from.
#[derive(Debug, Default)]
pub struct Files {
    /// Decoded clips and stills, for recipes that name any.
    pub pack: Option<Pack>,
    /// The folder of cached bursts, which exists: those there are not drawn again. Only for recipes with
    /// `train.crops`.
    pub bursts: Option<PathBuf>,
}

/// A burst whose aligned counts are rounded to bytes, in steps finer than any noise.
#[derive(Debug)]
pub(super) struct CachedBurst {
    size: Size,
    sample: Sample,
    aligned: Option<Aligned<Vec<f32>, Vec<i8>>>,
}

/// The steps of a byte: a 64th of a standard deviation near zero, wider far from it.
const STEPS: f32 = 32.0;

fn compressed(z: f32) -> i8 {
    (STEPS * (2.0 * z).asinh()).round() as i8
}

fn expanded(byte: i8) -> f32 {
    0.5 * (f32::from(byte) / STEPS).sinh()
}

/// [`expanded`] of every byte, by its bits.
static EXPANDED: LazyLock<[f32; 256]> =
    LazyLock::new(|| std::array::from_fn(|bits| expanded(bits as u8 as i8)));

impl CachedBurst {
    pub(super) fn new(burst: ConditionedBurst) -> Self {
        let ConditionedBurst { size, sample, aligned } = burst;
        let bytes = |plane: &Vec<f32>| plane.iter().copied().map(compressed).collect();
        let aligned = aligned.map(|planes| planes.map(Vec::clone, bytes));
        Self { size, sample, aligned }
    }

    /// Cuts random frames and a random square, rotated and mirrored at random.
    pub(super) fn crop(&self, crops: CropsConfig, random: &mut impl Rng) -> ConditionedBurst {
        let (frames, side) = (crops.frames, crops.side);
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
        let mut acquisition = self.sample.acquisition.clone();
        acquisition.seed = random.next_u64();
        let pixels = self.size.pixels();
        let place = |frame: usize| frame * pixels..(frame + 1) * pixels;
        let image = |plane: &Vec<f32>| -> Vec<f32> {
            range.clone().flat_map(|frame| picked(&plane[place(frame)], &places)).collect()
        };
        let table = &*EXPANDED;
        let standardized = |plane: &Vec<i8>| -> Vec<f32> {
            let bytes = range.clone().flat_map(|frame| picked(&plane[place(frame)], &places));
            bytes.map(|byte| table[usize::from(byte as u8)]).collect()
        };
        let aligned = self.aligned.as_ref().map(|planes| planes.map(image, standardized));
        ConditionedBurst { size, sample: Sample { truth, counts, acquisition }, aligned }
    }
}

fn picked<T: Copy>(values: &[T], places: &[usize]) -> Vec<T> {
    places.iter().map(|&place| values[place]).collect()
}

/// A folder with a SafeTensors file for every burst.
#[derive(Debug)]
pub(super) struct BurstCache {
    folder: PathBuf,
    seed: u64,
    /// All that decides what is drawn: bursts of anything else are refused.
    key: CacheKey,
    /// Frames, height, width.
    shape: [usize; 3],
    /// Names of the aligned planes.
    aligned: Option<Aligned<String>>,
}

/// Everything that decides a burst, its number aside. Files hold it as JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct CacheKey {
    program: String,
    data: DataConfig,
    /// The sensors that the recipe names: a file of a sensor may change.
    sensors: Vec<Sensor>,
    /// Digest of the decoded files.
    pack: Option<String>,
    seed: u64,
    cached_frames: usize,
    mean_level: bool,
    aligned: Option<AlignedKey>,
}

/// Everything that decides aligned planes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct AlignedKey {
    neighbours: usize,
    alignments: usize,
    /// Hash of the weights that made the frames; none for the reference estimate.
    refinement: Option<String>,
}

impl AlignedKey {
    fn new(aligner: &BurstAligner) -> Result<Self> {
        let AlignedNeighbours { neighbours, alignments } = aligner.neighbours();
        let refinement = match aligner.frames() {
            AlignmentFrames::ReferenceEstimate => None,
            AlignmentFrames::Refinement(refinement) => Some(sha256(refinement.predenoiser())?),
            AlignmentFrames::Diffusion(diffusion) => Some(sha256(diffusion.network())?),
        };
        Ok(Self { neighbours, alignments: alignments.count(), refinement })
    }
}

impl CacheKey {
    fn text(&self) -> String {
        serde_json::to_string(self).expect("plain data")
    }

    /// Parses the key as it is read back from a file: numbers of JSON may differ in the last bit.
    fn from_text(text: &str) -> Option<Self> {
        serde_json::from_str(text).ok()
    }
}

/// Hashes the weights of a network.
fn sha256<M: Module>(network: &M) -> Result<String> {
    let mut hash = Sha256::new();
    for list in parameters(network) {
        read_tensor(list)?.iter().for_each(|value| hash.update(value.to_le_bytes()));
    }
    Ok(format!("{:x}", hash.finalize()))
}

/// The metadata of a file, as TOML.
#[derive(Clone, Serialize, Deserialize)]
struct Label {
    drawn: String,
    /// Number of the burst.
    number: u64,
    /// Digest of everything else and of all tensors; empty while it is computed.
    sha256: String,
    ppp: f64,
    mean_level: f64,
    gain: f64,
    sensor: Sensor,
}

/// Light and gain beyond which no burst is drawn, and tables would not fit into memory.
const MAX_LIGHT: f64 = 1e9;

/// The key of the only entry of a file's metadata.
const KEY: &str = "burst";

/// The most bytes of a file that are not pixels.
const HEADER: usize = 1 << 16;

impl BurstCache {
    pub(super) fn new(
        folder: &Path,
        recipe: &Recipe,
        pack: Option<String>,
        aligner: Option<&BurstAligner>,
    ) -> Result<Self> {
        let Some(crops) = recipe.train.crops else {
            let what = "the recipe draws every sample anew";
            return Err(Error::request(
                what,
                "train.crops",
                "add train.crops, or leave the folder of bursts out",
            ));
        };
        let key = CacheKey {
            program: env!("CARGO_PKG_VERSION").to_owned(),
            data: recipe.data.clone(),
            sensors: recipe.data.sensor.iter().map(SensorMix::load).collect::<Result<_>>()?,
            pack,
            seed: recipe.train.seed,
            cached_frames: crops.cached_frames,
            mean_level: !recipe.train.ablate.removes(Part::MeanLevel),
            aligned: aligner.map(AlignedKey::new).transpose()?,
        };
        Ok(Self {
            folder: folder.to_owned(),
            seed: recipe.train.seed,
            key,
            shape: [
                crops.cached_frames.min(recipe.data.frames),
                recipe.data.crop,
                recipe.data.crop,
            ],
            aligned: aligner.map(|aligner| plane_names(aligner.neighbours())),
        })
    }

    fn path(&self, number: u64) -> PathBuf {
        self.folder.join(format!("{}-{number:06}.safetensors", self.seed))
    }

    /// Names and types of a file's tensors, each of one value for every pixel of every frame.
    fn tensors(&self) -> Vec<(String, Dtype)> {
        let mut list = vec![("truth".to_owned(), Dtype::F32), ("counts".to_owned(), Dtype::U16)];
        let Some(names) = &self.aligned else { return list };
        list.extend(names.images().map(|name| (name.clone(), Dtype::F32)));
        list.extend(names.standardized().map(|name| (name.clone(), Dtype::I8)));
        list
    }

    /// Writes burst `number`.
    pub(super) fn write(&self, number: u64, burst: &CachedBurst) -> Result<()> {
        let path = self.path(number);
        let report =
            |e: &dyn std::fmt::Display| Error::data(format!("no burst: {e}"), &path, "report this");
        let Acquisition { ppp, mean_level, gain, ref sensor, .. } = burst.sample.acquisition;
        let words =
            |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>();
        let truth = burst.sample.truth.iter().flat_map(|frame| words(&frame.data)).collect();
        let counts = burst.sample.counts.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        let mut bytes: Vec<Vec<u8>> = vec![truth, counts];
        if let Some(aligned) = &burst.aligned {
            bytes.extend(aligned.images().map(|plane| words(plane)));
            let signed = |plane: &Vec<i8>| plane.iter().flat_map(|v| v.to_le_bytes()).collect();
            bytes.extend(aligned.standardized().map(signed));
        }
        let contents = bytes.iter().map(Vec::as_slice);
        let mut label = Label {
            drawn: self.key.text(),
            number,
            sha256: String::new(),
            ppp,
            mean_level,
            gain,
            sensor: sensor.clone(),
        };
        label.sha256 = self.digest(&label, contents).map_err(|e| report(&e))?;
        // TOML: its numbers come back bit for bit.
        let label = toml::to_string(&label).map_err(|e| report(&e))?;
        let views = self.tensors().into_iter().zip(&bytes).map(|((name, kind), bytes)| {
            Ok((name, TensorView::new(kind, self.shape.to_vec(), bytes).map_err(|e| report(&e))?))
        });
        let views = views.collect::<Result<Vec<_>>>()?;
        let metadata = HashMap::from([(KEY.to_owned(), label)]);
        let file = safetensors::serialize(views, Some(metadata)).map_err(|e| report(&e))?;
        PendingFile::write_whole(&path, &file, Overwrite::Yes)
    }

    /// Computes the digest of a burst with this label and these tensors.
    fn digest<'a>(
        &self,
        label: &Label,
        contents: impl Iterator<Item = &'a [u8]>,
    ) -> std::result::Result<String, toml::ser::Error> {
        let label = Label { sha256: String::new(), ..label.clone() };
        let mut digest = Digest::default();
        digest.add("label", toml::to_string(&label)?.as_bytes());
        for ((name, _), bytes) in self.tensors().iter().zip(contents) {
            digest.add(name, bytes);
        }
        Ok(digest.text())
    }

    /// Burst `number`, if it is there.
    ///
    /// # Errors
    /// [`Error`] if it cannot be read, is damaged, or was drawn for something else.
    pub(super) fn read(&self, number: u64) -> Result<Option<CachedBurst>> {
        let path = self.path(number);
        if path.symlink_metadata().is_err_and(|e| e.kind() == std::io::ErrorKind::NotFound) {
            return Ok(None);
        }
        let damaged =
            |what: String| Error::data(what, &path, "remove the file: it will be drawn again");
        let pixels: usize = self.shape.iter().product();
        let bytes = |kind: Dtype| pixels * kind.bitsize() / 8;
        let whole = self.tensors().iter().map(|(_, kind)| bytes(*kind)).sum::<usize>();
        let file = read_limited(&path, (whole + HEADER) as u64, "read the burst")?;
        let (_, header) = SafeTensors::read_metadata(&file).map_err(|e| damaged(e.to_string()))?;
        let label = header.metadata().as_ref().and_then(|entries| entries.get(KEY));
        let label: Label = label
            .and_then(|label| toml::from_str(label).ok())
            .ok_or_else(|| damaged("not a burst cache file".to_owned()))?;
        let key = CacheKey::from_text(&label.drawn);
        if key.is_none() || key != CacheKey::from_text(&self.key.text()) {
            let help =
                "keep the bursts of another recipe, or of another version, in another folder";
            return Err(Error::data(
                "the burst was drawn with other data, sensors or weights",
                &path,
                help,
            ));
        }
        label.sensor.validate()?;
        if label.number != number {
            return Err(damaged(format!("it holds burst {}, and not {number}", label.number)));
        }
        let light = [label.ppp, label.mean_level, label.gain];
        if !light.iter().all(|v| *v > 0.0 && *v <= MAX_LIGHT) {
            let what = format!("light and gain are no numbers above 0, up to {MAX_LIGHT:e}");
            return Err(damaged(what));
        }
        let tensors = SafeTensors::deserialize(&file).map_err(|e| damaged(e.to_string()))?;
        for (name, kind) in self.tensors() {
            let tensor = tensors.tensor(&name).map_err(|e| damaged(e.to_string()))?;
            if tensor.dtype() != kind || tensor.shape() != self.shape {
                return Err(damaged(format!("`{name}` has another size than the recipe's")));
            }
        }
        let data = |name: &str| tensors.tensor(name).map_or(&[][..], |tensor| tensor.data());
        let names = self.tensors();
        let digest = self.digest(&label, names.iter().map(|(name, _)| data(name)));
        if digest.ok().as_ref() != Some(&label.sha256) {
            return Err(damaged("its digest does not fit its content".to_owned()));
        }
        let [_, height, width] = self.shape;
        let size = Size { height, width };
        let words = |bytes: &[u8]| {
            let words = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
            words.collect::<Vec<_>>()
        };
        let truth = data("truth").chunks_exact(4 * size.pixels());
        let truth = truth.map(|bytes| Frame { size, data: words(bytes) }).collect();
        let counts = data("counts")
            .chunks_exact(2 * size.pixels())
            .map(|bytes| bytes.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect());
        let acquisition = Acquisition {
            seed: 0,
            first_frame: 0,
            ppp: label.ppp,
            mean_level: label.mean_level,
            gain: label.gain,
            sensor: label.sensor,
            dark: None,
            pedestal: 0.0,
        };
        let sample = Sample { truth, counts: counts.collect(), acquisition };
        let signed = |name: &String| data(name).iter().map(|&b| b.cast_signed()).collect();
        let aligned = self.aligned.as_ref();
        let aligned = aligned.map(|names| names.map(|name| words(data(name)), signed));
        Ok(Some(CachedBurst { size, sample, aligned }))
    }
}

/// Names the planes of frames with these neighbours.
fn plane_names(neighbours: AlignedNeighbours) -> Aligned<String> {
    let list = |name: &str, count| (0..count).map(|i| format!("{name}.{i}")).collect();
    Aligned {
        reference: "reference".to_owned(),
        merged: "merged".to_owned(),
        noise_sigma: "noise_sigma".to_owned(),
        counts: list("standardized", 1 + neighbours.count()),
        expected: list("expected", neighbours.count()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cached_bytes_are_finer_than_noise() {
        for i in -800..=800 {
            let z = i as f32 * 0.01;
            let error = (expanded(compressed(z)) - z).abs();
            assert!(error <= 0.008 + 0.016 * z.abs(), "{z}: {error}");
        }
        let far = [1e9, -1e9, f32::NAN].map(|value| expanded(compressed(value)));
        assert!(far[0] > 13.0 && far[1] < -13.0 && far[2] == 0.0, "{far:?}");
    }
}
