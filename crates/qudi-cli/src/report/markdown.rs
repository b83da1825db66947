//! Tables in Markdown, as GitHub shows them.

use super::Table;

/// Writes the table with the first column to the left, others to the right.
pub(crate) fn table(table: &Table) -> String {
    let (headings, rows) = table.shown();
    let line = |cells: &[String]| {
        let cells: Vec<_> = cells.iter().map(|cell| escaped(cell)).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let rule = format!("|---|{}\n", "--:|".repeat(headings.len().saturating_sub(1)));
    let rows: String = rows.iter().map(|row| line(row)).collect();
    line(&headings) + &rule + &rows
}

/// Escapes the text of a cell, so that it neither ends the cell nor starts HTML.
fn escaped(cell: &str) -> String {
    let cell = super::printable(cell).replace(['\n', '\t'], " ");
    cell.replace('|', "\\|").replace('<', "&lt;")
}

#[cfg(test)]
mod tests {
    #[test]
    fn escapes_what_would_end_a_cell_or_start_html() {
        let text = super::table(&crate::report::table::example());
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines[0], "| method | psnr dB | flicker | note |");
        assert_eq!(lines[1], "|---|--:|--:|--:|");
        assert_eq!(lines[2], "| =cmd\\|a | 25.13 ± 0.51 | - | a \"b\" |");
        assert_eq!(lines[3], "| mle | -3.00 | - | &lt;b>\\u{1b}&lt;/b> |");
    }
}
