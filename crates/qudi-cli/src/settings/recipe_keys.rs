//! The keys of recipes, found by serializing the built-in recipes.

use super::flatten;
use qudi_train::{Recipe, recipe_names};
use serde_json::Value;
use std::sync::OnceLock;

/// The recipe whose values stand in `qudi config docs`.
pub(super) const SHOWN: &str = "small";

/// Returns the keys of a recipe with their values, numbers of lists as `0`.
pub(super) fn of_preset(name: &str) -> Vec<(String, Value)> {
    let mut leaves = Vec::new();
    if let Ok(mut recipe) = Recipe::load(name, &[]) {
        // Stages change keys that are there already.
        recipe.stage.clear();
        let document = serde_json::to_value(recipe).unwrap_or(Value::Null);
        for (key, value) in tables(document) {
            leaves.push((key, value));
        }
    }
    leaves
}

/// Returns recipes of learned methods of others by name, with the sizes of their networks.
pub(super) fn baseline_sizes() -> Vec<(&'static str, Vec<(String, Value)>)> {
    let sizes = |name: &'static str| {
        let keys = of_preset(name).into_iter();
        let own = keys.filter_map(|(key, value)| {
            let key = key.strip_prefix("network.")?;
            Some((key.to_owned(), value))
        });
        let mut own: Vec<_> = own.collect();
        let at = own.iter().position(|(key, _)| key == "method")?;
        own.remove(at);
        Some((name, own))
    };
    recipe_names().filter_map(sizes).collect()
}

/// Returns all keys of the built-in recipes, numbers of lists as `0`.
pub(super) fn names() -> &'static [String] {
    static NAMES: OnceLock<Vec<String>> = OnceLock::new();
    NAMES.get_or_init(|| {
        let mut names = Vec::new();
        for preset in recipe_names() {
            names.extend(of_preset(preset).into_iter().map(|(key, _)| key));
        }
        names.sort();
        names.dedup();
        names
    })
}

/// Returns true if recipes have such a key, or a table of that name.
pub(super) fn is_known(key: &str, value: &Value) -> bool {
    let generic = generic(key);
    let below = format!("{generic}.");
    if names().iter().any(|name| *name == generic || name.starts_with(&below)) {
        return true;
    }
    // A key that no recipe writes, since it is optional or has another name by now.
    let change = [(key.to_owned(), super::toml_text(value))];
    recipe_names().any(|preset| Recipe::load(preset, &change).is_ok())
}

/// Returns the key with every number of a list as `0`.
fn generic(key: &str) -> String {
    let part = |part: &'_ str| match part.parse::<usize>() {
        Ok(_) => "0".to_owned(),
        Err(_) => part.to_owned(),
    };
    key.split('.').map(part).collect::<Vec<_>>().join(".")
}

/// Returns the leaves by dotted name, the first entry of lists of tables standing for all.
fn tables(document: Value) -> Vec<(String, Value)> {
    let mut leaves = Vec::new();
    flatten("", document, &mut leaves);
    let mut all = Vec::new();
    for (key, value) in leaves {
        match value {
            Value::Array(entries) if entries.first().is_some_and(Value::is_object) => {
                for entry in entries {
                    let below = tables(entry).into_iter();
                    all.extend(below.map(|(name, value)| (format!("{key}.0.{name}"), value)));
                }
            }
            value => all.push((key, value)),
        }
    }
    let mut seen = std::collections::HashSet::new();
    all.retain(|(key, _)| seen.insert(key.clone()));
    all
}
