//! Settings of an earlier run that differ from the ones of this run.

use serde_json::Value;

/// Returns settings as they are once written and read again: of some numbers the library reads another last
/// bit.
pub(super) fn written(settings: &Value) -> Value {
    let text = settings.to_string();
    serde_json::from_str(&text).unwrap_or_else(|_| settings.clone())
}

/// Values of settings that have another name by now: the key, the former value, the value.
const RENAMED: &[(&str, &str, &str)] =
    &[("method", "guide", "qbp-refined"), ("spacing", "learnt", "log-logistic")];

/// Returns the first key whose value differs, with both values.
pub(super) fn difference(was: &Value, is: &Value) -> Option<(String, String, String)> {
    match (was, is) {
        (Value::Object(was), Value::Object(is)) => {
            let keys = was.keys().chain(is.keys());
            keys.into_iter().find_map(|key| {
                let (was, is) = (was.get(key), is.get(key));
                let (was, is) = (was.unwrap_or(&Value::Null), is.unwrap_or(&Value::Null));
                if RENAMED
                    .iter()
                    .any(|(name, former, now)| key == name && was == former && is == now)
                {
                    return None;
                }
                let (below, was, is) = difference(was, is)?;
                let name = if below.is_empty() { key.clone() } else { format!("{key}.{below}") };
                Some((name, was, is))
            })
        }
        // A number may be parsed from text as another kind of number.
        (Value::Number(a), Value::Number(b)) if a.as_f64() == b.as_f64() => None,
        (was, is) if was == is => None,
        (was, is) => Some((String::new(), was.to_string(), is.to_string())),
    }
}
