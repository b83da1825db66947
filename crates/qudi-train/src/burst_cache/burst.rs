//! A burst with what the network is given of it.

use crate::dataset::Sample;
use qudi_core::Size;
use qudi_model::conditioning::AlignedPlanes;

/// Frames of a burst, with their reference estimate and aligned neighbours made from all of its frames, if
/// the network has any.
#[derive(Clone, Debug)]
pub(crate) struct ConditionedBurst {
    pub(crate) size: Size,
    pub(crate) sample: Sample,
    pub(crate) aligned: Option<AlignedPlanes>,
}
