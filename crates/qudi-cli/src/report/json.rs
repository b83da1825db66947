//! Results as JSON.

use super::printable::is_unprintable;
use super::{Cell, Table};
use serde_json::{Map, Value};
use std::fmt::Write;

/// Returns one object for every row, without unknown cells.
pub(crate) fn rows(table: &Table) -> Value {
    let object = |row: &Vec<Cell>| {
        let cells = table.columns.iter().zip(row);
        let known = cells.filter_map(|(column, cell)| Some((column.key.to_string(), value(cell)?)));
        Value::Object(known.collect::<Map<_, _>>())
    };
    table.rows.iter().map(object).collect()
}

fn value(cell: &Cell) -> Option<Value> {
    match cell {
        Cell::Text(text) => Some(text.as_str().into()),
        Cell::Number { value, .. } | Cell::Exact(value) => Some((*value).into()),
        Cell::Mean { value, ci95, .. } => Some(serde_json::json!({"mean": value, "ci95": ci95})),
        Cell::Unknown => None,
    }
}

/// Formats a document for a terminal or a pipe: control characters that JSON permits in strings are escaped,
/// too.
pub(crate) fn document(value: &Value) -> String {
    // A value with text for keys can always be written.
    let text = serde_json::to_string_pretty(value).unwrap_or_else(|e| e.to_string());
    if !text.chars().any(is_unprintable) {
        return text;
    }
    let mut escaped = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if is_unprintable(c) {
            // All of them lie in the basic plane.
            let _ = write!(escaped, "\\u{:04x}", u32::from(c));
        } else {
            escaped.push(c);
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn leaves_out_unknown_cells() {
        let rows = rows(&crate::report::table::example());
        let first =
            json!({"method": "=cmd|a", "psnr": {"mean": 25.126, "ci95": 0.514}, "note": "a \"b\""});
        assert_eq!(rows[0], first);
    }

    #[test]
    fn escapes_control_characters_and_stays_the_same_document() {
        let value = json!({"name": "a\u{9b}2J\u{7f}\u{1b}[0m\u{202e}"});
        let text = document(&value);
        assert!(!text.chars().any(is_unprintable), "{text}");
        assert_eq!(serde_json::from_str::<Value>(&text).ok(), Some(value));
    }
}
