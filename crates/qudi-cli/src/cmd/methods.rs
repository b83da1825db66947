//! Methods by name.

use crate::args::Network;
use crate::cmd::network;
use crate::error::{Fault, Result};
use qudi_sim::capture::Capture;
use qudi_sim::restore::{Average, BurstView, Context, Mle, Restorer};

/// All methods.
pub(crate) const METHODS: &[&str] = &["average", "mle", "qudi"];

/// Windows of a clip that a method's settings are chosen on.
const SAMPLES: u64 = 4;

/// The method by name, and what it chose for this clip.
pub(crate) fn method(
    name: &str,
    capture: &mut Capture,
    context: &Context,
    options: &Network,
) -> Result<(Box<dyn Restorer>, String)> {
    match name {
        "average" => Ok((Box::new(Average), String::new())),
        "mle" => {
            let samples = sample_windows(capture)?;
            let size = capture.size();
            let views: Vec<_> = samples.iter().map(|frames| BurstView { size, frames }).collect();
            let mle = Mle::choose(&views, context);
            Ok((Box::new(mle), format!(" over {} frames", mle.length())))
        }
        "qudi" => network::restorer(options, context),
        other => Err(Fault::new(
            format!("no method named `{other}`"),
            "--method",
            format!("there are {}", METHODS.join(", ")),
        )),
    }
}

/// A few windows spread over the capture; the first ones of a file that only goes forward.
fn sample_windows(capture: &mut Capture) -> Result<Vec<Vec<Vec<u16>>>> {
    let length = capture.frames().min(11);
    let last = capture.frames() - length;
    let spread = if capture.forward_only() { last.min(SAMPLES * length) } else { last };
    let windows = SAMPLES.min(spread / length + 1);
    let mut samples = Vec::new();
    for n in 0..windows {
        let first = spread * n / (windows - 1).max(1);
        let mut frames = vec![vec![0; capture.size().pixels()]; length as usize];
        for (frame, counts) in (first..).zip(&mut frames) {
            capture.read(frame, counts)?;
        }
        samples.push(frames);
    }
    Ok(samples)
}
