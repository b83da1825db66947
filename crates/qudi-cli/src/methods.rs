//! Methods by name.

pub(crate) mod learned;
pub(crate) mod network;
pub(crate) mod options;
pub(crate) mod trained;

use crate::error::{CliError, Result};
use options::NetworkOptions;
use qudi_baselines::import::Method;
use qudi_burst::{Average, Mle, PostFilter, Qbp, QbpRefined, Transform, TransformDenoise};
use qudi_core::restorer::{Acquisition, BurstView, Restorer};
use qudi_io::capture::Capture;
use qudi_model::config::NetworkKind;
use qudi_model::restorer::MIN_FRAMES;

/// All methods.
pub(crate) const METHODS: &[&str] = &[
    "average",
    "mle",
    "transform-denoise",
    "bm3d",
    "qbp",
    "qbp-bm3d",
    "qbp-refined",
    "qudi",
    "qudi-regression",
    "qudi-diffusion",
    "quiver",
    "emvd",
    "flornn",
    "spk2imgnet",
    "memdeblur",
    "rvrt",
    "student-teacher",
];

/// The former name of `qbp-refined`, which scripts may still use.
const FORMER_QBP_REFINED: &str = "guide";

/// Whether a method has this name or had it formerly.
pub(crate) fn is_method(name: &str) -> bool {
    METHODS.contains(&name) || name == FORMER_QBP_REFINED
}

/// Whether a method is a network, whose weights take time to read.
pub(crate) fn is_network(name: &str) -> bool {
    own_kind(name).is_some() || Method::by_name(name).is_some()
}

/// Returns the kind of a network of this project by the name of its method; `qudi` has no kind of its own.
pub(crate) fn own_kind(name: &str) -> Option<Option<NetworkKind>> {
    match name {
        "qudi" => Some(None),
        "qudi-regression" => Some(Some(NetworkKind::Regression)),
        "qudi-diffusion" => Some(Some(NetworkKind::Diffusion)),
        _ => None,
    }
}

/// Windows of a clip that a method's settings are chosen on.
const SAMPLES: u64 = 4;

/// The method by name, and what it chose for this clip.
pub(crate) fn method(
    name: &str,
    capture: &mut Capture,
    acquisition: &Acquisition,
    options: &NetworkOptions,
) -> Result<(Box<dyn Restorer>, String)> {
    match name {
        "average" => Ok((Box::new(Average), String::new())),
        "mle" => {
            let mle = sampled(capture, |views| Mle::choose(views, acquisition))?;
            Ok((Box::new(mle), over(mle.length())))
        }
        "transform-denoise" | "bm3d" => {
            let transform = if name == "bm3d" { Transform::Identity } else { Transform::Integral };
            let chosen =
                sampled(capture, |views| TransformDenoise::choose(transform, views, acquisition))?;
            Ok((Box::new(chosen), over(chosen.length())))
        }
        "qbp" => Ok((Box::new(Qbp::new(PostFilter::None)), String::new())),
        "qbp-bm3d" => Ok((Box::new(Qbp::new(PostFilter::Bm3d)), String::new())),
        "qbp-refined" | FORMER_QBP_REFINED => Ok((Box::new(QbpRefined), String::new())),
        other => match (own_kind(other), Method::by_name(other)) {
            (Some(kind), _) => network::restorer(kind, options, acquisition, capture.size()),
            (None, Some(method)) => learned::restorer(method, options, acquisition, capture.size()),
            (None, None) => Err(CliError::new(
                format!("no method named `{other}`"),
                "--method",
                format!("there are {}", METHODS.join(", ")),
            )),
        },
    }
}

/// The method of those who name none.
pub(crate) struct UsualMethod {
    pub(crate) name: &'static str,
    /// Why it is not the network.
    pub(crate) reason: Option<String>,
}

/// The method of those who name none: the best that knows what to do with this capture.
pub(crate) fn usual_method(
    options: &NetworkOptions,
    capture: &Capture,
    acquisition: &Acquisition,
) -> Result<UsualMethod> {
    options.check_weights(&[])?;
    let long_enough = capture.length().is_none_or(|frames| frames >= MIN_FRAMES as u64);
    let other = |name, reason| Ok(UsualMethod { name, reason: Some(reason) });
    if options.own_flag.or(options.tile_flag).is_some() {
        return Ok(UsualMethod { name: "qudi", reason: None });
    }
    if acquisition.sensor.dark_per_frame().is_err() {
        let sensor = &acquisition.sensor.name;
        return other("mle", format!("the dark rate of `{sensor}` is unknown"));
    }
    if !long_enough {
        return other("qbp-refined", format!("fewer than {MIN_FRAMES} frames"));
    }
    match trained::unknown_to_built_in(acquisition)? {
        Some(reason) => other("qbp-refined", reason),
        None => Ok(UsualMethod { name: "qudi", reason: None }),
    }
}

fn over(frames: usize) -> String {
    format!(" over {frames} frames")
}

/// What `choose` makes of a few windows of the capture.
fn sampled<T>(capture: &mut Capture, choose: impl FnOnce(&[BurstView<'_>]) -> T) -> Result<T> {
    let samples = sample_windows(capture)?;
    let size = capture.size();
    let views: Vec<_> = samples.iter().map(|frames| BurstView { size, frames }).collect();
    Ok(choose(&views))
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
