//! Methods for captures behind a colour filter.

use crate::error::Result;
use crate::weights;
use qudi_burst::ColourRestorer;
use qudi_core::colour::ColourFilter;
use qudi_core::restorer::Restorer;

/// Methods whose colours the built-in network corrects: it learnt from theirs.
const CORRECTED: [&str; 2] = ["qudi-regression", "qudi-diffusion"];

/// Makes a method for gray captures restore luma behind a filter, and colours too if `with_chroma` is set.
pub(crate) fn behind_filter(
    method: Box<dyn Restorer>,
    filter: &ColourFilter,
    with_chroma: bool,
) -> Result<Box<dyn Restorer>> {
    let corrected = CORRECTED.contains(&method.name());
    let restorer = ColourRestorer::new(method, filter.clone(), with_chroma);
    Ok(Box::new(if corrected {
        restorer.with_corrector(Box::new(weights::colour_network()?))
    } else {
        restorer
    }))
}
