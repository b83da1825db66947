//! The tables of `qudi eval`: figures of methods, and of every frame.

use super::score::{Figure, FlowKind, LOOKS, Named, Row};
use crate::report::{Cell, Column, Table};
use qudi_core::metrics::Statistics;

/// One row for every method and light level, without columns in which nothing is known.
pub(crate) fn summary(rows: &[Row]) -> Table {
    let flicker = match rows.first().and_then(Row::flow) {
        Some(FlowKind::Estimated) => "flicker (estimated flow)",
        Some(FlowKind::True) | None => "flicker",
    };
    let mut table = Table::new(vec![
        Column::new("method", "method"),
        Column::new("steps", "steps"),
        Column::new("ppp", "PPP"),
        Column::new("psnr_a_centre", "psnr-a centre"),
        Column::new("psnr_a", "psnr-a all"),
        Column::new("psnr_a_worst5", "worst 5 %"),
        Column::new("psnr", "psnr all"),
        Column::new("ssim", "ssim all"),
        Column::new("ssim_g", "ssim-g all"),
        Column::new("lpips_alex", "lpips-alex"),
        Column::new("lpips_vgg", "lpips-vgg"),
        Column::new("chi_square", "chi-square"),
        Column::new("flicker", flicker),
        Column::new("seconds_per_frame", "s/frame"),
        Column::new("peak_mib", "peak").with_unit("MiB"),
    ]);
    table.rows = rows.iter().filter(|row| row.refused.is_none()).map(cells).collect();
    table.without_unknown_columns()
}

/// Estimated light levels have four significant decimals at most.
fn light(row: &Row) -> Cell {
    Cell::Exact((row.ppp * 1e4).round() / 1e4)
}

/// Diffusion steps, where several numbers of them are compared.
pub(super) fn steps(row: &Row) -> Cell {
    row.steps.map_or(Cell::Unknown, |steps| Cell::Exact(steps as f64))
}

fn cells(row: &Row) -> Vec<Cell> {
    let mean = |statistics: Option<Statistics>, digits: usize| match statistics {
        Some(Statistics { mean: value, ci95: Some(ci95), .. }) => {
            Cell::Mean { value, ci95, digits }
        }
        other => Cell::number(other.map(|statistics| statistics.mean), digits),
    };
    vec![
        Cell::text(row.name()),
        steps(row),
        light(row),
        mean(row.centre(|f| f.psnr_a), 2),
        mean(row.over_clips(|f| f.psnr_a), 2),
        Cell::number(row.over_frames(|f| f.psnr_a).map(|s| s.worst5), 2),
        mean(row.over_clips(|f| f.psnr), 2),
        mean(row.over_clips(|f| f.ssim), 3),
        mean(row.over_clips(|f| f.ssim_g), 3),
        Cell::number(row.over_clips(|f| f.lpips_alex).map(|s| s.mean), 3),
        Cell::number(row.over_clips(|f| f.lpips_vgg).map(|s| s.mean), 3),
        Cell::number(row.mean(|s| s.chi_square), 3),
        Cell::number(row.mean(|s| s.flicker), 3),
        Cell::number(row.mean(|s| s.seconds_per_frame), 4),
        Cell::number(row.peak_mib(), 1),
    ]
}

/// Tables of looks with their titles, as far as they were measured.
pub(crate) fn looks(rows: &[Row]) -> Vec<(&'static str, Table)> {
    let added_title =
        "What more steps added, over what the fewest missed (rms, by size of structure)";
    let tables = [("How frames look", appearance(rows)), (added_title, added(rows))];
    tables.into_iter().filter_map(|(title, table)| Some((title, table?))).collect()
}

/// How frames look, one row for every method and light level; none where it was not measured.
fn appearance(rows: &[Row]) -> Option<Table> {
    rows.iter().find(|row| row.over_clips(|f| f.appearance.map(|a| a.gmsd)).is_some())?;
    let mut columns = ["method", "steps", "PPP"].map(|name| Column::new(name, name)).to_vec();
    columns.extend(LOOKS.iter().map(|look| Column::new(look.key, look.title)));
    let mut table = Table::new(columns);
    let cells = |row: &Row| {
        let mean =
            |look: &Named| Cell::number(row.over_clips(look.figure).map(|s| s.mean), look.digits);
        let first = [Cell::text(row.name()), steps(row), light(row)];
        first.into_iter().chain(LOOKS.iter().map(mean)).collect()
    };
    table.rows = rows.iter().filter(|row| row.refused.is_none()).map(cells).collect();
    Some(table.without_unknown_columns())
}

/// What more diffusion steps added to the result of the fewest, over what that one misses: in every octave, the
/// ratio of root mean squares. None where it was not measured.
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

/// One row for every method, light level, clip and frame; steps where they are compared, looks where they were
/// measured.
pub(crate) fn frames(rows: &[Row]) -> Table {
    let usual: [(&str, Figure, usize); 4] = [
        ("psnr_a", |f| f.psnr_a, 2),
        ("psnr", |f| f.psnr, 2),
        ("ssim", |f| f.ssim, 3),
        ("ssim_g", |f| f.ssim_g, 3),
    ];
    let all = || rows.iter().flat_map(|row| &row.scores).flat_map(|score| &score.frames);
    let is_known = |look: &&Named| all().any(|frame| (look.figure)(frame).is_some());
    // One digit more than means have.
    let looks = LOOKS.iter().filter(is_known).map(|look| (look.key, look.figure, look.digits + 1));
    let chi_square: (&str, Figure, usize) = ("chi_square", |f| f.chi_square, 3);
    let figures: Vec<_> = usual.into_iter().chain(looks).chain([chi_square]).collect();
    let compares = rows.iter().any(|row| row.steps.is_some());
    let first = ["method", "steps", "ppp", "clip", "frame"];
    let first = first.into_iter().filter(|key| compares || *key != "steps");
    let keys = first.chain(figures.iter().map(|f| f.0));
    let mut table = Table::new(keys.map(|key| Column::new(key, key)).collect());
    for row in rows {
        for score in &row.scores {
            for (n, frame) in score.frames.iter().enumerate() {
                let mut cells = vec![Cell::text(&row.method)];
                cells.extend(compares.then(|| steps(row)));
                let place = [Cell::Exact(row.ppp), Cell::text(&score.clip), Cell::Exact(n as f64)];
                cells.extend(place);
                let figures = figures.iter();
                cells.extend(
                    figures.map(|(_, figure, digits)| Cell::number(figure(frame), *digits)),
                );
                table.rows.push(cells);
            }
        }
    }
    table
}
