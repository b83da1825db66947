//! Keys of recipes as text: former names, and single keys that are changed.

use qudi_core::{Error, Result};

/// Former names of keys and their names now; both are read (`#[serde(alias)]` on the fields).
const RENAMED: &[(&str, &str)] = &[
    ("network.without", "network.ablate"),
    ("network.pre.motions", "network.pre.alignments"),
    ("network.pre.trust", "network.pre.weight_channels"),
    ("network.pre.rounds", "network.pre.stages"),
    ("network.pre.error", "network.pre.uncertainty"),
    ("data.source.rest", "data.source.static_fraction"),
    ("data.source.shrink", "data.source.max_downscale"),
    ("train.rate", "train.lr"),
    ("train.floor", "train.min_lr"),
    ("train.start", "train.noise_start_fraction"),
    ("train.parts", "train.crops"),
    ("train.crops.kept", "train.crops.cached_frames"),
];

/// Gives the keys of a table, and of the tables in it, their names of now. `path` is the table's place in the
/// recipe, without the numbers of list elements.
pub(super) fn modernize(table: &mut toml::Table, path: &str) {
    for (old, new) in RENAMED {
        let names = old.rsplit_once('.').zip(new.rsplit_once('.'));
        if let Some(((place, old), (_, new))) = names
            && place == path
            && !table.contains_key(new)
            && let Some(value) = table.remove(old)
        {
            table.insert(new.to_owned(), value);
        }
    }
    for (key, value) in table.iter_mut() {
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        let tables = match value {
            toml::Value::Array(list) => list.as_mut_slice(),
            value => std::slice::from_mut(value),
        };
        tables.iter_mut().filter_map(toml::Value::as_table_mut).for_each(|t| modernize(t, &path));
    }
}

/// A dotted key by its name of now: `train.rate` is `train.lr`.
pub(super) fn modern_key(key: &str) -> String {
    let mut modern: Vec<&str> = key.split('.').collect();
    for end in 1..=modern.len() {
        let is_name = |part: &&str| part.parse::<usize>().is_err();
        let path: Vec<_> = modern[..end].iter().copied().filter(is_name).collect();
        let path = path.join(".");
        let renamed = RENAMED.iter().find(|(old, _)| *old == path);
        if let Some((_, name)) = renamed.and_then(|(_, new)| new.rsplit_once('.')) {
            modern[end - 1] = name;
        }
    }
    modern.join(".")
}

/// A value of TOML, or a word as text.
pub(super) fn value(text: &str) -> toml::Value {
    let value = format!("v = {text}").parse::<toml::Table>().ok();
    let value = value.and_then(|mut table| table.remove("v"));
    value.unwrap_or_else(|| toml::Value::String(text.to_owned()))
}

/// Sets a key below tables; numbers name the elements of a list, as in `data.source.0.weight`.
pub(super) fn set(document: &mut toml::Table, key: &str, value: toml::Value) -> Result<()> {
    let unknown = || {
        let help = "name keys of the recipe, as in train.steps or data.source.0.weight";
        Error::request(format!("`{key}` is no key of the recipe"), key, help)
    };
    let (path, last) = key.rsplit_once('.').ok_or_else(unknown)?;
    let mut parts = path.split('.');
    let first = parts.next().ok_or_else(unknown)?;
    let mut at = document.get_mut(first).ok_or_else(unknown)?;
    for part in parts {
        at = match at {
            toml::Value::Table(table) => table.get_mut(part),
            toml::Value::Array(list) => part.parse().ok().and_then(|i: usize| list.get_mut(i)),
            _ => None,
        }
        .ok_or_else(unknown)?;
    }
    // Unknown names are found when the recipe is read.
    at.as_table_mut().ok_or_else(unknown)?.insert(last.to_owned(), value);
    Ok(())
}
