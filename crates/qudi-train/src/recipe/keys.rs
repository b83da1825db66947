//! Changes of single keys of a recipe.

use qudi_core::{Error, Result};

/// Parses a value of TOML; a word is text.
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
