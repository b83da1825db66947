//! The loss of a step in numbers.

use burn::tensor::Tensor;
use qudi_core::Result;
use qudi_layers::tensor::read;
use serde::ser::{Serialize, SerializeMap, Serializer};

/// The loss and its terms, each the mean over a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LossValues {
    /// The weighted sum.
    pub total: f64,
    /// The terms by name, as metrics call them.
    pub terms: Vec<(&'static str, f64)>,
}

impl LossValues {
    /// Returns a term by name; 0 for a network without a term of this name.
    pub fn term(&self, name: &str) -> f64 {
        self.terms.iter().find(|(term, _)| *term == name).map_or(0.0, |(_, value)| *value)
    }

    /// Reads the terms from the device.
    pub(super) fn read(total: &Tensor<1>, terms: &[(&'static str, Tensor<1>)]) -> Result<Self> {
        let tensors = std::iter::once(total).chain(terms.iter().map(|(_, term)| term));
        let numbers = read(Tensor::cat(tensors.cloned().collect(), 0).inner())?;
        let mut numbers = numbers.into_iter().map(f64::from);
        let total = numbers.next().unwrap_or_default();
        Ok(Self { total, terms: terms.iter().map(|(name, _)| *name).zip(numbers).collect() })
    }

    /// Adds a share of the losses of the same network.
    pub(super) fn add(&mut self, other: &Self, share: f64) {
        self.total += share * other.total;
        for (name, value) in &other.terms {
            match self.terms.iter_mut().find(|(term, _)| term == name) {
                Some((_, sum)) => *sum += share * value,
                None => self.terms.push((name, share * value)),
            }
        }
    }
}

/// Beside one another: the total first.
impl Serialize for LossValues {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(1 + self.terms.len()))?;
        map.serialize_entry("total", &self.total)?;
        for (name, value) in &self.terms {
            map.serialize_entry(name, value)?;
        }
        map.end()
    }
}
