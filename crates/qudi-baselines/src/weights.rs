//! Files of weights that were trained here: SafeTensors with the authors' keys and a description.

use crate::import::Network;
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::Tensor;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::{Error, Result};
use qudi_layers::{Provenance, StateDict, parameter_shapes};
use safetensors::tensor::{Dtype, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;

/// The key of the description among a file's metadata.
const KEY: &str = "qudi-baseline";

/// Description of weights that were trained here.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// The name of the method.
    pub method: String,
    /// The number of frames of a burst in training.
    pub frames: usize,
    /// Data, sensors and licence of its training.
    #[serde(flatten)]
    pub provenance: Provenance,
}

/// Writes a network's weights, whole or not at all.
///
/// # Errors
/// [`Error`] if the file cannot be written, the device cannot be read, or values are not finite.
pub fn save(
    network: &Network,
    description: &Description,
    path: &Path,
    overwrite: Overwrite,
) -> Result<()> {
    let mut values = Values { list: Vec::new(), problem: None };
    network.visit(&mut values);
    if let Some(problem) = values.problem {
        return Err(Error::request(problem, network.method().name(), "use --device cpu"));
    }
    let mut tensors = Vec::new();
    for ((ours, shape), values) in parameter_shapes(network).into_iter().zip(values.list) {
        let name = network.file_name(&ours);
        if !values.iter().all(|value| value.is_finite()) {
            return Err(Error::data(
                format!("`{name}` holds values that are not finite"),
                path,
                "the training that wrote it had failed: use an earlier checkpoint",
            ));
        }
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        tensors.push((name, shape, bytes));
    }
    let text = serde_json::to_string(description).expect("plain data");
    // One entry only: the library writes several in any order, and equal weights should make equal files.
    let metadata = HashMap::from([(KEY.to_owned(), text)]);
    let views = tensors.iter().map(|(name, shape, bytes)| {
        let view = TensorView::new(Dtype::F32, shape.clone(), bytes);
        (name, view.expect("as many bytes as the shape says"))
    });
    let bytes = safetensors::serialize(views, Some(metadata))
        .map_err(|e| Error::data(format!("cannot write the weights: {e}"), path, "report this"))?;
    PendingFile::write_whole(path, &bytes, overwrite)
}

/// Reads the description in a file; none in a file that this program did not write.
///
/// # Errors
/// [`Error::Data`] if the description cannot be read.
pub(crate) fn description(file: &StateDict) -> Result<Option<Description>> {
    let Some(text) = file.metadata(KEY) else { return Ok(None) };
    let description = serde_json::from_str(&text).map_err(|e| {
        let what = format!("the description cannot be read: {e}");
        Error::data(what, file.path(), "the file is damaged, or of another version of the program")
    })?;
    Ok(Some(description))
}

/// The values of all parameters.
struct Values {
    list: Vec<Vec<f32>>,
    /// The device's error in place of values.
    problem: Option<String>,
}

impl ModuleVisitor for Values {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let read = param.val().try_into_data().map_err(|e| e.to_string());
        match read.and_then(|data| data.try_into_vec::<f32>().map_err(|e| format!("{e:?}"))) {
            Ok(values) => self.list.push(values),
            Err(e) => self.problem = Some(format!("the device failed: {e}")),
        }
    }
}
