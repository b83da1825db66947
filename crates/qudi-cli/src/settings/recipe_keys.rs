//! The keys of recipes, and the built-in recipes that set them.

use super::flatten;
use super::schema::{Documented, keys_of, schema_of, variants};
use qudi_baselines::import::Method;
use qudi_train::{Recipe, recipe_names, recipe_table};
use serde_json::Value;
use std::sync::OnceLock;

/// Returns the keys of recipes for this program's own networks, each with the built-in recipes that set it.
pub(crate) fn recipe_keys() -> Vec<(Documented, Vec<&'static str>)> {
    let schema = schema_of::<Recipe>();
    let network = variants(&schema["properties"]["network"]).into_iter();
    let own = network.filter(|variant| method(variant).is_none());
    let mut keys: Vec<Documented> = Vec::new();
    for key in own.flat_map(|variant| keys_of(variant, "network.")) {
        match keys.iter_mut().find(|known| known.name == key.name) {
            Some(known) if known.values != key.values => {
                known.values += &format!(", {}", key.values);
            }
            Some(_) => {}
            None => keys.push(key),
        }
    }
    // Serde's tag of the variants has no documentation of its own.
    for key in keys.iter_mut().filter(|key| key.name == "network.kind") {
        "Kind of the network".clone_into(&mut key.doc);
    }
    let others = keys_of(&schema, "").into_iter();
    keys.extend(others.filter(|key| key.name != "network"));
    let set: Vec<_> = recipe_names().map(|name| (name, set_by(name))).collect();
    let names: Vec<String> = keys.iter().map(|key| key.name.clone()).collect();
    let with_recipes = |key: Documented| {
        let below = format!("{}.", key.name);
        // `network.flow` is a list in one kind of network and a table, whose keys have rows, in another.
        let has_rows_below = names.iter().any(|name| name.starts_with(&below));
        let own = |name: &str| !key.name.starts_with("network.") || Method::by_name(name).is_none();
        let sets = |(name, set): &&(&str, Vec<String>)| {
            own(name)
                && set
                    .iter()
                    .any(|set| *set == key.name || (!has_rows_below && set.starts_with(&below)))
        };
        let recipes = set.iter().filter(sets).map(|(name, _)| *name).collect();
        (key, recipes)
    };
    keys.into_iter().map(with_recipes).collect()
}

/// Returns the learned methods of others, each with the keys of its network.
pub(crate) fn baseline_keys() -> Vec<(String, Vec<Documented>)> {
    let schema = schema_of::<Recipe>();
    let network = variants(&schema["properties"]["network"]).into_iter();
    let keys = |variant| Some((method(variant)?.to_owned(), keys_of(variant, "network.")));
    let keys = network.filter_map(keys).map(|(method, mut keys)| {
        keys.retain(|key| key.name != "network.method");
        (method, keys)
    });
    keys.collect()
}

/// Returns the learned method that a network's schema is for.
fn method(schema: &Value) -> Option<&str> {
    schema["properties"]["method"]["const"].as_str()
}

/// Returns the keys that a built-in recipe sets, in it or in one of its stages.
fn set_by(name: &str) -> Vec<String> {
    let Some(mut table) = recipe_table(name) else { return Vec::new() };
    let mut keys = Vec::new();
    let stages = table.remove("stage").and_then(|stages| stages.as_array().cloned());
    for stage in stages.into_iter().flatten() {
        keys.extend(["stage.0.name".to_owned(), "stage.0.changes".to_owned()]);
        let changes = stage.get("changes").and_then(|changes| changes.as_table().cloned());
        keys.extend(changes.into_iter().flatten().map(|(key, _)| generic(&key)));
    }
    keys.extend(tables(serde_json::to_value(table).unwrap_or(Value::Null)));
    keys
}

/// Returns the names of all keys of all recipes, with `0` for numbers of entries.
pub(super) fn names() -> &'static [String] {
    static NAMES: OnceLock<Vec<String>> = OnceLock::new();
    NAMES.get_or_init(|| {
        let own = recipe_keys().into_iter().map(|(key, _)| key);
        let others = baseline_keys().into_iter().flat_map(|(_, keys)| keys);
        let mut names: Vec<_> = own.chain(others).map(|key| key.name).collect();
        names.push("network.method".to_owned());
        names.retain(|name| !name.starts_with("stage."));
        names.sort();
        names.dedup();
        names
    })
}

/// Returns true if recipes have such a key, or a table of that name.
pub(super) fn is_known(key: &str) -> bool {
    let generic = generic(key);
    let below = format!("{generic}.");
    names().iter().any(|name| *name == generic || name.starts_with(&below))
}

/// Returns a key with `0` for every number of an entry.
fn generic(key: &str) -> String {
    let part = |part: &'_ str| match part.parse::<usize>() {
        Ok(_) => "0".to_owned(),
        Err(_) => part.to_owned(),
    };
    key.split('.').map(part).collect::<Vec<_>>().join(".")
}

/// Returns the names of all leaves; tables in lists have `0` for their numbers.
fn tables(document: Value) -> Vec<String> {
    let mut leaves = Vec::new();
    flatten("", document, &mut leaves);
    let mut all = Vec::new();
    for (key, value) in leaves {
        match value {
            Value::Array(entries) if entries.first().is_some_and(Value::is_object) => {
                let below = entries.into_iter().flat_map(tables);
                all.extend(below.map(|name| format!("{key}.0.{name}")));
            }
            _ => all.push(key),
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Serialized recipes have no key that the schema lacks.
    #[test]
    fn keys_are_the_fields_of_recipes() {
        for name in recipe_names() {
            let recipe = Recipe::load(name, &[]).unwrap_or_else(|e| panic!("{name}: {e}"));
            let mut document = serde_json::to_value(recipe).unwrap_or_default();
            document.as_object_mut().map(|document| document.remove("stage"));
            for key in tables(document).into_iter().chain(set_by(name)) {
                // A light is a list or a table.
                let key = key.replace(".ppp.from", ".ppp").replace(".ppp.to", ".ppp");
                assert!(is_known(&key) || key.starts_with("stage."), "{name}: {key}");
            }
        }
    }

    #[test]
    fn every_key_is_documented() {
        let own = recipe_keys().into_iter().map(|(key, _)| key);
        for key in own.chain(baseline_keys().into_iter().flat_map(|(_, keys)| keys)) {
            assert!(!key.doc.is_empty() && !key.values.is_empty(), "{}", key.name);
        }
        assert!(baseline_keys().len() == qudi_baselines::import::METHODS.len());
    }
}
