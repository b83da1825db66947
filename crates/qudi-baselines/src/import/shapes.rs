//! The shapes of a file's tensors, which sizes are read off.

use crate::method::MAX_SIZE;
use qudi_core::{Error, Result};
use qudi_layers::StateDict;

/// Names and shapes of a file.
pub(crate) struct Shapes<'a> {
    file: &'a StateDict,
    names: Vec<String>,
}

impl<'a> Shapes<'a> {
    pub(super) fn new(file: &'a StateDict) -> Self {
        Self { file, names: file.names() }
    }

    /// Returns the length of one axis of a tensor.
    ///
    /// # Errors
    /// [`Error::Data`] if there is no such axis, or its length is impossible.
    pub(crate) fn side(&self, name: &str, axis: usize) -> Result<usize> {
        let help = "these are weights of another network, or the file is damaged";
        match self.file.shape(name).and_then(|shape| shape.get(axis).copied()) {
            Some(side) if (1..=MAX_SIZE).contains(&side) => Ok(side),
            Some(side) => {
                Err(Error::data(format!("`{name}` has a side of {side}"), self.file.path(), help))
            }
            None => Err(Error::data(format!("`{name}` is missing"), self.file.path(), help)),
        }
    }

    /// Returns the number of entries of a list, which are numbered from 0.
    pub(crate) fn count(&self, list: &str) -> usize {
        let number = |name: &String| {
            let rest = name.strip_prefix(list)?.strip_prefix('.')?;
            rest.split('.').next()?.parse::<usize>().ok()
        };
        self.names.iter().filter_map(number).max().map_or(0, |last| last.min(MAX_SIZE) + 1)
    }

    /// Returns true if the name of a tensor begins so.
    pub(crate) fn has_prefix(&self, prefix: &str) -> bool {
        self.names.iter().any(|name| name.starts_with(prefix))
    }
}
