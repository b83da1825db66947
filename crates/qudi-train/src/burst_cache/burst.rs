//! A burst with what the network is given of it.

use crate::dataset::Sample;
use qudi_core::Size;
use qudi_model::aligned::Aligned;

/// Frames of a burst, for the regression with their reference estimate and aligned neighbours made from all
/// of its frames.
#[derive(Clone, Debug)]
pub(crate) struct ConditionedBurst {
    pub(crate) size: Size,
    pub(crate) sample: Sample,
    pub(crate) aligned: Option<Aligned<Vec<f32>>>,
}
