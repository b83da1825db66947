//! What a run that is resumed may not change: it would continue another run.

use super::environment::ENVIRONMENT;
use crate::error::{CliError, Result};
use qudi_io::restore::Fingerprint;
use qudi_train::{RECIPE, Recipe};
use serde_json::Value;
use std::path::Path;

/// Keys that may change, or the tables they are in: how long, how often, and what fits into memory.
const CHANGEABLE_KEYS: &[&str] = &[
    "train.steps",
    "train.batch",
    "train.accumulate",
    "train.checkpoint",
    "train.precision",
    "train.gradient_checkpointing",
    "data.crop",
    "validation",
];

/// Refuses a recipe that differs from the run's own in what decides the steps taken so far.
pub(crate) fn check_recipe(folder: &Path, recipe: &Recipe) -> Result<()> {
    let path = folder.join(RECIPE);
    let own = Recipe::load(&path.display().to_string(), &[])?;
    let document = |recipe: &Recipe| serde_json::to_value(recipe).unwrap_or(Value::Null);
    let Some((key, was, is)) = difference("", &document(&own), &document(recipe)) else {
        return Ok(());
    };
    Err(CliError::new(
        format!("`{key}` of this run is {was}, and cannot become {is}"),
        path.display(),
        format!("start another run; with --resume only {} may change", CHANGEABLE_KEYS.join(", ")),
    ))
}

/// Refuses another pack than the one that the run has learnt from.
pub(crate) fn check_pack(folder: &Path, pack: &Path) -> Result<()> {
    let Ok(text) = std::fs::read_to_string(folder.join(ENVIRONMENT)) else { return Ok(()) };
    let environment: Value = serde_json::from_str(&text).unwrap_or(Value::Null);
    // Older runs did not note it.
    let Ok(was) = serde_json::from_value::<Fingerprint>(environment["pack"].clone()) else {
        return Ok(());
    };
    if !pack.is_file() {
        return Ok(());
    }
    let is = Fingerprint::of(pack)?;
    if was.agrees(&is) {
        return Ok(());
    }
    Err(CliError::new(
        format!("the run has learnt from a pack of {was}, and this one is of {is}"),
        pack.display(),
        "name the run's own pack with --pack, or start another run",
    ))
}

/// Finds the first key whose value differs and may not, with both values.
fn difference(key: &str, was: &Value, is: &Value) -> Option<(String, String, String)> {
    if CHANGEABLE_KEYS.contains(&key) || was == is {
        return None;
    }
    if let (Value::Object(first), Value::Object(second)) = (was, is) {
        return first.keys().chain(second.keys()).find_map(|name| {
            let below = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
            let value = |table: &serde_json::Map<String, Value>| table.get(name).cloned();
            let [was, is] = [first, second].map(|table| value(table).unwrap_or(Value::Null));
            difference(&below, &was, &is)
        });
    }
    // Recipes leave out values that are defaults.
    let shown = |value: &Value| match value {
        Value::Null => "its default".to_owned(),
        value => value.to_string(),
    };
    Some((key.to_owned(), shown(was), shown(is)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn names_the_first_change_that_is_refused() {
        let was = json!({"train": {"lr": 1e-3, "steps": 10}, "validation": {"every": 5}});
        let longer = json!({"train": {"lr": 1e-3, "steps": 20}, "validation": {"every": 7}});
        assert_eq!(difference("", &was, &longer), None);
        let muon = json!({"train": {"lr": 1e-3, "optimizer": "muon", "steps": 20}});
        let (key, from, to) = difference("", &was, &muon).unwrap();
        assert_eq!([key, from, to], ["train.optimizer", "its default", "\"muon\""]);
    }
}
