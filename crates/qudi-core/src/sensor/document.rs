//! Sensor files: TOML, alone or on top of a preset (`base = "swissspad2"`).

use super::{PRESETS, Sensor, preset};
use crate::colour::FilterChoice;
use crate::error::{Error, Result};
use crate::limits::TEXT_BYTES;
use crate::regular_file::read_text;
use serde_json::Value;
use std::path::Path;

impl Sensor {
    /// Loads a preset by name, or a TOML file by path.
    ///
    /// # Errors
    /// [`Error`] if there is no such preset or file, or if it describes no possible sensor.
    pub fn load(name_or_path: &str) -> Result<Self> {
        Self::from_document(load_document(name_or_path)?, name_or_path)
    }

    /// Reads and checks a sensor from its document.
    ///
    /// # Errors
    /// [`Error::Sensor`] for unknown keys, missing keys, wrong types and impossible values.
    pub fn from_document(document: Value, place: &str) -> Result<Self> {
        let help = "`qudi info SENSOR` shows every key; `base = \"qudi-paper\"` fills in the rest";
        let fault = |e: serde_path_to_error::Error<serde_json::Error>| Error::Sensor {
            what: e.to_string(),
            place: place.to_owned(),
            help: help.to_owned(),
        };
        let sensor: Self = serde_path_to_error::deserialize(document).map_err(fault)?;
        sensor.validate()?;
        Ok(sensor)
    }
}

/// Loads the document of a preset or a TOML file, with its `base` filled in, ready for overrides.
///
/// # Errors
/// [`Error`] if it cannot be found, read or parsed.
pub fn load_document(name_or_path: &str) -> Result<Value> {
    if let Some(preset) = preset(name_or_path) {
        return parse(preset.toml, name_or_path);
    }
    let path = Path::new(name_or_path);
    if path.extension().is_none_or(|e| e != "toml") {
        let names = preset_names();
        let nearest = crate::nearest::nearest(name_or_path, &names);
        let hint = nearest.map_or(String::new(), |n| format!("did you mean `{n}`?  "));
        return Err(Error::request(
            format!("no sensor named `{name_or_path}`"),
            "sensor",
            format!("{hint}list them with `qudi info --sensors`, or pass a .toml file"),
        ));
    }
    let text = read_text(path, TEXT_BYTES, "read the sensor file")?;
    let mut document = parse(&text, name_or_path)?;
    if let Some(base) = document.as_object_mut().and_then(|d| d.shift_remove("base")) {
        let base = base.as_str().map(str::to_owned).unwrap_or_default();
        let Some(preset) = preset(&base) else {
            return Err(Error::data(
                format!("no preset named `{base}` to start from"),
                path,
                format!("there are {}", preset_names().join(", ")),
            ));
        };
        let mut merged = parse(preset.toml, preset.name)?;
        merge_documents(&mut merged, document);
        document = merged;
    }
    // Paths of maps are relative to the sensor file.
    for key in ["/defects/dark_map", "/defects/bad_pixels", "/colour/cfa"] {
        if let Some(map) = document.pointer_mut(key)
            && let Some(name) = map.as_str()
            && (key != "/colour/cfa" || FilterChoice::is_picture(name))
            && let Some(folder) = path.parent()
        {
            let map_path = std::path::absolute(folder.join(name))
                .map_err(|e| Error::io("find the map", Path::new(name), e))?;
            *map = Value::String(map_path.to_string_lossy().into_owned());
        }
    }
    Ok(document)
}

/// Returns the names of all built-in sensors.
fn preset_names() -> Vec<&'static str> {
    PRESETS.iter().map(|preset| preset.name).collect()
}

fn parse(text: &str, place: &str) -> Result<Value> {
    let fault = |what: String, place: String| Error::Sensor {
        what,
        place,
        help: "see `qudi info swissspad2` for an example".to_owned(),
    };
    let document: toml::Value = toml::from_str(text).map_err(|e: toml::de::Error| {
        let line = e.span().map(|span| text[..span.start].lines().count().max(1));
        let line = line.map_or(String::new(), |line| format!(", line {line}"));
        fault(format!("not a TOML document: {}", e.message()), format!("{place}{line}"))
    })?;
    if let Some(key) = not_finite("", &document) {
        return Err(fault(format!("{key} is not a finite number"), place.to_owned()));
    }
    serde_json::to_value(document).map_err(|e| fault(e.to_string(), place.to_owned()))
}

/// Returns the first key whose value is NaN or infinite, which JSON could not hold.
fn not_finite(key: &str, value: &toml::Value) -> Option<String> {
    match value {
        toml::Value::Float(v) => (!v.is_finite()).then(|| key.to_owned()),
        toml::Value::Table(table) => table.iter().find_map(|(name, value)| not_finite(name, value)),
        toml::Value::Array(items) => items.iter().find_map(|value| not_finite(key, value)),
        _ => None,
    }
}

/// Lays `upper` over `lower`, table by table.
pub fn merge_documents(lower: &mut Value, upper: Value) {
    match (lower, upper) {
        (Value::Object(lower), Value::Object(upper)) => {
            for (key, value) in upper {
                merge_documents(lower.entry(key).or_insert(Value::Null), value);
            }
        }
        (lower, upper) => *lower = upper,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn errors_name_the_key() {
        let mut document = load_document("spad-qvga").unwrap();
        document["rolling_shutter"] = Value::Bool(true);
        let error = Sensor::from_document(document, "--set").unwrap_err().to_string();
        assert!(error.contains("rolling_shutter: invalid type"), "{error}");
        let mut document = load_document("spad-qvga").unwrap();
        document["defects"]["bad_pixels"] = Value::from(1);
        let error = Sensor::from_document(document, "--set").unwrap_err().to_string();
        assert!(error.contains("defects.bad_pixels: "), "{error}");
    }
}
