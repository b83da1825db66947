//! A burst with its reference estimate.

use crate::dataset::Sample;
use qudi_core::Size;
use qudi_model::conditioning::AlignedPlanes;

/// Frames of a burst with their reference estimate and aligned neighbours, made from all of its frames.
#[derive(Clone, Debug)]
pub(crate) struct ConditionedBurst {
    pub(crate) size: Size,
    pub(crate) sample: Sample,
    pub(crate) aligned: AlignedPlanes,
}
