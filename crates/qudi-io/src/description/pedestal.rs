//! The pedestal of counts: the part that is subtracted, and the part that is kept so that noise below zero is
//! not cut off.

use super::options::ReadOptions;
use qudi_core::sensor::Sensor;

/// Returns `options` with the sensor's pedestal and threshold, if they set neither.
pub(crate) fn with_pedestal(options: &ReadOptions, sensor: Option<&Sensor>) -> ReadOptions {
    let mut options = options.clone();
    if options.offset.is_none()
        && options.threshold.is_none()
        && let Some(sensor) = sensor
    {
        options.offset = (sensor.offset > 0.0).then_some(sensor.offset);
        options.threshold = sensor.threshold;
    }
    options
}

/// Keeps a part of the pedestal in the counts of a sensor with read noise, if `options` ask for it, and
/// returns it in DN: signed values without a sign.
pub(crate) fn keep_pedestal(options: &mut ReadOptions, sensor: Option<&Sensor>) -> f64 {
    let (Some(offset), None, Some(sensor)) = (options.offset, options.threshold, sensor) else {
        return 0.0;
    };
    if !options.signed {
        return 0.0;
    }
    let kept = sensor.kept_pedestal(offset);
    options.offset = Some(offset - kept);
    kept
}
