//! Settings in layers: defaults, file, environment, `--set`, flags; each value knows its origin.

use crate::args::Global;
use crate::error::{Fault, Result};
use crate::keys::KEYS;
use qudi_core::nearest::nearest;
use qudi_core::sensor::{Sensor, load_document, merge_documents};
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use std::path::Path;

/// Settings files are a page long; anything much larger is something else.
const MAX_FILE: u64 = 1 << 20;

/// A flag that sets a key: the key, the flag's name, and its value if given.
pub(crate) type Flag = (&'static str, &'static str, Option<Value>);

/// The value of every key, in the order of [`KEYS`], with its origin.
#[derive(Debug)]
pub(crate) struct Settings {
    values: Vec<(Value, String)>,
}

impl Settings {
    /// Lays all layers over each other.
    pub(crate) fn load(global: &Global, flags: Vec<Flag>) -> Result<Self> {
        let default = |text: &str| if text.is_empty() { Value::Null } else { parse_value(text) };
        let values = KEYS.iter().map(|key| (default(key.default), "default".to_owned())).collect();
        let mut settings = Self { values };
        if let Some(path) = &global.config {
            settings.add_file(path)?;
        }
        settings.add_environment()?;
        for assignment in &global.set {
            let Some((name, value)) = assignment.split_once('=') else {
                return Err(Fault::new(
                    format!("`{assignment}` sets nothing"),
                    "--set",
                    "write KEY=VALUE, as in --set simulate.ppp=9.75",
                ));
            };
            settings.set(name.trim(), parse_value(value.trim()), "--set")?;
        }
        for (name, flag, value) in flags {
            if let Some(value) = value {
                settings.set(name, value, flag)?;
            }
        }
        Ok(settings)
    }

    fn add_file(&mut self, path: &Path) -> Result<()> {
        let place = path.display().to_string();
        let fault = |what: String| {
            Fault::new(
                what,
                &place,
                "see `qudi config docs` for the keys and configs/ for examples",
            )
        };
        let read = |e: std::io::Error| fault(format!("cannot read the settings: {e}"));
        let length = std::fs::metadata(path).map_err(read)?.len();
        if length > MAX_FILE {
            return Err(fault(format!(
                "a settings file of {length} bytes is over the limit of {MAX_FILE}"
            )));
        }
        let text = std::fs::read_to_string(path).map_err(read)?;
        let document: Value = toml::from_str(&text)
            .map_err(|e| fault(format!("not a TOML document: {}", e.message())))?;
        let mut leaves = Vec::new();
        flatten("", document, &mut leaves);
        leaves.into_iter().try_for_each(|(name, value)| self.set(&name, value, &place))
    }

    /// `QUDI_SIMULATE_PPP=9.75` sets `simulate.ppp`.
    fn add_environment(&mut self) -> Result<()> {
        let variable = |name: &str| format!("QUDI_{}", name.replace('.', "_").to_uppercase());
        for (name, value) in std::env::vars_os() {
            let (Some(name), Some(value)) = (name.to_str(), value.to_str()) else { continue };
            let concerns_settings =
                name.starts_with("QUDI_SIMULATE_") || name.starts_with("QUDI_SENSOR_");
            if !concerns_settings {
                continue;
            }
            let Some(key) = KEYS.iter().find(|key| variable(key.name) == name) else {
                let names: Vec<String> = KEYS.iter().map(|key| variable(key.name)).collect();
                let names: Vec<&str> = names.iter().map(String::as_str).collect();
                return Err(unknown_key(name, &names, "the environment"));
            };
            self.set(key.name, parse_value(value), name)?;
        }
        Ok(())
    }

    fn set(&mut self, name: &str, value: Value, origin: &str) -> Result<()> {
        let Some(at) = KEYS.iter().position(|key| key.name == name) else {
            let names: Vec<_> = KEYS.iter().map(|key| key.name).collect();
            return Err(unknown_key(name, &names, origin));
        };
        // JSON has no NaN and no infinity: both arrive as null.
        if value.is_null() {
            return Err(Fault::new(
                format!("`{name}` is not a finite number"),
                origin,
                "leave it out to keep the default",
            ));
        }
        self.values[at] = (value, origin.to_owned());
        Ok(())
    }

    /// All keys with value and origin.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&'static str, &Value, &str)> {
        KEYS.iter()
            .zip(&self.values)
            .map(|(key, (value, origin))| (key.name, value, origin.as_str()))
    }

    /// The value of a key; ask for an `Option` where it may be unset.
    pub(crate) fn get<T: DeserializeOwned>(&self, name: &str) -> Result<T> {
        let (value, origin) = self.find(name);
        serde_json::from_value(value.clone()).map_err(|e| {
            Fault::new(
                format!("`{name}` cannot be {value}: {e}"),
                origin,
                "see `qudi config docs` for its meaning",
            )
        })
    }

    /// The value of a key that has a text form of its own.
    pub(crate) fn parse<T: std::str::FromStr<Err = String>>(
        &self,
        name: &str,
    ) -> Result<Option<T>> {
        let text: Option<String> = self.get(name)?;
        let (_, origin) = self.find(name);
        text.map(|text| {
            text.parse().map_err(|e: String| {
                Fault::new(e, origin, format!("see `{name}` in `qudi config docs`"))
            })
        })
        .transpose()
    }

    fn find(&self, name: &str) -> (&Value, &str) {
        let (_, value, origin) =
            self.iter().find(|entry| entry.0 == name).expect("asked for by its name in KEYS");
        (value, origin)
    }

    /// The chosen sensor with all overrides of `[sensor]`.
    pub(crate) fn sensor(&self) -> Result<Sensor> {
        let name: String = self.get("simulate.sensor")?;
        let mut document = load_document(&name)?;
        let mut overrides = Value::Object(Map::new());
        for (key, value, _) in
            self.iter().filter(|(key, value, _)| key.starts_with("sensor.") && !value.is_null())
        {
            let mut nested = value.clone();
            for part in key.split('.').skip(1).collect::<Vec<_>>().into_iter().rev() {
                nested = json!({ part: nested });
            }
            merge_documents(&mut overrides, nested);
        }
        merge_documents(&mut document, overrides);
        Ok(Sensor::from_document(document, &name)?)
    }
}

fn unknown_key(name: &str, names: &[&str], origin: &str) -> Fault {
    let hint = nearest(name, names).map_or(String::new(), |n| format!("did you mean `{n}`?  "));
    Fault::new(
        format!("unknown key `{name}`"),
        origin,
        format!("{hint}all keys: `qudi config docs`"),
    )
}

/// A value in TOML notation; anything else is a string.
fn parse_value(text: &str) -> Value {
    let document = toml::from_str::<Value>(&format!("v = {text}"));
    match document.as_ref().ok().and_then(Value::as_object) {
        Some(document) if document.len() == 1 => document["v"].clone(),
        _ => Value::String(text.to_owned()),
    }
}

/// Leaves of a document by dotted name.
fn flatten(prefix: &str, value: Value, leaves: &mut Vec<(String, Value)>) {
    match value {
        Value::Object(table) => {
            for (key, value) in table {
                let name = if prefix.is_empty() { key } else { format!("{prefix}.{key}") };
                flatten(&name, value, leaves);
            }
        }
        leaf => leaves.push((prefix.to_owned(), leaf)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_toml_or_text() {
        assert_eq!(parse_value("3.25"), json!(3.25));
        assert_eq!(parse_value("7"), json!(7));
        assert_eq!(parse_value("\"unit\""), json!("unit"));
        assert_eq!(parse_value("7.5/s"), json!("7.5/s"));
        assert_eq!(parse_value("1\nx = 2"), json!("1\nx = 2"));
    }

    #[test]
    fn every_default_is_toml_and_every_sensor_key_exists() {
        let paper = serde_json::to_value(Sensor::load("qudi-paper").unwrap()).unwrap();
        for key in KEYS {
            if !key.default.is_empty() {
                assert!(
                    toml::from_str::<Value>(&format!("v = {}", key.default)).is_ok(),
                    "{}",
                    key.name
                );
            }
            if let Some(path) = key.name.strip_prefix("sensor.") {
                let known = paper.pointer(&format!("/{}", path.replace('.', "/"))).is_some();
                assert!(
                    known || key.name.ends_with("dark_map") || key.name.ends_with("bad_pixels"),
                    "{}",
                    key.name
                );
            }
        }
    }
}
