//! Weights in one SafeTensors file that says what it is.

use crate::config::NetworkConfig;
use crate::network::{Qudi, fill, parameters};
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Device, Tensor, f16};
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::limits::WEIGHT_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::{Result, SimError};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;

/// The key of the description among a file's metadata.
const KEY: &str = "qudi";

/// What a weight file says about itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// Version of the program that wrote it.
    pub program: String,
    /// Name of the preset, if its sizes are one's.
    pub preset: Option<String>,
    /// Sizes of the network.
    pub network: NetworkConfig,
    /// Frames of a window that it was trained on.
    pub window: usize,
    /// Sensors that it was trained for.
    pub sensors: Vec<String>,
    /// Photons per pixel and frame that it was trained for: least and most.
    pub ppp: [f64; 2],
    /// What it was trained on.
    pub data: Vec<String>,
    /// Optimisation steps.
    pub steps: u64,
    /// Commit of the program that trained it.
    pub commit: Option<String>,
    /// Licence of the weights.
    pub licence: String,
    /// Reverse diffusion steps unless the user says otherwise; 0 for regression. Older files do not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub default_steps: Option<usize>,
}

impl Description {
    /// Reverse diffusion steps unless the user says otherwise.
    ///
    /// Older files do not say. Among them, weights that predict their own uncertainty were made for regression.
    pub fn reverse_steps(&self) -> usize {
        self.default_steps.unwrap_or(usize::from(!self.network.pre.error))
    }
}

/// How exactly numbers are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// In 32 bits, as they were learnt.
    Single,
    /// In 16 bits, for half the size.
    Half,
}

/// Writes the network's weights, whole or not at all.
///
/// # Errors
/// [`SimError`] if the file cannot be written or the device cannot be read.
pub fn save(
    network: &Qudi,
    description: &Description,
    precision: Precision,
    path: &Path,
    overwrite: Overwrite,
) -> Result<()> {
    let mut values =
        Values { precision, path: Vec::new(), list: Vec::new(), broken: None, error: None };
    network.visit(&mut values);
    if let Some(error) = values.error {
        return Err(error);
    }
    if let Some(name) = values.broken {
        return Err(SimError::data(
            format!("`{name}` holds values beyond {:e}", precision.largest()),
            path,
            "the training that wrote it had failed: use an earlier checkpoint",
        ));
    }
    let text = serde_json::to_string(description).expect("plain data");
    // One entry only: the library writes several in any order, and equal weights should make equal files.
    let metadata = HashMap::from([(KEY.to_owned(), text)]);
    let views = values.list.iter().map(|(name, shape, bytes)| {
        let view = TensorView::new(precision.kind(), shape.clone(), bytes);
        (name, view.expect("as many bytes as the shape says"))
    });
    let bytes = safetensors::serialize(views, Some(metadata)).map_err(|e| {
        SimError::data(format!("cannot lay out the weights: {e}"), path, "report this")
    })?;
    PendingFile::write_whole(path, &bytes, overwrite)
}

/// Reads the description alone.
///
/// # Errors
/// [`SimError::Data`] if it is no weight file of ours.
pub fn describe(path: &Path) -> Result<Description> {
    Ok(File::open(path)?.description)
}

/// The description of a weight file that is in memory; `place` names it in errors.
///
/// # Errors
/// [`SimError::Data`] if it is no weight file of ours.
pub fn describe_bytes(bytes: &[u8], place: &Path) -> Result<Description> {
    description(bytes, place)
}

/// [`load`], from memory.
///
/// # Errors
/// As [`load`].
pub fn load_bytes(bytes: &[u8], place: &Path, device: &Device) -> Result<(Qudi, Description)> {
    network(bytes, description(bytes, place)?, place, device)
}

/// Reads a network onto `device`. Nothing is allocated that the file does not hold.
///
/// # Errors
/// [`SimError::Data`] if the file does not fit its own description, or holds values that are no numbers.
pub fn load(path: &Path, device: &Device) -> Result<(Qudi, Description)> {
    let File { bytes, description } = File::open(path)?;
    network(&bytes, description, path, device)
}

/// The network of a whole file, described by `description`.
fn network(
    bytes: &[u8],
    description: Description,
    path: &Path,
    device: &Device,
) -> Result<(Qudi, Description)> {
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| damaged(path, e))?;
    let network = description.network.shell(device);
    let expected = parameters(&network);
    for (name, shape) in &expected {
        let Ok(tensor) = tensors.tensor(name) else {
            return Err(mismatch(path, format!("`{name}` is missing")));
        };
        if tensor.shape() != shape.as_slice() {
            let what = format!("`{name}` is {:?}, the network wants {shape:?}", tensor.shape());
            return Err(mismatch(path, what));
        }
        if !matches!(tensor.dtype(), Dtype::F32 | Dtype::F16) {
            return Err(mismatch(
                path,
                format!("`{name}` holds {:?}, not F32 or F16", tensor.dtype()),
            ));
        }
    }
    if let Some(name) = tensors
        .names()
        .into_iter()
        .find(|name| !expected.iter().any(|(expected, _)| expected == name))
    {
        return Err(mismatch(path, format!("`{name}` belongs to no part of the network")));
    }
    let mut broken = None;
    let network = fill(network, |name, shape| {
        let values = tensors.tensor(name).map(|tensor| numbers(&tensor)).unwrap_or_default();
        if broken.is_none() && !values.iter().all(|value| value.is_finite()) {
            broken = Some(name.to_owned());
        }
        debug_assert_eq!(values.len(), shape.iter().product::<usize>());
        values
    });
    match broken {
        Some(name) => Err(SimError::data(
            format!("`{name}` holds values that are no numbers"),
            path,
            "the training that wrote it had failed: use an earlier checkpoint",
        )),
        None => Ok((network, description)),
    }
}

/// A file, its description read.
struct File {
    bytes: Vec<u8>,
    description: Description,
}

impl File {
    fn open(path: &Path) -> Result<Self> {
        let bytes = read_limited(path, WEIGHT_BYTES, "read the weights")?;
        let description = description(&bytes, path)?;
        Ok(Self { bytes, description })
    }
}

fn description(bytes: &[u8], path: &Path) -> Result<Description> {
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| damaged(path, e))?;
    let text = header.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
    let Some(text) = text else {
        return Err(SimError::data(
            "a SafeTensors file of another program",
            path,
            "weights of this program say so in their metadata; name a file that `qudi train` wrote",
        ));
    };
    let description: Description = serde_json::from_str(text)
        .map_err(|e| mismatch(path, format!("the description cannot be read: {e}")))?;
    let network = description.network.checked().map_err(|e| mismatch(path, e.to_string()))?;
    if !(3..=1000).contains(&description.window) {
        return Err(mismatch(path, format!("a window of {} frames", description.window)));
    }
    Ok(Description { network, ..description })
}

fn damaged(path: &Path, error: impl std::fmt::Display) -> SimError {
    SimError::data(
        format!("not a whole SafeTensors file: {error}"),
        path,
        "copy or download it again",
    )
}

fn mismatch(path: &Path, what: impl Into<String>) -> SimError {
    SimError::data(what, path, "the file is damaged, or of another version of the program")
}

/// The values of a tensor of F32 or F16.
fn numbers(tensor: &TensorView<'_>) -> Vec<f32> {
    let bytes = tensor.data();
    if tensor.dtype() == Dtype::F16 {
        let words = bytes.chunks_exact(2).map(|b| [b[0], b[1]]);
        words.map(|bytes| f16::from_le_bytes(bytes).to_f32()).collect()
    } else {
        let words = bytes.chunks_exact(4).map(|b| [b[0], b[1], b[2], b[3]]);
        words.map(f32::from_le_bytes).collect()
    }
}

impl Precision {
    fn kind(self) -> Dtype {
        match self {
            Self::Single => Dtype::F32,
            Self::Half => Dtype::F16,
        }
    }

    /// The largest value that can be written.
    fn largest(self) -> f32 {
        match self {
            Self::Single => f32::MAX,
            Self::Half => f16::MAX.to_f32(),
        }
    }

    fn bytes(self, values: &[f32]) -> Vec<u8> {
        match self {
            Self::Single => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
            Self::Half => {
                let halves = values.iter().map(|&value| f16::from_f32(value));
                halves.flat_map(f16::to_le_bytes).collect()
            }
        }
    }
}

/// Values of all parameters, as little-endian bytes.
struct Values {
    precision: Precision,
    path: Vec<String>,
    list: Vec<(String, Vec<usize>, Vec<u8>)>,
    /// The first parameter with values that cannot be written.
    broken: Option<String>,
    error: Option<SimError>,
}

impl ModuleVisitor for Values {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        match crate::tensor::read(param.val()) {
            Ok(values) => {
                let largest = self.precision.largest();
                if self.broken.is_none()
                    && values.iter().any(|value| value.is_finite() && value.abs() > largest)
                {
                    self.broken = Some(self.path.join("."));
                }
                let bytes = self.precision.bytes(&values);
                self.list.push((self.path.join("."), param.shape().to_vec(), bytes));
            }
            Err(error) => self.error = Some(error),
        }
    }
}
