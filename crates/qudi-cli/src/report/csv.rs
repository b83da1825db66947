//! Tables as comma-separated values (RFC 4180), numbers with all their digits.

use super::{Cell, Table};

/// Writes the table under the keys of its columns; unknown cells stay empty, and a mean loses its interval.
pub(crate) fn table(table: &Table) -> String {
    let keys: Vec<_> = table.columns.iter().map(|column| column.key.as_ref()).collect();
    let mut text = keys.join(",") + "\n";
    for row in &table.rows {
        let cells: Vec<_> = row.iter().map(cell).collect();
        text += &cells.join(",");
        text.push('\n');
    }
    text
}

fn cell(cell: &Cell) -> String {
    match cell {
        Cell::Text(text) => quoted(text),
        Cell::Number { value, .. } | Cell::Mean { value, .. } | Cell::Exact(value) => {
            value.to_string()
        }
        Cell::Unknown => String::new(),
    }
}

/// Quotes text. Spreadsheets take what starts with one of `= + - @` for a formula, and run it: an
/// apostrophe before it makes it text (OWASP, CSV injection).
fn quoted(text: &str) -> String {
    let apostrophe = if text.starts_with(['=', '+', '-', '@', '\t', '\r']) { "'" } else { "" };
    format!("\"{apostrophe}{}\"", text.replace('"', "\"\""))
}

#[cfg(test)]
mod tests {
    #[test]
    fn quotes_text_that_spreadsheets_would_run() {
        let text = super::table(&crate::report::table::example());
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines[0], "method,psnr,flicker,note");
        assert_eq!(lines[1], "\"'=cmd|a\",25.126,,\"a \"\"b\"\"\"");
        assert!(lines[2].starts_with("\"mle\",-3,,"), "numbers keep their sign: {}", lines[2]);
    }
}
