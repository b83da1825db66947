//! The tables of `qudi eval`: figures of methods, and of every frame.

use super::metrics::{CHI_SQUARE, GMSD, METRICS, Metric, Part};
use super::score::{FlowKind, Row};
use crate::report::{Cell, Column, Table};
use qudi_core::metrics::Statistics;

/// Returns one row for every method and light level, without columns in which all cells are unknown.
pub(crate) fn summary(rows: &[Row]) -> Table {
    let flicker = match rows.first().and_then(Row::flow) {
        Some(FlowKind::Estimated) => "flicker (estimated flow)",
        Some(FlowKind::True) | None => "flicker",
    };
    let first = [("method", "method"), ("steps", "steps"), ("ppp", "PPP")];
    let mut columns: Vec<Column> = first.map(|(key, title)| Column::new(key, title)).to_vec();
    for Metric { key, title, part, .. } in METRICS {
        match part {
            Part::Lead => columns.extend([
                Column::new(format!("{key}_centre"), format!("{title} centre")),
                Column::new(*key, format!("{title} all")),
                Column::new(format!("{key}_worst5"), "worst 5 %"),
            ]),
            Part::Summary => columns.push(Column::new(*key, format!("{title} all"))),
            Part::Both => columns.push(Column::new(*key, *title)),
            Part::Appearance | Part::Frames => {}
        }
    }
    columns.extend([
        Column::new("chi_square", "chi-square"),
        Column::new("flicker", flicker),
        Column::new("seconds_per_frame", "s/frame"),
        Column::new("peak_mib", "peak").with_unit("MiB"),
    ]);
    let mut table = Table::new(columns);
    table.rows = rows.iter().filter(|row| row.refused.is_none()).map(cells).collect();
    table.without_unknown_columns()
}

/// Rounds light levels to four decimals: estimated ones are no more exact.
fn light(row: &Row) -> Cell {
    Cell::Exact((row.ppp * 1e4).round() / 1e4)
}

/// Returns diffusion steps, where several numbers of them are compared.
pub(super) fn steps(row: &Row) -> Cell {
    row.steps.map_or(Cell::Unknown, |steps| Cell::Exact(steps as f64))
}

fn cells(row: &Row) -> Vec<Cell> {
    let interval = |statistics: Option<Statistics>, digits: usize| match statistics {
        Some(Statistics { mean: value, ci95: Some(ci95), .. }) => {
            Cell::Mean { value, ci95, digits }
        }
        other => Cell::number(other.map(|statistics| statistics.mean), digits),
    };
    let mut cells = vec![Cell::text(row.name()), steps(row), light(row)];
    for metric in METRICS {
        let (all, digits) = (row.over_clips(metric), metric.digits);
        match metric.part {
            Part::Lead => cells.extend([
                interval(row.centre(metric), digits),
                interval(all, digits),
                Cell::number(row.over_frames(metric).map(|s| s.worst5), digits),
            ]),
            Part::Summary => cells.push(interval(all, digits)),
            Part::Both => cells.push(Cell::number(all.map(|s| s.mean), digits)),
            Part::Appearance | Part::Frames => {}
        }
    }
    cells.extend([
        Cell::number(row.mean(|s| s.chi_square), CHI_SQUARE.digits),
        Cell::number(row.mean(|s| s.flicker), 3),
        Cell::number(row.mean(|s| s.seconds_per_frame), 4),
        Cell::number(row.peak_mib(), 1),
    ]);
    cells
}

/// Returns tables of appearance with their titles, as far as they were measured.
pub(crate) fn looks(rows: &[Row]) -> Vec<(&'static str, Table)> {
    let added_title =
        "What more steps added, over what the fewest missed (rms, by size of structure)";
    let tables = [("How frames look", appearance(rows)), (added_title, added(rows))];
    tables.into_iter().filter_map(|(title, table)| Some((title, table?))).collect()
}

/// Returns metrics of appearance, one row for every method and light level; none where they were not
/// measured.
fn appearance(rows: &[Row]) -> Option<Table> {
    rows.iter().find(|row| row.over_clips(&GMSD).is_some())?;
    let shown = || METRICS.iter().filter(|metric| metric.is_appearance());
    let mut columns = ["method", "steps", "PPP"].map(|name| Column::new(name, name)).to_vec();
    columns.extend(shown().map(|metric| Column::new(metric.key, metric.title)));
    let mut table = Table::new(columns);
    let cells = |row: &Row| {
        let mean =
            |metric: &Metric| Cell::number(row.over_clips(metric).map(|s| s.mean), metric.digits);
        let first = [Cell::text(row.name()), steps(row), light(row)];
        first.into_iter().chain(shown().map(mean)).collect()
    };
    table.rows = rows.iter().filter(|row| row.refused.is_none()).map(cells).collect();
    Some(table.without_unknown_columns())
}

/// Returns what more diffusion steps added to the result of the fewest, over what the latter missed: in every
/// octave, the ratio of root mean squares. None where it was not measured.
fn added(rows: &[Row]) -> Option<Table> {
    let octaves = ["2-4 pixels", "4-8", "8-16", "16-32", "coarser"];
    let names = ["method", "steps", "PPP"].into_iter().chain(octaves);
    let mut table = Table::new(names.map(|name| Column::new(name, name)).collect());
    let cells = |row: &Row| {
        let ratios = row.added()?.map(|ratio| Cell::number(Some(ratio), 3));
        let first = [Cell::text(row.name()), steps(row), light(row)];
        Some(first.into_iter().chain(ratios).collect())
    };
    table.rows = rows.iter().filter_map(cells).collect();
    (!table.rows.is_empty()).then_some(table)
}

/// Returns one row for every method, light level, clip and frame; with steps where they are compared, and
/// metrics of appearance where they were measured.
pub(crate) fn frames(rows: &[Row]) -> Table {
    let all = || rows.iter().flat_map(|row| &row.scores).flat_map(|score| &score.frames);
    let is_listed = |metric: &&Metric| {
        !metric.is_appearance() || all().any(|frame| frame.get(metric).is_some())
    };
    let metrics: Vec<&Metric> = METRICS.iter().filter(is_listed).collect();
    let compares = rows.iter().any(|row| row.steps.is_some());
    let first = ["method", "steps", "ppp", "clip", "frame"];
    let first = first.into_iter().filter(|key| compares || *key != "steps");
    let marks = all().any(|frame| frame.mark.is_some());
    let keys = first.chain(metrics.iter().map(|metric| metric.key));
    let keys = keys.chain(marks.then_some("mark"));
    let mut table = Table::new(keys.map(|key| Column::new(key, key)).collect());
    for row in rows {
        for score in &row.scores {
            for (n, frame) in score.frames.iter().enumerate() {
                let mut cells = vec![Cell::text(&row.method)];
                cells.extend(compares.then(|| steps(row)));
                let place = [Cell::Exact(row.ppp), Cell::text(&score.clip), Cell::Exact(n as f64)];
                cells.extend(place);
                let values = metrics.iter();
                cells.extend(values.map(|metric| Cell::number(frame.get(metric), metric.digits)));
                cells.extend(
                    marks.then(|| frame.mark.map_or(Cell::Unknown, |m| Cell::text(m.name()))),
                );
                table.rows.push(cells);
            }
        }
    }
    table
}
