//! Every key of `[simulate]` and `[sensor]`, and the flag of `qudi simulate` that sets it.
//!
//! All else derives from these: `qudi config docs`, the names of environment variables, the flags with their
//! help, and the check that every command applies a key or refuses it.

use super::schema::{Documented, keys_of, schema_of};
use super::simulate::Simulate;
use qudi_core::sensor::Sensor;
use serde_json::Value;
use std::sync::OnceLock;

/// One settings key.
#[derive(Debug)]
pub(crate) struct Key {
    /// Name, default, meaning and values.
    pub(crate) documented: Documented,
    /// The flag of `qudi simulate` that sets it.
    pub(crate) flag: Option<KeyFlag>,
}

impl Key {
    /// Returns the dotted name.
    pub(crate) fn name(&self) -> &str {
        &self.documented.name
    }
}

/// A flag that sets a key.
#[derive(Clone, Copy, Debug)]
pub(crate) struct KeyFlag {
    /// Name without dashes.
    pub(crate) long: &'static str,
    /// Placeholder of the value in `--help`.
    pub(crate) value: &'static str,
    /// Heading in `--help`.
    pub(crate) heading: &'static str,
}

/// Flags by key.
const FLAGS: &[(&str, [&str; 3])] = &[
    ("simulate.sensor", ["sensor", "NAME|FILE", "Sensor"]),
    ("simulate.ppp", ["ppp", "PPP", "Light"]),
    ("simulate.ppp_def", ["ppp-def", "MEANING", "Light"]),
    ("simulate.exposure", ["exposure", "VALUE", "Light"]),
    ("simulate.seed", ["seed", "N", "Options"]),
    ("simulate.transfer", ["transfer", "CURVE", "Light"]),
    ("simulate.white", ["white", "VALUE", "Light"]),
    ("simulate.frames", ["frames", "N", "Scene"]),
    ("simulate.instants", ["instants", "N", "Scene"]),
    ("simulate.frames_per_image", ["frames-per-image", "N", "Scene"]),
    ("simulate.motion", ["motion", "MOTION", "Scene"]),
    ("simulate.size", ["size", "HxW", "Scene"]),
    ("simulate.speed", ["speed", "PX", "Scene"]),
    ("simulate.scene_seed", ["scene-seed", "N", "Scene"]),
    ("sensor.bits", ["bits", "N", "Sensor"]),
    ("sensor.quantum_efficiency", ["qe", "0..1", "Sensor"]),
    ("sensor.dark", ["dark", "RATE", "Sensor"]),
    ("sensor.read_noise", ["read-noise", "E-", "Sensor"]),
    ("sensor.offset", ["offset", "DN", "Sensor"]),
    ("sensor.full_well", ["full-well", "E-", "Sensor"]),
    ("sensor.gain", ["gain", "GAIN", "Sensor"]),
    ("sensor.frames_summed", ["sum", "N", "Sensor"]),
    ("sensor.rolling_shutter", ["rolling-shutter", "0..1", "Sensor"]),
    ("sensor.colour.cfa", ["cfa", "PATTERN|FILE", "Sensor"]),
];

/// Keys of sensor files that describe the sensor, and are no settings.
const DESCRIPTIONS: &[&str] = &[
    "sensor.name",
    "sensor.summary",
    "sensor.height",
    "sensor.width",
    "sensor.sources",
    "sensor.unverified",
];

/// Returns all keys. The keys of `[sensor]` override the chosen sensor's own values, and have no default.
pub(crate) fn keys() -> &'static [Key] {
    static KEYS: OnceLock<Vec<Key>> = OnceLock::new();
    KEYS.get_or_init(|| {
        let simulate = keys_of(&schema_of::<Simulate>(), "simulate.");
        let sensor = keys_of(&schema_of::<Sensor>(), "sensor.").into_iter();
        let sensor = sensor.filter(|key| !DESCRIPTIONS.contains(&key.name.as_str()));
        let sensor = sensor.map(|key| Documented { default: Value::Null, ..key });
        let all = simulate.into_iter().chain(sensor);
        all.map(|documented| {
            let flag = FLAGS.iter().find(|(name, _)| *name == documented.name);
            let flag = flag.map(|&(_, [long, value, heading])| KeyFlag { long, value, heading });
            Key { documented, flag }
        })
        .collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_set_keys() {
        let is_key = |name: &str| keys().iter().any(|key| key.name() == name);
        for (name, _) in FLAGS {
            assert!(is_key(name), "{name}");
        }
        assert!(DESCRIPTIONS.iter().all(|name| !is_key(name)));
        assert!(keys().iter().all(|key| !key.documented.doc.is_empty()));
    }

    #[test]
    fn keys_are_the_fields_of_the_structs() {
        let fields = |value: Value| {
            let mut leaves = Vec::new();
            super::super::flatten("", value, &mut leaves);
            leaves.into_iter().map(|(name, _)| name).collect::<Vec<_>>()
        };
        let simulate = fields(serde_json::to_value(Simulate::default()).unwrap_or_default());
        let all: Vec<&str> = keys().iter().map(Key::name).collect();
        assert_eq!(
            all[..simulate.len()],
            simulate.iter().map(|n| format!("simulate.{n}")).collect::<Vec<_>>()
        );
        let sensor = Sensor::load("swissspad2").unwrap_or_else(|e| panic!("{e}"));
        for name in fields(serde_json::to_value(sensor).unwrap_or_default()) {
            let name = format!("sensor.{name}");
            assert!(
                all.contains(&name.as_str()) || DESCRIPTIONS.contains(&name.as_str()),
                "{name}"
            );
        }
    }
}
