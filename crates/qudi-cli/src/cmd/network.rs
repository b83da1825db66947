//! The network behind `--method qudi`: weights, device, options.

use crate::args::{Network, SamplerName};
use crate::device;
use crate::error::{Fault, Result};
use qudi_model::checkpoint::{self, Description};
use qudi_model::restorer::{QudiRestorer, SampleOptions};
use qudi_model::sampler::Sampler;
use qudi_sim::restore::{Context, Restorer};

/// How far outside the light it was trained for a network may be used: it has not seen such noise.
const TOLERATED: f64 = 10.0;

/// The restorer, and what it runs on.
pub(crate) fn restorer(
    options: &Network,
    context: &Context,
) -> Result<(Box<dyn Restorer>, String)> {
    let Some(path) = &options.weights else {
        return Err(Fault::new(
            "the network needs weights",
            "--weights",
            "name a file that `qudi train` wrote, or use another --method",
        ));
    };
    let device = device::open(&options.device)?;
    let (network, description) = checkpoint::load(path, &device.device)?;
    check(&description, context)?;
    let (config, window) = (&description.network, description.window);
    let sampling = sample_options(options);
    let restorer = QudiRestorer::new(network, config, window, sampling, &device.device)?;
    let steps = options.steps;
    let choice =
        format!(" in {steps} step{} on {}", if steps == 1 { "" } else { "s" }, device.name);
    Ok((Box::new(restorer), choice))
}

pub(crate) fn sample_options(options: &Network) -> SampleOptions {
    SampleOptions {
        steps: options.steps,
        sampler: match options.sampler {
            SamplerName::Ddim => Sampler::Ddim,
            SamplerName::Ancestral => Sampler::Ancestral,
        },
        samples: options.samples,
        tile: options.tile,
    }
}

/// Refuses a capture far outside what the weights were trained for.
fn check(description: &Description, context: &Context) -> Result<()> {
    let [least, most] = description.ppp;
    if context.ppp < least / TOLERATED || context.ppp > most * TOLERATED {
        return Err(Fault::new(
            format!(
                "{:.4} photons per pixel and frame; the weights know {least} to {most}",
                context.ppp
            ),
            "--weights",
            "sum frames (--sum N) or average fewer, give --ppp if it was estimated wrongly, or train for this light",
        ));
    }
    Ok(())
}
