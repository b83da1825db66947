//! The figures of `qudi eval` as text, Markdown and CSV.

use crate::cmd::eval_score::{FlowKind, FrameScore, Row};
use qudi_core::metrics::Statistics;
use std::fmt::Write;

/// Columns, in order.
const COLUMNS: usize = 12;

/// What stands where nothing is known.
const UNKNOWN: &str = "-";

/// Titles and rows; columns in which nothing is known are left out.
pub(crate) fn columns(rows: &[Row]) -> Vec<Vec<String>> {
    let lines: Vec<[String; COLUMNS]> =
        std::iter::once(titles(rows)).chain(rows.iter().map(cells)).collect();
    let known = |&i: &usize| lines[1..].iter().any(|line| line[i] != UNKNOWN);
    let kept: Vec<usize> = (0..COLUMNS).filter(known).collect();
    lines.iter().map(|line| kept.iter().map(|&i| line[i].clone()).collect()).collect()
}

fn titles(rows: &[Row]) -> [String; COLUMNS] {
    let flicker = match rows.first().and_then(Row::flow) {
        Some(FlowKind::Estimated) => "flicker (estimated flow)",
        Some(FlowKind::True) | None => "flicker",
    };
    [
        "method",
        "PPP",
        "psnr-a centre",
        "psnr-a all",
        "worst 5 %",
        "psnr all",
        "ssim all",
        "ssim-g all",
        "chi-square",
        flicker,
        "s/frame",
        "peak MiB",
    ]
    .map(str::to_owned)
}

fn cells(row: &Row) -> [String; COLUMNS] {
    let interval = |statistics: Option<Statistics>, digits: usize| match statistics {
        Some(Statistics { mean, ci95: Some(ci95), .. }) => {
            format!("{mean:.digits$} ± {ci95:.digits$}")
        }
        Some(Statistics { mean, .. }) => format!("{mean:.digits$}"),
        None => UNKNOWN.to_owned(),
    };
    let known = |value: Option<f64>, digits: usize| {
        value.map_or(UNKNOWN.to_owned(), |v| format!("{v:.digits$}"))
    };
    [
        row.method.clone(),
        // Four digits of an estimate are plenty.
        ((row.ppp * 1e4).round() / 1e4).to_string(),
        interval(row.centre(|f| f.psnr_a), 2),
        interval(row.over_clips(|f| f.psnr_a), 2),
        known(row.over_frames(|f| f.psnr_a).map(|s| s.worst5), 2),
        interval(row.over_clips(|f| f.psnr), 2),
        interval(row.over_clips(|f| f.ssim), 3),
        interval(row.over_clips(|f| f.ssim_g), 3),
        known(row.mean(|s| s.chi_square), 3),
        known(row.mean(|s| s.flicker), 3),
        known(row.mean(|s| s.seconds_per_frame), 4),
        known(row.peak_mib(), 1),
    ]
}

/// An aligned table for people, and what the figures are.
pub(crate) fn table(rows: &[Row], about: &str) -> String {
    let lines = columns(rows);
    let width = |i: usize| lines.iter().map(|line| line[i].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..lines[0].len()).map(width).collect();
    let mut text = String::new();
    for line in &lines {
        for (i, (cell, &width)) in line.iter().zip(&widths).enumerate() {
            let _ = if i == 0 {
                write!(text, "{cell:<width$}")
            } else {
                write!(text, "  {cell:>width$}")
            };
        }
        text.push('\n');
    }
    let _ = writeln!(text, "\n{about}");
    text
}

pub(crate) fn markdown(rows: &[Row]) -> String {
    let mut lines = columns(rows).into_iter();
    let titles = lines.next().unwrap_or_default();
    let mut text = format!(
        "| {} |\n|---|{}\n",
        titles.join(" | "),
        "--:|".repeat(titles.len().saturating_sub(1))
    );
    for line in lines {
        let _ = writeln!(text, "| {} |", line.join(" | "));
    }
    text
}

/// One line per method, light level, clip and frame; what is not known stays empty.
pub(crate) fn csv(rows: &[Row]) -> String {
    let mut text = "method,ppp,clip,frame,psnr_a,psnr,ssim,ssim_g,chi_square\n".to_owned();
    let quoted = |name: &str| format!("\"{}\"", name.replace('"', "\"\""));
    for row in rows {
        for score in &row.scores {
            for (n, &frame) in score.frames.iter().enumerate() {
                let FrameScore { psnr_a, psnr, ssim, ssim_g, chi_square } = frame;
                let figures = [psnr_a, psnr, ssim, ssim_g, chi_square]
                    .map(|figure| figure.map_or(String::new(), |v| v.to_string()));
                let _ = writeln!(
                    text,
                    "{},{},{},{n},{}",
                    quoted(&row.method),
                    row.ppp,
                    quoted(&score.clip),
                    figures.join(",")
                );
            }
        }
    }
    text
}
