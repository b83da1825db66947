//! A burst with its reference estimate.

use crate::dataset::Sample;
use qudi_core::Size;
use qudi_model::measurement::GuidePlanes;

/// Frames of a burst and what classical restoration makes of all of its frames.
#[derive(Clone, Debug)]
pub(crate) struct ConditionedBurst {
    pub(crate) size: Size,
    pub(crate) sample: Sample,
    pub(crate) guide: GuidePlanes,
}
