//! The table that every exporter writes, and its form for terminals.

use std::borrow::Cow;
use std::fmt::Write;

/// Text of unknown cells.
const UNKNOWN: &str = "-";

/// Results in rows and columns.
#[derive(Clone, Debug)]
pub(crate) struct Table {
    pub(crate) columns: Vec<Column>,
    /// One cell for every column.
    pub(crate) rows: Vec<Vec<Cell>>,
}

/// The heading of a column.
#[derive(Clone, Debug)]
pub(crate) struct Column {
    /// The name in files that programs read.
    pub(crate) key: Cow<'static, str>,
    /// The name that people read.
    pub(crate) title: Cow<'static, str>,
    /// Unit of the numbers, shown after the title.
    pub(crate) unit: Option<&'static str>,
}

/// One result.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Cell {
    Text(String),
    /// A number, shown with so many digits after the point.
    Number {
        value: f64,
        digits: usize,
    },
    /// A mean and the half width of its 95 % confidence interval.
    Mean {
        value: f64,
        ci95: f64,
        digits: usize,
    },
    /// A number that is read as it was given, such as a light level.
    Exact(f64),
    Unknown,
}

impl Column {
    pub(crate) fn new(
        key: impl Into<Cow<'static, str>>,
        title: impl Into<Cow<'static, str>>,
    ) -> Self {
        Self { key: key.into(), title: title.into(), unit: None }
    }

    pub(crate) fn with_unit(self, unit: &'static str) -> Self {
        Self { unit: Some(unit), ..self }
    }

    /// Returns title and unit.
    pub(crate) fn heading(&self) -> String {
        match self.unit {
            Some(unit) => format!("{} {unit}", self.title),
            None => self.title.to_string(),
        }
    }
}

impl Cell {
    pub(crate) fn text(text: impl Into<String>) -> Self {
        Self::Text(text.into())
    }

    /// Makes a cell of a number with so many digits after the point, or an unknown one.
    pub(crate) fn number(value: impl Into<Option<f64>>, digits: usize) -> Self {
        value.into().map_or(Self::Unknown, |value| Self::Number { value, digits })
    }

    /// Formats the cell for people.
    pub(crate) fn shown(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Number { value, digits } => format!("{value:.digits$}"),
            Self::Mean { value, ci95, digits } => format!("{value:.digits$} ± {ci95:.digits$}"),
            Self::Exact(value) => value.to_string(),
            Self::Unknown => UNKNOWN.to_owned(),
        }
    }
}

impl Table {
    pub(crate) fn new(columns: Vec<Column>) -> Self {
        Self { columns, rows: Vec::new() }
    }

    /// Removes columns in which all cells are unknown.
    pub(crate) fn without_unknown_columns(mut self) -> Self {
        let known: Vec<bool> = (0..self.columns.len())
            .map(|i| self.rows.iter().any(|row| row[i] != Cell::Unknown))
            .collect();
        let keep = |i: usize| known.get(i).copied().unwrap_or(false);
        for row in &mut self.rows {
            let mut i = 0;
            row.retain(|_| (keep(i), i += 1).0);
        }
        let mut i = 0;
        self.columns.retain(|_| (keep(i), i += 1).0);
        self
    }

    /// Returns headings, and rows formatted for people.
    pub(crate) fn shown(&self) -> (Vec<String>, Vec<Vec<String>>) {
        let rows = self.rows.iter().map(|row| row.iter().map(Cell::shown).collect());
        (self.columns.iter().map(Column::heading).collect(), rows.collect())
    }

    /// Formats the table in aligned columns: the first to the left, others to the right, text columns at the
    /// end to the left.
    pub(crate) fn to_text(&self) -> String {
        let (headings, rows) = self.shown();
        let width = |i: usize| {
            let cells = rows.iter().map(|row| &row[i]);
            cells.chain([&headings[i]]).map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..headings.len()).map(width).collect();
        let is_text = |i: usize| {
            i == 0 || self.rows.first().is_some_and(|row| matches!(row[i], Cell::Text(_)))
        };
        let mut text = String::new();
        for line in std::iter::once(&headings).chain(&rows) {
            let mut aligned = String::new();
            for (i, (cell, &width)) in line.iter().zip(&widths).enumerate() {
                let gap = if i == 0 { "" } else { "  " };
                let _ = if is_text(i) {
                    write!(aligned, "{gap}{cell:<width$}")
                } else {
                    write!(aligned, "{gap}{cell:>width$}")
                };
            }
            text += aligned.trim_end();
            text.push('\n');
        }
        text
    }
}

#[cfg(test)]
pub(super) fn example() -> Table {
    let mut table = Table::new(vec![
        Column::new("method", "method"),
        Column::new("psnr", "psnr").with_unit("dB"),
        Column::new("flicker", "flicker"),
        Column::new("note", "note"),
    ]);
    table.rows = vec![
        vec![
            Cell::text("=cmd|a"),
            Cell::Mean { value: 25.126, ci95: 0.514, digits: 2 },
            Cell::Unknown,
            Cell::text("a \"b\""),
        ],
        vec![Cell::text("mle"), Cell::number(-3.0, 2), Cell::Unknown, Cell::text("<b>\u{1b}</b>")],
    ];
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aligns_text_left_and_numbers_right() {
        let text = "method       psnr dB  flicker  note\n\
                    =cmd|a  25.13 ± 0.51        -  a \"b\"\n\
                    mle            -3.00        -  <b>\u{1b}</b>\n";
        assert_eq!(example().to_text(), text);
    }

    #[test]
    fn leaves_out_columns_without_a_known_cell() {
        let table = example().without_unknown_columns();
        let titles: Vec<_> = table.columns.iter().map(|column| column.title.as_ref()).collect();
        assert_eq!(titles, ["method", "psnr", "note"]);
        assert!(table.rows.iter().all(|row| row.len() == 3));
    }

    #[test]
    fn prints_headings_of_an_empty_table() {
        let table = Table::new(vec![Column::new("a", "a"), Column::new("b", "b")]);
        assert_eq!(table.to_text(), "a  b\n");
    }
}
