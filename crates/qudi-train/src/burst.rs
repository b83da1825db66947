//! A burst with its reference estimate.

use crate::dataset::Sample;
use qudi_core::Size;
use qudi_model::measurement::GuidePlanes;

/// Frames of a burst and what classical restoration makes of all of its frames.
#[derive(Clone, Debug)]
pub(super) struct ConditionedBurst {
    pub(super) size: Size,
    pub(super) sample: Sample,
    pub(super) guide: GuidePlanes,
}
