//! Layers of this network alone.

pub(super) mod attention;
pub(super) mod embedding;

/// The factor of a last layer's output that corrects a flow, in cells. Adam moves all weights by the same
/// amount: the sum of a whole layer's would jump.
pub(super) const FLOW_CORRECTION: f32 = 0.1;

/// The factor of a last layer's output that corrects an image, in sigmas of the merged frame's noise.
pub(super) const CORRECTION: f32 = 0.3;
