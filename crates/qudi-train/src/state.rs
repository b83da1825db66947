//! The state that a run resumes from: one file of weights, their average, the optimizer's moments and the
//! number of steps, with a digest, replaced whole or not at all.

use super::digest::Digest;
use super::learner::Learner;
use super::parameters::with_parameters;
use super::recipe::Recipe;
use super::trainer::Trainer;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::limits::WEIGHT_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::{Error, Result};
use qudi_layers::tensor::read;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// The description of a state, in the metadata of its file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Description {
    /// Steps taken.
    step: u64,
    /// Digest of the number of steps and of all tensors.
    sha256: String,
}

/// The key of the description among the metadata.
const KEY: &str = "qudi-state";

/// The lists that a state holds, by the prefix of their names.
const LISTS: [&str; 4] = ["weights", "average", "mean", "square"];

/// Folder of the state in a run's folder, and its file.
const FOLDER: &str = "state";
const TENSORS: &str = "tensors.safetensors";

fn file(run: &Path) -> PathBuf {
    run.join(FOLDER).join(TENSORS)
}

impl<L: Learner> Trainer<L> {
    /// Writes the state into the run's folder. At any moment one whole state lies there.
    ///
    /// # Errors
    /// [`Error`] if it holds values that are not finite, or cannot be written; the state before is intact
    /// then.
    pub fn save_state(&mut self, run: &Path) -> Result<()> {
        let path = file(run);
        let weights = super::parameters::parameters(&self.network);
        let lists = [&weights, &self.ema.average, &self.optimizer.mean, &self.optimizer.square];
        let names = self.network.named_shapes();
        let mut tensors = Vec::new();
        for (prefix, list) in LISTS.iter().zip(lists) {
            for ((name, _), values) in names.iter().zip(list) {
                let values = read(values.clone())?;
                if !values.iter().all(|value| value.is_finite()) {
                    return Err(not_finite(&format!("{prefix}/{name}"), &path));
                }
                let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                tensors.push((format!("{prefix}/{name}"), values.len(), bytes));
            }
        }
        let step = self.step_number();
        let contents = tensors.iter().map(|(name, _, bytes)| (name.as_str(), bytes.as_slice()));
        let description = Description { step, sha256: digest(step, contents) };
        let text = serde_json::to_string(&description).expect("plain data");
        let views = tensors.iter().map(|(name, count, bytes)| {
            let view = TensorView::new(Dtype::F32, vec![*count], bytes);
            (name, view.expect("as many bytes as the shape says"))
        });
        let metadata = HashMap::from([(KEY.to_owned(), text)]);
        let bytes = safetensors::serialize(views, Some(metadata)).map_err(|e| {
            Error::data(format!("cannot lay out the state: {e}"), &path, "report this")
        })?;
        let folder = run.join(FOLDER);
        std::fs::create_dir_all(&folder)
            .map_err(|e| Error::io("write the training state", &folder, e))?;
        PendingFile::write_whole(&path, &bytes, Overwrite::Yes)?;
        self.saved = Some(step);
        Ok(())
    }

    /// Resumes from the state in a run's folder.
    ///
    /// # Errors
    /// [`Error`] if there is none, or it is damaged or of another recipe.
    pub fn resume(
        run: &Path,
        recipe: &Recipe,
        devices: &[Device],
        backbones: Option<&Path>,
    ) -> Result<Self> {
        let path = file(run);
        let damaged = |what: String| damaged(&path, &what);
        let bytes = open(&path)?;
        let description = description(&bytes, &path)?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(e.to_string()))?;
        let mut trainer = Self::new(recipe, None, devices, backbones)?;
        let names = trainer.network.named_shapes();
        for (prefix, (name, shape)) in LISTS.iter().flat_map(|p| names.iter().map(move |n| (p, n)))
        {
            let name = format!("{prefix}/{name}");
            let tensor = tensors.tensor(&name).map_err(|e| damaged(e.to_string()))?;
            if tensor.dtype() != Dtype::F32 || tensor.shape() != [shape.iter().product::<usize>()] {
                return Err(damaged(format!("`{name}` has another size than the recipe's")));
            }
        }
        // The order in which a state was written is the network's.
        let all = LISTS
            .iter()
            .flat_map(|prefix| names.iter().map(move |(name, _)| format!("{prefix}/{name}")));
        let all: Vec<String> = all.collect();
        let data = |name: &str| tensors.tensor(name).map_or(&[][..], |tensor| tensor.data());
        let contents = all.iter().map(|name| (name.as_str(), data(name)));
        if digest(description.step, contents) != description.sha256 {
            return Err(damaged("its digest does not fit its content".to_owned()));
        }
        let device = trainer.ema.average[0].device();
        let list = |prefix: &str| {
            let values = names.iter().map(|(name, _)| {
                let name = format!("{prefix}/{name}");
                let words = data(&name).chunks_exact(4).map(|b| [b[0], b[1], b[2], b[3]]);
                let values: Vec<f32> = words.map(f32::from_le_bytes).collect();
                if !values.iter().all(|value| value.is_finite()) {
                    return Err(not_finite(&name, &path));
                }
                let count = values.len();
                Ok(Tensor::<1>::from_data(TensorData::new(values, [count]), &device))
            });
            values.collect::<Result<Vec<_>>>()
        };
        let [weights, average, mean, square] = LISTS.map(list);
        trainer.network = with_parameters(trainer.network, weights?);
        trainer.ema.average = average?;
        (trainer.optimizer.mean, trainer.optimizer.square) = (mean?, square?);
        trainer.optimizer.steps = description.step;
        trainer.saved = Some(description.step);
        Ok(trainer)
    }
}

fn digest<'a>(step: u64, contents: impl Iterator<Item = (&'a str, &'a [u8])>) -> String {
    let mut digest = Digest::default();
    digest.add("step", &step.to_le_bytes());
    contents.for_each(|(name, bytes)| digest.add(name, bytes));
    digest.text()
}

fn not_finite(name: &str, path: &Path) -> Error {
    Error::data(
        format!("`{name}` of the training state holds values that are not finite"),
        path,
        "the training has failed: start a new run, with a lower train.lr or train.clip",
    )
}

fn damaged(path: &Path, what: &str) -> Error {
    Error::data(
        format!("the training state cannot be used: {what}"),
        path,
        "start a new run in another folder from this run's weights.safetensors",
    )
}

fn open(path: &Path) -> Result<Vec<u8>> {
    read_limited(path, LISTS.len() as u64 * WEIGHT_BYTES, "read the training state")
}

fn description(bytes: &[u8], path: &Path) -> Result<Description> {
    let (_, header) =
        SafeTensors::read_metadata(bytes).map_err(|e| damaged(path, &e.to_string()))?;
    let text = header.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
    let text = text.ok_or_else(|| damaged(path, "this program did not write it"))?;
    serde_json::from_str(text).map_err(|e| damaged(path, &e.to_string()))
}

/// Returns the steps that the state of a run has taken.
///
/// # Errors
/// [`Error`] if there is none, or it is damaged.
pub fn steps_taken(run: &Path) -> Result<u64> {
    let path = file(run);
    Ok(description(&open(&path)?, &path)?.step)
}

/// Returns true if a folder holds a state to resume from.
pub fn run_exists(run: &Path) -> bool {
    file(run).exists()
}

/// Removes the state of a run; a file that this program did not write stays.
///
/// # Errors
/// [`Error`] if a file of another program lies in its place, or it cannot be removed.
pub fn remove_state(run: &Path) -> Result<()> {
    let path = file(run);
    if path.symlink_metadata().is_err() {
        return Ok(());
    }
    if open(&path).and_then(|bytes| description(&bytes, &path)).is_err() {
        return Err(Error::data(
            "this program did not write the training state that lies there",
            &path,
            "choose another folder, or move it away",
        ));
    }
    std::fs::remove_file(&path).map_err(|e| Error::io("remove the training state", &path, e))?;
    // Stays where anything else lies in it.
    let _ = std::fs::remove_dir(run.join(FOLDER));
    Ok(())
}
