//! JSON whose numbers are read to the last bit, which the library does not do by itself.

use serde_json::{Number, Value};

/// Begins the text of a number while the library reads the rest.
const MARK: &str = "number:";

/// Parses a document; fractions come back as they were printed.
pub(super) fn parse(text: &str) -> serde_json::Result<Value> {
    let mut quoted = String::with_capacity(text.len() + text.len() / 4);
    let mut rest = text;
    while let Some(start) = rest.find(|c: char| c == '"' || c == '-' || c.is_ascii_digit()) {
        quoted += &rest[..start];
        rest = &rest[start..];
        let length = if rest.starts_with('"') { string(rest) } else { number(rest) };
        let token = &rest[..length];
        if token.starts_with('"') || !token.contains(['.', 'e', 'E']) {
            quoted += token;
        } else {
            quoted += &format!("\"{MARK}{token}\"");
        }
        rest = &rest[length..];
    }
    quoted += rest;
    serde_json::from_str(&quoted).map(exact)
}

/// Returns the length of a string with its quotes.
fn string(text: &str) -> usize {
    let mut escaped = false;
    let end = text.bytes().enumerate().skip(1).find(|&(_, byte)| {
        let is_end = byte == b'"' && !escaped;
        escaped = byte == b'\\' && !escaped;
        is_end
    });
    end.map_or(text.len(), |(end, _)| end + 1)
}

/// Returns the length of a number.
fn number(text: &str) -> usize {
    let is_part = |c: char| c.is_ascii_digit() || "+-.eE".contains(c);
    text.find(|c| !is_part(c)).unwrap_or(text.len())
}

/// Turns marked strings back into numbers.
fn exact(value: Value) -> Value {
    match value {
        Value::String(text) => {
            let number = text.strip_prefix(MARK).and_then(|number| number.parse().ok());
            number.and_then(Number::from_f64).map_or(Value::String(text), Value::Number)
        }
        Value::Array(list) => list.into_iter().map(exact).collect(),
        Value::Object(map) => map.into_iter().map(|(key, value)| (key, exact(value))).collect(),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_to_the_last_bit() {
        let mut state = 1u64;
        let numbers: Vec<f64> = (0..2000)
            .map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (state >> 11) as f64 * 1e-13
            })
            .collect();
        let text = serde_json::json!({"a \"1.5\"": numbers, "b": [1, -2, "3.5", null]}).to_string();
        let value = parse(&text).unwrap();
        let back: Vec<f64> =
            value["a \"1.5\""].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        assert_eq!(back, numbers);
        assert_eq!(value.to_string(), text);
    }
}
