//! Weights in one SafeTensors file that describes itself.

mod description;
mod former;

use crate::config::{NetworkConfig, NetworkKind};
use crate::diffusion::Diffusion;
use crate::regression::Regression;
use crate::window::Window;
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Device, Tensor, f16};
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::limits::WEIGHT_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_core::{Error, Result};
use qudi_layers::{init_parameters, parameter_shapes};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::HashMap;
use std::path::Path;

pub use description::{Description, Sampling};

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

/// A network that weight files hold.
pub trait Network: Module {
    /// Kind of the network.
    const KIND: NetworkKind;

    /// Creates a network of these sizes without weights; none if they are of another kind.
    fn of_sizes(config: &NetworkConfig, device: &Device) -> Option<Self>;
}

impl Network for Regression {
    const KIND: NetworkKind = NetworkKind::Regression;

    fn of_sizes(config: &NetworkConfig, device: &Device) -> Option<Self> {
        let NetworkConfig::Regression(config) = config else { return None };
        Some(config.uninitialized(device))
    }
}

impl Network for Diffusion {
    const KIND: NetworkKind = NetworkKind::Diffusion;

    fn of_sizes(config: &NetworkConfig, device: &Device) -> Option<Self> {
        let NetworkConfig::Diffusion(config) = config else { return None };
        Some(config.uninitialized(device))
    }
}

impl Network for Window {
    const KIND: NetworkKind = NetworkKind::Window;

    fn of_sizes(config: &NetworkConfig, device: &Device) -> Option<Self> {
        let NetworkConfig::Window(config) = config else { return None };
        Some(config.uninitialized(device))
    }
}

/// Writes the network's weights, whole or not at all.
///
/// # Errors
/// [`Error`] if the file cannot be written or the device cannot be read.
pub fn save<N: Network>(
    network: &N,
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
            format!(
                "`{name}` holds values that are not finite, or beyond {:e}",
                precision.largest()
            ),
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
        Error::data(format!("cannot lay out the weights: {e}"), path, "report this")
    })?;
    PendingFile::write_whole(path, &bytes, overwrite)
}

/// Reads the description of a weight file alone.
///
/// # Errors
/// [`Error::Data`] if it is not a weight file of this program.
pub fn describe(path: &Path) -> Result<Description> {
    describe_bytes(&read_limited(path, WEIGHT_BYTES, "read the weights")?, path)
}

/// Reads the description of a weight file that is in memory; `place` names it in errors.
///
/// # Errors
/// [`Error::Data`] if it is not a weight file of this program.
pub fn describe_bytes(bytes: &[u8], place: &Path) -> Result<Description> {
    Ok(describe_layout(bytes, place)?.0)
}

/// [`load`]s a network from memory.
///
/// # Errors
/// As [`load`].
pub fn load_bytes<N: Network>(
    bytes: &[u8],
    place: &Path,
    device: &Device,
) -> Result<(N, Description)> {
    network(bytes, describe_layout(bytes, place)?, place, device)
}

/// Reads a network onto `device`. Nothing is allocated that the file does not hold.
///
/// # Errors
/// [`Error::Data`] if the file holds a network of another kind, does not fit its own description, or holds
/// values that are no numbers.
pub fn load<N: Network>(path: &Path, device: &Device) -> Result<(N, Description)> {
    load_bytes(&read_limited(path, WEIGHT_BYTES, "read the weights")?, path, device)
}

/// The names that a file has for parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Layout {
    /// The names of this version.
    Present,
    /// The names of version 0.1.0.
    Former,
}

/// Reads the network of a whole file, described by `description`.
fn network<N: Network>(
    bytes: &[u8],
    (description, layout): (Description, Layout),
    path: &Path,
    device: &Device,
) -> Result<(N, Description)> {
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| damaged(path, e))?;
    let Some(network) = N::of_sizes(&description.network, device) else {
        return Err(other_kind::<N>(&description, layout, path));
    };
    let name_of = |name: &str| match layout {
        Layout::Present => name.to_owned(),
        Layout::Former => former::name(name),
    };
    let expected = parameter_shapes(&network);
    for (name, shape) in &expected {
        let name = name_of(name);
        let Ok(tensor) = tensors.tensor(&name) else {
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
    let removed = |name: &str| {
        layout == Layout::Former && N::KIND == NetworkKind::Regression && former::is_removed(name)
    };
    let known = |name: &str| expected.iter().any(|(e, _)| name_of(e) == name) || removed(name);
    if let Some(name) = tensors.names().into_iter().find(|name| !known(name)) {
        return Err(mismatch(path, format!("`{name}` belongs to no part of the network")));
    }
    let mut broken = None;
    let network = init_parameters(network, |name, shape| {
        let stored = tensors.tensor(&name_of(name)).ok().map(|tensor| numbers(&tensor));
        let values = stored.unwrap_or_default();
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

/// Refuses a network of another kind than the one asked for.
fn other_kind<N: Network>(description: &Description, layout: Layout, path: &Path) -> Error {
    let kind = description.network.kind();
    let what = format!("these are weights of a {kind}, not of a {}", N::KIND);
    let method = if kind.is_diffusion() { "qudi-diffusion" } else { "qudi-regression" };
    let help = format!("use --method {method}, or name other weights");
    let diffused = layout == Layout::Former && kind == NetworkKind::Regression;
    let what = if diffused { format!("{what}; {}", former::NO_DIFFUSION) } else { what };
    Error::data(what, path, help)
}

fn describe_layout(bytes: &[u8], path: &Path) -> Result<(Description, Layout)> {
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| damaged(path, e))?;
    let text = header.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
    let Some(text) = text else {
        return Err(Error::data(
            "a SafeTensors file of another program",
            path,
            "weights of this program say so in their metadata; name a file that `qudi train` wrote",
        ));
    };
    let fault = |what: String| mismatch(path, format!("the description cannot be read: {what}"));
    let mut value: serde_json::Value =
        serde_json::from_str(text).map_err(|e| fault(e.to_string()))?;
    let is_former = former::modernize(&mut value).map_err(fault)?;
    let description: Description =
        serde_json::from_value(value).map_err(|e| fault(e.to_string()))?;
    let network = description.network.checked().map_err(|e| mismatch(path, e.to_string()))?;
    if !(3..=1000).contains(&description.window) {
        return Err(mismatch(path, format!("a window of {} frames", description.window)));
    }
    let layout = if is_former { Layout::Former } else { Layout::Present };
    Ok((Description { network, ..description }, layout))
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

/// Reads the values of a tensor of F32 or F16.
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

    /// Returns the largest value that can be written.
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
                let is_written = |value: &f32| value.abs() <= largest;
                if self.broken.is_none() && !values.iter().all(is_written) {
                    self.broken = Some(self.path.join("."));
                }
                let bytes = self.precision.bytes(&values);
                self.list.push((self.path.join("."), param.shape().to_vec(), bytes));
            }
            Err(error) => self.error = Some(error),
        }
    }
}
