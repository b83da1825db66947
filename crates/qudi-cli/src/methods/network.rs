//! The network behind `--method qudi`: weights, device, options.

use super::Built;
use super::options::NetworkOptions;
use super::trained::check;
use crate::device::{self, Opened};
use crate::error::{CliError, Result};
use crate::memory::{available_bytes, check_tiles};
use qudi_core::Size;
use qudi_core::restorer::Acquisition;
use qudi_model::checkpoint::ModelKind;
use qudi_model::restorer::{Model, QudiRestorer, SampleOptions};

/// The restorer, and how it makes frames: by regression or diffusion, and on which device.
pub(crate) fn restorer(
    options: &NetworkOptions,
    acquisition: &Acquisition,
    size: Size,
) -> Result<Built> {
    let device = device::open(&options.device)?;
    options.check_steps()?;
    let (network, description) = options.weights.load(&device.device)?;
    check(&description.provenance, acquisition)?;
    if device.is_processor() {
        let network = &description.network;
        let smallest = 4 * network.multiple();
        check_tiles([smallest, options.tile], size, available_bytes(), |size| {
            network.memory(size, description.window)
        })?;
    }
    let model = Model {
        network,
        config: description.network,
        kind: description.kind.unwrap_or(ModelKind::Diffusion),
        window: description.window,
    };
    let restorer = QudiRestorer::new(model, sample_options(options, &device)?, &device.device)?;
    let way = options.mode()?;
    Ok((Box::new(restorer), format!(" ({way}) on {}", device.name)))
}

pub(crate) fn sample_options(options: &NetworkOptions, device: &Opened) -> Result<SampleOptions> {
    Ok(SampleOptions {
        steps: options.steps()?,
        spacing: options.spacing()?,
        sampler: options.sampler,
        samples: options.samples,
        tile: options.tile,
        precision: options.precision(device)?,
    })
}

/// What went wrong on a device, with a way out; `problem` are its own words.
pub(crate) fn device_failed(problem: &str, options: &NetworkOptions) -> CliError {
    let half = options.tile / 2 / 32 * 32;
    let help = if half >= 64 {
        format!(
            "--tile {half} needs a quarter of the memory; `qudi selftest` checks the device; or --device cpu"
        )
    } else {
        "check the device with `qudi selftest`, or use --device cpu".to_owned()
    };
    CliError::new(format!("the device failed: {problem}"), &options.device, help)
}
