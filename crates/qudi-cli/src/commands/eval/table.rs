//! The tables of `qudi eval`: figures of methods, and of every frame.

use super::score::{Figure, FlowKind, Row};
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
    table.rows = rows.iter().map(cells).collect();
    table.without_unknown_columns()
}

/// Estimated light levels have four significant decimals at most.
fn light(row: &Row) -> Cell {
    Cell::Exact((row.ppp * 1e4).round() / 1e4)
}

fn cells(row: &Row) -> Vec<Cell> {
    let mean = |statistics: Option<Statistics>, digits: usize| match statistics {
        Some(Statistics { mean: value, ci95: Some(ci95), .. }) => {
            Cell::Mean { value, ci95, digits }
        }
        other => Cell::number(other.map(|statistics| statistics.mean), digits),
    };
    vec![
        Cell::text(&row.method),
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

/// How frames look, one row for every method and light level; none where it was not measured.
pub(crate) fn appearance(rows: &[Row]) -> Option<Table> {
    let figures: [(&str, &str, Figure, usize); 7] = [
        ("lpips_alex", "lpips-alex", |f| f.lpips_alex, 3),
        ("lpips_vgg", "lpips-vgg", |f| f.lpips_vgg, 3),
        ("gmsd", "gmsd", |f| f.appearance.map(|a| a.gmsd), 4),
        ("ssimulacra2", "ssimulacra2", |f| f.appearance.map(|a| a.ssimulacra2), 2),
        ("butteraugli", "butteraugli", |f| f.appearance.map(|a| a.butteraugli), 2),
        ("detail_flat", "detail flat", |f| f.appearance?.detail_flat, 2),
        ("detail_textured", "detail textured", |f| f.appearance?.detail_textured, 2),
    ];
    rows.iter().find(|row| row.over_clips(|f| f.appearance.map(|a| a.gmsd)).is_some())?;
    let names = [("method", "method"), ("ppp", "PPP")];
    let names = names.into_iter().chain(figures.iter().map(|(key, name, ..)| (*key, *name)));
    let mut table = Table::new(names.map(|(key, name)| Column::new(key, name)).collect());
    table.rows = rows
        .iter()
        .map(|row| {
            let mut cells = vec![Cell::text(&row.method), light(row)];
            let figures = figures.iter();
            cells.extend(figures.map(|(_, _, figure, digits)| {
                Cell::number(row.over_clips(*figure).map(|s| s.mean), *digits)
            }));
            cells
        })
        .collect();
    Some(table.without_unknown_columns())
}

/// One row for every method, light level, clip and frame; LPIPS and looks where they were measured.
pub(crate) fn frames(rows: &[Row]) -> Table {
    let figures: [(&str, Figure, usize); 12] = [
        ("psnr_a", |f| f.psnr_a, 2),
        ("psnr", |f| f.psnr, 2),
        ("ssim", |f| f.ssim, 3),
        ("ssim_g", |f| f.ssim_g, 3),
        ("lpips_alex", |f| f.lpips_alex, 4),
        ("lpips_vgg", |f| f.lpips_vgg, 4),
        ("gmsd", |f| f.appearance.map(|a| a.gmsd), 4),
        ("ssimulacra2", |f| f.appearance.map(|a| a.ssimulacra2), 2),
        ("butteraugli", |f| f.appearance.map(|a| a.butteraugli), 3),
        ("detail_flat", |f| f.appearance?.detail_flat, 3),
        ("detail_textured", |f| f.appearance?.detail_textured, 3),
        ("chi_square", |f| f.chi_square, 3),
    ];
    let always = ["psnr_a", "psnr", "ssim", "ssim_g", "chi_square"];
    let all = || rows.iter().flat_map(|row| &row.scores).flat_map(|score| &score.frames);
    let is_shown = |(key, figure, _): &(&str, Figure, usize)| {
        always.contains(key) || all().any(|frame| figure(frame).is_some())
    };
    let figures: Vec<_> = figures.into_iter().filter(is_shown).collect();
    let keys = ["method", "ppp", "clip", "frame"].into_iter().chain(figures.iter().map(|f| f.0));
    let mut table = Table::new(keys.map(|key| Column::new(key, key)).collect());
    for row in rows {
        for score in &row.scores {
            for (n, frame) in score.frames.iter().enumerate() {
                let mut cells = vec![
                    Cell::text(&row.method),
                    Cell::Exact(row.ppp),
                    Cell::text(&score.clip),
                    Cell::Exact(n as f64),
                ];
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
