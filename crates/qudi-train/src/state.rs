//! The state that a run resumes from: a folder of weights, their average, the optimizer's moments and
//! counters, which is replaced whole or not at all.

use super::learner::Learner;
use super::parameters::with_parameters;
use super::recipe::Recipe;
use super::trainer::Trainer;
use burn::tensor::{Device, Tensor, TensorData};
use qudi_core::{Error, Result};
use qudi_layers::tensor::read;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

/// The counters of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Counters {
    step: u64,
}

/// The lists that a state holds, by the prefix of their names.
const LISTS: [&str; 4] = ["weights", "average", "mean", "square"];

const COUNTERS: &str = "counters.json";
const TENSORS: &str = "tensors.safetensors";

/// Names of the folder, of its successor while it is written, and of its predecessor while it is removed.
fn names(run: &Path) -> [PathBuf; 3] {
    ["state", "state.new", "state.old"].map(|name| run.join(name))
}

impl<L: Learner> Trainer<L> {
    /// Writes the state into the run's folder. At any moment one whole state lies there.
    ///
    /// # Errors
    /// [`Error`] if it cannot be written; the state before is intact then.
    pub fn save_state(&self, run: &Path) -> Result<()> {
        let [state, new, old] = names(run);
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |e| Error::io("write the training state", &path, e)
        };
        // What an interrupted call left.
        if new.exists() {
            std::fs::remove_dir_all(&new).map_err(failed(&new))?;
        }
        std::fs::create_dir(&new).map_err(failed(&new))?;
        let weights = super::parameters::parameters(&self.network);
        let lists = [&weights, &self.ema.average, &self.optimizer.mean, &self.optimizer.square];
        let names = self.network.named_shapes();
        let mut tensors = Vec::new();
        for (prefix, list) in LISTS.iter().zip(lists) {
            for ((name, _), values) in names.iter().zip(list) {
                let values = read(values.clone())?;
                let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                tensors.push((format!("{prefix}/{name}"), values.len(), bytes));
            }
        }
        let views = tensors.iter().map(|(name, count, bytes)| {
            let view = TensorView::new(Dtype::F32, vec![*count], bytes);
            (name, view.expect("as many bytes as the shape says"))
        });
        let bytes = safetensors::serialize(views, None).map_err(|e| {
            Error::data(format!("cannot lay out the state: {e}"), &new, "report this")
        })?;
        let counters =
            serde_json::to_vec(&Counters { step: self.step_number() }).expect("plain data");
        let write = |name: &str, bytes: &[u8]| {
            let path = new.join(name);
            let write = || {
                let mut file = File::create(&path)?;
                file.write_all(bytes)?;
                file.sync_all()
            };
            write().map_err(failed(&path))
        };
        if let Err(error) = write(TENSORS, &bytes).and_then(|()| write(COUNTERS, &counters)) {
            let _ = std::fs::remove_dir_all(&new);
            return Err(error);
        }
        if old.exists() {
            std::fs::remove_dir_all(&old).map_err(failed(&old))?;
        }
        if state.exists() {
            std::fs::rename(&state, &old).map_err(failed(&state))?;
        }
        std::fs::rename(&new, &state).map_err(failed(&new))?;
        let _ = std::fs::remove_dir_all(&old);
        // The renames reach the disk with their folder.
        if let Ok(folder) = File::open(run) {
            let _ = folder.sync_all();
        }
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
        let folder = last(run);
        let damaged = |what: String| damaged(&folder, &what);
        let counters = counters(&folder)?;
        let bytes = open(&folder, TENSORS)?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(e.to_string()))?;
        let mut trainer = Self::new(recipe, None, devices, backbones)?;
        let names = trainer.network.named_shapes();
        let device = trainer.ema.average[0].device();
        let list = |prefix: &str| {
            let values = names.iter().map(|(name, shape)| {
                let name = format!("{prefix}/{name}");
                let tensor = tensors.tensor(&name).map_err(|e| damaged(e.to_string()))?;
                let count = shape.iter().product::<usize>();
                if tensor.dtype() != Dtype::F32 || tensor.shape() != [count] {
                    return Err(damaged(format!("`{name}` has another size than the recipe's")));
                }
                let words = tensor.data().chunks_exact(4).map(|b| [b[0], b[1], b[2], b[3]]);
                let values: Vec<f32> = words.map(f32::from_le_bytes).collect();
                Ok(Tensor::<1>::from_data(TensorData::new(values, [count]), &device))
            });
            values.collect::<Result<Vec<_>>>()
        };
        let [weights, average, mean, square] = LISTS.map(list);
        trainer.network = with_parameters(trainer.network, weights?);
        trainer.ema.average = average?;
        (trainer.optimizer.mean, trainer.optimizer.square) = (mean?, square?);
        trainer.optimizer.steps = counters.step;
        Ok(trainer)
    }
}

/// Returns the folder of the last whole state of a run.
fn last(run: &Path) -> PathBuf {
    let [state, _, old] = names(run);
    // Killed between two renames: the old state is the whole one.
    if state.exists() { state } else { old }
}

fn damaged(folder: &Path, what: &str) -> Error {
    Error::data(
        format!("the training state cannot be used: {what}"),
        folder,
        "start a new run in another folder from this run's weights.safetensors",
    )
}

fn open(folder: &Path, name: &str) -> Result<Vec<u8>> {
    let path = folder.join(name);
    std::fs::read(&path).map_err(|e| Error::io("read the training state", &path, e))
}

fn counters(folder: &Path) -> Result<Counters> {
    let bytes = open(folder, COUNTERS)?;
    serde_json::from_slice(&bytes).map_err(|e| damaged(folder, &e.to_string()))
}

/// Steps that the state of a run has taken.
pub(super) fn steps_taken(run: &Path) -> Result<u64> {
    Ok(counters(&last(run))?.step)
}

/// Returns true if a folder holds a state to go on from.
pub(super) fn exists(run: &Path) -> bool {
    let [state, _, old] = names(run);
    state.exists() || old.exists()
}
