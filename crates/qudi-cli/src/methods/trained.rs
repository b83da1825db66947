//! What weights were trained for, and whether a capture is like it.

use super::network::OwnNetwork;
use super::options::NetworkOptions;
use super::{Kind, Method};
use crate::error::{CliError, Result};
use crate::weights::{BuiltIn, Weights};
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::Sensor;
use qudi_layers::Provenance;

/// How far outside the light it was trained for a network may be used: it has not seen such noise.
const LIGHT_TOLERANCE: f64 = 10.0;

/// The light and the kind of counts that weights were trained for, of one of their sensors.
struct Trained {
    sensor: Sensor,
    /// Least and most detections per pixel and frame.
    detections: [f64; 2],
}

impl Trained {
    /// Of each sensor that a description lists; sums of binary frames as `name x frames`.
    fn all(provenance: &Provenance) -> Vec<Self> {
        let trained = |listed: &String| {
            let (name, frames) = listed.split_once(" x ").unwrap_or((listed, ""));
            let mut sensor = Sensor::load(name).ok()?;
            if let Ok(frames) = frames.parse() {
                sensor.frames_summed = frames;
            }
            let detections = provenance.ppp.map(|ppp| sensor.quantum_efficiency * ppp);
            Some(Self { sensor, detections })
        };
        provenance.sensors.iter().filter_map(trained).collect()
    }

    /// Returns true if counts of `sensor` are of this kind: the same response, and full scales within a
    /// factor of four.
    fn is_like(&self, sensor: &Sensor) -> bool {
        let ratio = f64::from(sensor.max_count()) / f64::from(self.sensor.max_count());
        self.sensor.response == sensor.response && (0.25..=4.0).contains(&ratio)
    }
}

/// Returns why the bundled weights are not for such a capture, if they are not.
pub(crate) fn unknown_to_built_in(acquisition: &Acquisition) -> Result<Option<String>> {
    Ok(unknown(&Weights::BuiltIn(BuiltIn::Regression).describe()?.provenance, acquisition, 1.0))
}

/// Returns true if the bundled weights were trained for such a capture.
pub(crate) fn built_in_knows(acquisition: &Acquisition) -> Result<bool> {
    Ok(unknown_to_built_in(acquisition)?.is_none())
}

/// Returns the property of a capture for which weights were not trained, if any. Light may lie outside their
/// range by the factor `tolerated`.
fn unknown(provenance: &Provenance, acquisition: &Acquisition, tolerated: f64) -> Option<String> {
    let sensor = &acquisition.sensor;
    let trained = Trained::all(provenance);
    // A sensor of the user's own is its user's to judge.
    if trained.len() < provenance.sensors.len() {
        return None;
    }
    let alike: Vec<&Trained> = trained.iter().filter(|trained| trained.is_like(sensor)).collect();
    if alike.is_empty() {
        let response = format!("{:?}", sensor.response).to_lowercase();
        return Some(format!(
            "sensor {} is {response} and counts up to {}; the weights were trained for {}",
            sensor.name,
            sensor.max_count(),
            provenance.sensors.join(", ")
        ));
    }
    let detections = sensor.quantum_efficiency * acquisition.ppp;
    let least = alike.iter().map(|t| t.detections[0]).fold(f64::INFINITY, f64::min);
    let most = alike.iter().map(|t| t.detections[1]).fold(0.0, f64::max);
    let known = least / tolerated <= detections && detections <= most * tolerated;
    (!known).then(|| {
        format!(
            "{detections:.4} detections per pixel and frame; the weights were trained for {least:.4} to {most:.4}"
        )
    })
}

/// Why weights are not for a capture: it is far outside what they were trained for.
pub(crate) fn refusal(provenance: &Provenance, acquisition: &Acquisition) -> Option<String> {
    unknown(provenance, acquisition, LIGHT_TOLERANCE)
}

/// Refuses a capture far outside what the weights were trained for.
pub(super) fn check(provenance: &Provenance, acquisition: &Acquisition) -> Result<()> {
    let Some(what) = refusal(provenance, acquisition) else { return Ok(()) };
    Err(CliError::mismatch(
        what,
        "--weights",
        "sum another number of frames (--sum N), give --ppp if the light was estimated wrongly, use --method qbp-refined, or train for this capture",
    ))
}

/// Returns the data on which the weights of a method were trained; nothing is known of authors' weights.
pub(crate) fn provenance(method: &Method, options: &NetworkOptions) -> Result<Option<Provenance>> {
    Ok(match method.kind {
        Kind::Learned { method, .. } => {
            let contents = options.weights_of(method)?.describe()?;
            contents.and_then(|contents| contents.description).map(|d| d.provenance)
        }
        Kind::Network(choice) => Some(OwnNetwork::new(options, choice)?.description.provenance),
        Kind::Classical(_) => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trained_for(sensors: &[&str]) -> Provenance {
        Provenance {
            program: String::new(),
            sensors: sensors.iter().map(|&name| name.to_owned()).collect(),
            ppp: [1.0, 30.0],
            data: Vec::new(),
            steps: 0,
            commit: None,
            licence: String::new(),
            recipes: Vec::new(),
        }
    }

    #[test]
    fn sensors_are_like_those_of_their_kind() {
        let load = |name: &str| Sensor::load(name).unwrap_or_else(|e| panic!("{e}"));
        let is_like = |sensor: &Sensor, trained: &str| {
            Trained::all(&trained_for(&[trained])).iter().any(|trained| trained.is_like(sensor))
        };
        let mut binary = load("swissspad2");
        assert!(is_like(&load("qudi-paper"), "qudi-paper"));
        assert!(!is_like(&binary, "qudi-paper"));
        assert!(is_like(&binary, "swissspad2"));
        assert!(!is_like(&binary, "swissspad2 x 7"));
        binary.frames_summed = 7;
        assert!(is_like(&binary, "spad512s x 15"));
    }

    #[test]
    fn light_is_compared_in_detections() {
        let sensor = Sensor::load("swissspad2").unwrap_or_else(|e| panic!("{e}"));
        let of = |ppp: f64, tolerated: f64| {
            let acquisition = Acquisition::new(sensor.clone(), ppp, 0.45);
            let acquisition = acquisition.unwrap_or_else(|e| panic!("{e}"));
            unknown(&trained_for(&["spad512s"]), &acquisition, tolerated)
        };
        // Trained from 1 to 30 photons by a sensor that detects more of them.
        let ratio = Sensor::load("spad512s").map_or(1.0, |s| s.quantum_efficiency)
            / sensor.quantum_efficiency;
        assert!(ratio > 1.5);
        assert!(of(1.05 * ratio, 1.0).is_none() && of(29.0 * ratio, 1.0).is_none());
        let dim = of(0.95 * ratio, 1.0).unwrap_or_default();
        assert!(dim.contains("detections per pixel and frame"), "{dim}");
        assert!(of(31.0 * ratio, 1.0).is_some() && of(31.0 * ratio, 10.0).is_none());
        let own = unknown(
            &trained_for(&["a sensor of the user's own"]),
            &Acquisition::new(sensor.clone(), 1e-6, 0.45).unwrap_or_else(|e| panic!("{e}")),
            1.0,
        );
        assert_eq!(own, None);
    }
}
