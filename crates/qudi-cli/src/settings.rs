//! Settings in layers: defaults, file, environment, `--set`, flags; each value knows its origin.
//!
//! Every command loads them, and says by name which keys of `--set` it does not take. Files and the
//! environment are shared between commands: known keys of other commands are no error there.

mod commands;
mod flags;
mod keys;
mod recipe_keys;
mod schema;
mod simulate;

pub(crate) use flags::KeyFlags;
pub(crate) use keys::keys;
pub(crate) use recipe_keys::{baseline_keys, recipe_keys};
pub(crate) use schema::Documented;

use crate::args::Global;
use crate::error::{CliError, Result};
use qudi_core::limits::TEXT_BYTES;
use qudi_core::nearest::nearest;
use qudi_core::regular_file::read_text;
use qudi_core::sensor::{Sensor, load_document, merge_documents};
use qudi_train::Recipe;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use std::path::Path;

/// Origin of values that are not set.
const DEFAULT: &str = "default";

/// The settings of one command.
#[derive(Clone, Debug)]
pub(crate) struct Settings {
    command: &'static str,
    /// The value of every key, in the order of [`keys()`], with its origin.
    values: Vec<(Value, String)>,
    /// Keys of a recipe that were set, with value and origin.
    recipe: Vec<(String, Value, String)>,
}

/// Origin of a key's value.
enum Origin<'a> {
    /// A file or the environment, which other commands read as well.
    Shared(&'a str),
    /// A flag of this command.
    Own(&'a str),
}

impl Origin<'_> {
    fn name(&self) -> &str {
        match self {
            Self::Shared(name) | Self::Own(name) => name,
        }
    }
}

impl Settings {
    /// Lays all layers of `command` over each other.
    pub(crate) fn load(global: &Global, command: &'static str) -> Result<Self> {
        let default = |key: &keys::Key| (key.documented.default.clone(), DEFAULT.to_owned());
        let values = keys().iter().map(default).collect();
        let mut settings = Self { command, values, recipe: Vec::new() };
        if let Some(path) = &global.config {
            settings.add_file(path)?;
        }
        settings.add_environment()?;
        for assignment in &global.set {
            let Some((name, text)) = assignment.split_once('=') else {
                return Err(CliError::new(
                    format!("`{assignment}` sets nothing"),
                    "--set",
                    "write KEY=VALUE, as in --set simulate.ppp=9.75",
                ));
            };
            settings.set(name.trim(), parse_value(text.trim()), text, &Origin::Own("--set"))?;
        }
        Ok(settings)
    }

    /// Lays flags over the other layers.
    pub(crate) fn with_flags(mut self, flags: &KeyFlags) -> Result<Self> {
        for (key, text) in &flags.0 {
            let flag = key.flag.map_or(String::new(), |flag| format!("--{}", flag.long));
            self.set(key.name(), parse_value(text), text, &Origin::Own(&flag))?;
        }
        Ok(self)
    }

    fn add_file(&mut self, path: &Path) -> Result<()> {
        let place = path.display().to_string();
        let help = "see `qudi config docs` for the keys and an example";
        let text = read_text(path, TEXT_BYTES, "read the settings")?;
        let document: Value = toml::from_str(&text).map_err(|e| {
            CliError::new(format!("not a TOML document: {}", e.message()), &place, help)
        })?;
        let mut leaves = Vec::new();
        flatten("", document, &mut leaves);
        for (name, value) in leaves {
            let text = value.to_string();
            self.set(&name, value, &text, &Origin::Shared(&place))?;
        }
        Ok(())
    }

    /// Adds the environment: `QUDI_SIMULATE_PPP=9.75` sets `simulate.ppp`.
    fn add_environment(&mut self) -> Result<()> {
        let parts = commands::SETTINGS.iter().chain(commands::RECIPE);
        let prefixes: Vec<String> = parts.map(|part| format!("{}_", variable(part))).collect();
        for (name, text) in std::env::vars_os() {
            let (Some(name), Some(text)) = (name.to_str(), text.to_str()) else { continue };
            if !prefixes.iter().any(|prefix| name.starts_with(prefix)) {
                continue;
            }
            let all = keys().iter().map(keys::Key::name);
            let all = all.chain(recipe_keys::names().iter().map(String::as_str));
            let Some(key) = all.clone().find(|key| variable(key) == name) else {
                let names: Vec<String> = all.map(variable).collect();
                let names: Vec<&str> = names.iter().map(String::as_str).collect();
                return Err(unknown_key(name, &names, "the environment"));
            };
            self.set(key, parse_value(text), text, &Origin::Shared(name))?;
        }
        Ok(())
    }

    /// Sets a key to `value`, which was written as `text`.
    fn set(&mut self, name: &str, value: Value, text: &str, origin: &Origin<'_>) -> Result<()> {
        let at = keys().iter().position(|key| key.name() == name);
        let of_recipe = commands::RECIPE.contains(&name.split('.').next().unwrap_or_default());
        if at.is_none() && !(of_recipe && recipe_keys::is_known(name)) {
            let names = keys().iter().map(keys::Key::name);
            let recipe = recipe_keys::names().iter().map(String::as_str);
            let names: Vec<_> = if of_recipe { recipe.collect() } else { names.collect() };
            return Err(unknown_key(name, &names, origin.name()));
        }
        if !commands::takes(self.command, name) {
            return match origin {
                Origin::Shared(_) => Ok(()),
                Origin::Own(place) => Err(self.not_taken(name, place)),
            };
        }
        // JSON has no NaN and no infinity: both arrive as null.
        if value.is_null() {
            return Err(CliError::new(
                format!("`{name}` is not a finite number"),
                origin.name(),
                "leave it out to keep the default",
            ));
        }
        let origin = origin.name().to_owned();
        let Some(at) = at else {
            self.recipe.push((name.to_owned(), value, origin));
            return Ok(());
        };
        let is_text = keys()[at].documented.is_text;
        let as_text = is_text && !value.is_string();
        let value = if as_text { Value::String(text.trim().to_owned()) } else { value };
        self.values[at] = (value, origin);
        Ok(())
    }

    fn not_taken(&self, key: &str, place: &str) -> CliError {
        let command = self.command;
        let part = key.split('.').next().unwrap_or_default();
        let takers: Vec<_> = commands::takers(part);
        let takers = takers.iter().filter(|taker| **taker != "config");
        let takers: Vec<_> = takers.map(|taker| format!("`qudi {taker}`")).collect();
        let own = match commands::taken(command) {
            none if none.is_empty() => "it takes no settings".to_owned(),
            parts => format!("it takes {parts}"),
        };
        let what = format!("`{key}` is not a setting of `qudi {command}`");
        CliError::new(what, place, format!("{own}; {part}.* is for {}", takers.join(", ")))
    }

    /// Refuses flags and keys of `--set` that begin so, since this run has no use for them.
    pub(crate) fn refuse(&self, prefixes: &[&str], why: &str) -> Result<()> {
        let meant = |name: &str| prefixes.iter().any(|prefix| name.starts_with(prefix));
        let given = self.iter().find(|(name, _, origin)| origin.starts_with("--") && meant(name));
        given.map_or(Ok(()), |(name, _, origin)| {
            Err(CliError::new(format!("`{name}` is not used {why}"), origin, "leave it out"))
        })
    }

    /// Returns all keys with value and origin.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&str, &Value, &str)> {
        keys()
            .iter()
            .zip(&self.values)
            .map(|(key, (value, origin))| (key.name(), value, origin.as_str()))
    }

    /// Returns the keys of a recipe that were set, with value and origin.
    pub(crate) fn recipe_changes(&self) -> &[(String, Value, String)] {
        &self.recipe
    }

    /// Loads a recipe with the keys that were set.
    pub(crate) fn recipe(&self, name: &str) -> Result<Recipe> {
        let changes = self.recipe.iter().map(|(key, value, _)| (key.clone(), toml_text(value)));
        Ok(Recipe::load(name, &changes.collect::<Vec<_>>())?)
    }

    /// Returns the value of a key; ask for an `Option` where it may be unset.
    pub(crate) fn get<T: DeserializeOwned>(&self, name: &str) -> Result<T> {
        let (value, origin) = self.find(name);
        serde_json::from_value(value.clone()).map_err(|e| {
            CliError::new(
                format!("`{name}` cannot be {value}: {e}"),
                origin,
                "see `qudi config docs` for its meaning",
            )
        })
    }

    /// Returns the value of a key if it is set.
    pub(crate) fn given<T: DeserializeOwned>(&self, name: &str) -> Result<Option<T>> {
        if self.find(name).1 == DEFAULT { Ok(None) } else { self.get(name).map(Some) }
    }

    /// Parses the value of a key that has a text form of its own.
    pub(crate) fn parse<T: std::str::FromStr<Err = String>>(
        &self,
        name: &str,
    ) -> Result<Option<T>> {
        let text: Option<String> = self.get(name)?;
        let (_, origin) = self.find(name);
        text.map(|text| {
            text.parse().map_err(|e: String| {
                CliError::new(e, origin, format!("see `{name}` in `qudi config docs`"))
            })
        })
        .transpose()
    }

    fn find(&self, name: &str) -> (&Value, &str) {
        let (_, value, origin) =
            self.iter().find(|entry| entry.0 == name).expect("asked for by the name of a key");
        (value, origin)
    }

    /// Loads a sensor by name or file, with all overrides of `[sensor]`.
    pub(crate) fn sensor(&self, name: &str) -> Result<Sensor> {
        self.overridden(load_document(name)?, name)
    }

    /// Applies all overrides of `[sensor]` to a sensor.
    pub(crate) fn adjusted(&self, sensor: Sensor) -> Result<Sensor> {
        if !self.overrides_sensor() {
            return Ok(sensor);
        }
        let name = sensor.name.clone();
        self.overridden(serde_json::to_value(sensor).unwrap_or(Value::Null), &name)
    }

    /// Returns true if a key of `[sensor]` is set.
    pub(crate) fn overrides_sensor(&self) -> bool {
        self.iter().any(|(key, value, _)| key.starts_with("sensor.") && !value.is_null())
    }

    fn overridden(&self, mut document: Value, place: &str) -> Result<Sensor> {
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
        Ok(Sensor::from_document(document, place)?)
    }
}

/// Returns the environment variable that sets a key.
fn variable(key: &str) -> String {
    format!("QUDI_{}", key.replace('.', "_").to_uppercase())
}

fn unknown_key(name: &str, names: &[&str], origin: &str) -> CliError {
    let hint = nearest(name, names).map_or(String::new(), |n| format!("did you mean `{n}`?  "));
    CliError::new(
        format!("unknown key `{name}`"),
        origin,
        format!("{hint}all keys: `qudi config docs`"),
    )
}

/// Parses a value in TOML notation; anything else is a string.
fn parse_value(text: &str) -> Value {
    let document = toml::from_str::<Value>(&format!("v = {text}"));
    match document.as_ref().ok().and_then(Value::as_object) {
        Some(document) if document.len() == 1 => document["v"].clone(),
        _ => Value::String(text.to_owned()),
    }
}

/// Formats a value in TOML notation.
pub(crate) fn toml_text(value: &Value) -> String {
    toml::Value::try_from(value).map_or_else(|_| value.to_string(), |value| value.to_string())
}

/// Collects the leaves of a document by dotted name.
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
