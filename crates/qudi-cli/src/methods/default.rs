//! The default method: the best one that supports the capture.

use super::options::NetworkOptions;
use super::trained::unknown_to_built_in;
use super::{MLE, Method, QBP_REFINED, QUDI};
use crate::error::Result;
use qudi_core::restorer::Acquisition;
use qudi_io::capture::Capture;
use qudi_model::restorer::MIN_FRAMES;

/// The default method for a capture.
pub(crate) struct DefaultMethod {
    pub(crate) method: &'static Method,
    /// Why it is not the network.
    pub(crate) reason: Option<String>,
}

/// Returns the best method that supports the capture.
pub(crate) fn default_method(
    options: &NetworkOptions,
    capture: &Capture,
    acquisition: &Acquisition,
) -> Result<DefaultMethod> {
    options.check_weights(&[])?;
    let long_enough = capture.length().is_none_or(|frames| frames >= MIN_FRAMES as u64);
    let other = |method, reason| Ok(DefaultMethod { method, reason: Some(reason) });
    if options.given.own.is_some() || options.tile_flag.is_some() {
        return Ok(DefaultMethod { method: &QUDI, reason: None });
    }
    if acquisition.sensor.dark_per_frame().is_err() {
        let sensor = &acquisition.sensor.name;
        return other(&MLE, format!("the dark rate of `{sensor}` is unknown"));
    }
    if !long_enough {
        return other(&QBP_REFINED, format!("fewer than {MIN_FRAMES} frames"));
    }
    match unknown_to_built_in(acquisition)? {
        Some(reason) => other(&QBP_REFINED, reason),
        None => Ok(DefaultMethod { method: &QUDI, reason: None }),
    }
}
