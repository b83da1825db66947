//! The loss of a step in numbers.

use burn::tensor::Tensor;
use serde::ser::{Serialize, SerializeMap, Serializer};

/// The loss and its terms, each the mean over a step; of a term, over the batches that have it.
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

    /// Returns the mean of losses of the same network.
    pub(super) fn mean(losses: &[Self]) -> Self {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let totals: Vec<f64> = losses.iter().map(|loss| loss.total).collect();
        let mut terms: Vec<(&'static str, Vec<f64>)> = Vec::new();
        for &(name, value) in losses.iter().flat_map(|loss| &loss.terms) {
            match terms.iter_mut().find(|(term, _)| *term == name) {
                Some((_, values)) => values.push(value),
                None => terms.push((name, vec![value])),
            }
        }
        let terms = terms.into_iter().map(|(name, values)| (name, mean(&values)));
        Self { total: mean(&totals), terms: terms.collect() }
    }
}

/// The loss of one batch, on the device.
#[derive(Debug)]
pub(super) struct UnreadLoss {
    /// The total, then the terms.
    pub(super) numbers: Tensor<1>,
    names: Vec<&'static str>,
}

impl UnreadLoss {
    pub(super) fn new(total: &Tensor<1>, terms: &[(&'static str, Tensor<1>)]) -> Self {
        let tensors = std::iter::once(total).chain(terms.iter().map(|(_, term)| term));
        Self {
            numbers: Tensor::cat(tensors.cloned().collect(), 0).inner(),
            names: terms.iter().map(|(name, _)| *name).collect(),
        }
    }

    /// Takes as many numbers as the loss has.
    pub(super) fn values(&self, numbers: &mut impl Iterator<Item = f64>) -> LossValues {
        let total = numbers.next().unwrap_or_default();
        LossValues { total, terms: self.names.iter().copied().zip(numbers).collect() }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terms_are_means_over_the_batches_that_have_them() {
        let of = |total, terms: &[_]| LossValues { total, terms: terms.to_vec() };
        let losses =
            [of(3.0, &[("prediction", 1.0), ("flow", 6.0)]), of(1.0, &[("prediction", 2.0)])];
        let mean = LossValues::mean(&losses);
        assert_eq!(mean, of(2.0, &[("prediction", 1.5), ("flow", 6.0)]));
        assert_eq!(LossValues::mean(&[]), LossValues::default());
    }
}
