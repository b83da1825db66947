//! Weights in one SafeTensors file that describes itself.

mod description;
mod model_kind;

use crate::network::{Qudi, former_name, init_parameters, parameter_shapes};
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Device, Tensor, f16};
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::limits::WEIGHT_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::{Error, Result};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::HashMap;
use std::path::Path;

pub use description::Description;
pub use model_kind::ModelKind;

/// The key of the description among a file's metadata.
const KEY: &str = "qudi";

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
/// [`Error`] if the file cannot be written or the device cannot be read.
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
        return Err(Error::data(
            format!("`{name}` holds values beyond {:e}", precision.largest()),
            path,
            "the training that wrote it had failed: use an earlier checkpoint",
        ));
    }
    let kind = Some(ModelKind::from_zeros(|name| values.is_zero(name)));
    let description = Description { kind, ..description.clone() };
    let text = serde_json::to_string(&description).expect("plain data");
    // One entry only: the library writes several in any order, and equal weights should make equal files.
    let metadata = HashMap::from([(KEY.to_owned(), text)]);
    let views = values.list.iter().map(|(name, shape, bytes)| {
        let view = TensorView::new(precision.kind(), shape.clone(), bytes);
        (name, view.expect("as many bytes as the shape says"))
    });
    let bytes = safetensors::serialize(views, Some(metadata)).map_err(|e| {
        Error::data(format!("cannot lay out the weights: {e}"), path, "report this")
    })?;
    PendingFile::write_whole(path, &bytes, overwrite)
}

/// Reads the description of a weight file alone.
///
/// # Errors
/// [`Error::Data`] if it is not a weight file of this program.
pub fn describe(path: &Path) -> Result<Description> {
    Ok(File::open(path)?.description)
}

/// The description of a weight file that is in memory; `place` names it in errors.
///
/// # Errors
/// [`Error::Data`] if it is not a weight file of this program.
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
/// [`Error::Data`] if the file does not fit its own description, or holds values that are no numbers.
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
    let network = description.network.uninitialized(device);
    let expected = parameter_shapes(&network);
    let stored = |name: &str| tensors.tensor(name).or_else(|_| tensors.tensor(&former_name(name)));
    for (name, shape) in &expected {
        let Ok(tensor) = stored(name) else {
            return Err(mismatch(path, format!("`{name}` is missing")));
        };
        if tensor.shape() != shape.as_slice() {
            let what = format!("`{name}` is {:?}, the network wants {shape:?}", tensor.shape());
            return Err(mismatch(path, what));
        }
        if !is_float(&tensor) {
            return Err(mismatch(
                path,
                format!("`{name}` holds {:?}, not F32 or F16", tensor.dtype()),
            ));
        }
    }
    let known = |name: &str| expected.iter().any(|(e, _)| e == name || former_name(e) == name);
    if let Some(name) = tensors.names().into_iter().find(|name| !known(name)) {
        return Err(mismatch(path, format!("`{name}` belongs to no part of the network")));
    }
    let mut broken = None;
    let network = init_parameters(network, |name, shape| {
        let values = stored(name).map(|tensor| numbers(&tensor)).unwrap_or_default();
        if broken.is_none() && !values.iter().all(|value| value.is_finite()) {
            broken = Some(name.to_owned());
        }
        debug_assert_eq!(values.len(), shape.iter().product::<usize>());
        values
    });
    match broken {
        Some(name) => Err(Error::data(
            format!("`{name}` holds values that are not finite"),
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
        return Err(Error::data(
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
    let kind = match description.kind {
        Some(kind) => kind,
        None => inferred_kind(bytes, path)?,
    };
    Ok(Description { network, kind: Some(kind), ..description })
}

/// The kind of a network whose file does not say.
fn inferred_kind(bytes: &[u8], path: &Path) -> Result<ModelKind> {
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| damaged(path, e))?;
    Ok(ModelKind::from_zeros(|name| {
        let stored = tensors.tensor(name).ok().filter(is_float);
        stored.is_none_or(|tensor| numbers(&tensor).iter().all(|&value| value == 0.0))
    }))
}

fn is_float(tensor: &TensorView<'_>) -> bool {
    matches!(tensor.dtype(), Dtype::F32 | Dtype::F16)
}

fn damaged(path: &Path, error: impl std::fmt::Display) -> Error {
    Error::data(format!("not a whole SafeTensors file: {error}"), path, "copy or download it again")
}

fn mismatch(path: &Path, what: impl Into<String>) -> Error {
    Error::data(what, path, "the file is damaged, or of another version of the program")
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
    error: Option<Error>,
}

impl Values {
    /// Whether a parameter is zero as it will be read back.
    fn is_zero(&self, name: &str) -> bool {
        let list = self.list.iter().find(|(stored, ..)| stored == name);
        list.is_none_or(|(_, shape, bytes)| {
            let view = TensorView::new(self.precision.kind(), shape.clone(), bytes);
            view.is_ok_and(|view| numbers(&view).iter().all(|&value| value == 0.0))
        })
    }
}

impl ModuleVisitor for Values {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        match qudi_layers::tensor::read(param.val()) {
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
