//! Keys with their types, defaults and meanings, read off the JSON schemas of structs: their doc comments are
//! the documentation.

use super::toml_text;
use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde_json::Value;

/// A key of a document.
#[derive(Clone, Debug)]
pub(crate) struct Documented {
    /// The dotted name, with `0` for the number of an entry in a list.
    pub(crate) name: String,
    /// Types or words that it takes.
    pub(crate) values: String,
    /// The value if the key is not set; null for none.
    pub(crate) default: Value,
    /// True if the key must be set.
    pub(crate) is_required: bool,
    /// True if it takes text alone.
    pub(crate) is_text: bool,
    /// The meaning.
    pub(crate) doc: String,
}

/// Returns the schema of a type, with the schemas of its fields inside.
pub(super) fn schema_of<T: JsonSchema>() -> Value {
    let settings =
        SchemaSettings::draft2020_12().with(|settings| settings.inline_subschemas = true);
    settings.into_generator().into_root_schema_for::<T>().to_value()
}

/// Returns all keys of an object, in the order of its fields, with `prefix` before their names.
pub(super) fn keys_of(schema: &Value, prefix: &str) -> Vec<Documented> {
    let mut keys = Vec::new();
    for (name, field) in schema["properties"].as_object().into_iter().flatten() {
        let required = schema["required"].as_array().into_iter().flatten();
        let is_required = required.into_iter().any(|required| required == name);
        let name = format!("{prefix}{name}");
        let inner = without_null(field);
        if inner["properties"].is_object() {
            keys.extend(keys_of(inner, &format!("{name}.")));
        } else if inner["items"]["properties"].is_object() {
            keys.extend(keys_of(&inner["items"], &format!("{name}.0.")));
        } else {
            keys.push(Documented {
                values: values(inner),
                default: field["default"].clone(),
                is_required,
                is_text: is_text(inner),
                doc: meaning(field, inner),
                name,
            });
        }
    }
    keys
}

/// Returns the schemas that one of which holds, or the schema itself.
pub(super) fn variants(schema: &Value) -> Vec<&Value> {
    match schema["anyOf"].as_array().or(schema["oneOf"].as_array()) {
        Some(list) => list.iter().flat_map(variants).collect(),
        None => vec![schema],
    }
}

/// Returns the schema of an optional field's value.
fn without_null(schema: &Value) -> &Value {
    let list = schema["anyOf"].as_array().map(Vec::as_slice).unwrap_or_default();
    match list {
        [inner, null] | [null, inner] if null["type"] == "null" => inner,
        _ => schema,
    }
}

/// Returns the words of an enum with their meanings.
fn words(schema: &Value) -> Vec<(&Value, &str)> {
    let named = schema["enum"].as_array().into_iter().flatten().chain(schema.get("const"));
    let named = named.map(|word| (word, ""));
    let meant = schema["oneOf"].as_array().into_iter().flatten().flat_map(|variant| {
        let doc = variant["description"].as_str().unwrap_or_default();
        let several = variant["enum"].as_array().into_iter().flatten();
        several.chain(variant.get("const")).map(move |word| (word, doc))
    });
    named.chain(meant).filter(|(word, _)| !word.is_null()).collect()
}

/// Returns the types and words that a schema takes.
fn values(schema: &Value) -> String {
    let words = words(schema);
    if !words.is_empty() {
        let words: Vec<_> =
            words.iter().map(|(word, _)| format!("`{}`", toml_text(word))).collect();
        return words.join(", ");
    }
    let types: Vec<&str> = match &schema["type"] {
        Value::String(one) => vec![one],
        Value::Array(several) => several.iter().filter_map(Value::as_str).collect(),
        _ => {
            let mut several: Vec<_> = variants(schema).into_iter().map(values).collect();
            several.dedup();
            return several.join(" or ");
        }
    };
    let types = types.into_iter().filter(|one| *one != "null");
    let types = types.map(|one| match one {
        "array" => format!("list of {}", values(&schema["items"])),
        "object" => "table".to_owned(),
        one => one.to_owned(),
    });
    types.collect::<Vec<_>>().join(" or ")
}

fn is_text(schema: &Value) -> bool {
    !words(schema).is_empty() || values(schema) == "string"
}

/// Returns the documentation of a field in one line, with the meanings of its words.
fn meaning(field: &Value, inner: &Value) -> String {
    let mut doc = line(field["description"].as_str().unwrap_or_default());
    let entries = if inner["items"].is_object() { &inner["items"] } else { inner };
    for (word, meaning) in words(entries).into_iter().filter(|(_, meaning)| !meaning.is_empty()) {
        doc += &format!(". `{}`: {}", toml_text(word), line(meaning));
    }
    doc
}

/// Returns text in one line, without links and the last full stop.
fn line(text: &str) -> String {
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    text.replace("[`", "`").replace("`]", "`").trim_end_matches('.').to_owned()
}
