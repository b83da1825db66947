//! The figures of `qudi eval` as text, Markdown and CSV.

use crate::args::{Eval, Protocol};
use crate::cmd::eval::Row;
use qudi_sim::metrics::Statistics;
use std::fmt::Write;

/// Column titles, in order.
pub(crate) const TITLES: [&str; 11] = [
    "method",
    "PPP",
    "psnr-a centre",
    "psnr-a all",
    "worst 5 %",
    "psnr all",
    "ssim all",
    "ssim-g all",
    "chi-square",
    "flicker",
    "s/frame",
];

/// One row, in the order of [`TITLES`].
pub(crate) fn cells(row: &Row) -> [String; 11] {
    let interval = |statistics: Option<Statistics>, digits: usize| match statistics {
        Some(Statistics { mean, ci95: Some(ci95), .. }) => {
            format!("{mean:.digits$} ± {ci95:.digits$}")
        }
        Some(Statistics { mean, .. }) => format!("{mean:.digits$}"),
        None => "-".to_owned(),
    };
    let known = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.3}"));
    let worst =
        row.over_frames(|f| f.psnr_a).map_or("-".to_owned(), |s| format!("{:.2}", s.worst5));
    [
        row.method.clone(),
        row.ppp.to_string(),
        interval(row.centre(|f| f.psnr_a), 2),
        interval(row.over_clips(|f| f.psnr_a), 2),
        worst,
        interval(row.over_clips(|f| f.psnr), 2),
        interval(row.over_clips(|f| f.ssim), 3),
        interval(row.over_clips(|f| f.ssim_g), 3),
        known(row.mean(|s| s.chi_square)),
        known(row.mean(|s| s.flicker)),
        row.mean(|s| s.seconds_per_frame).map_or("-".to_owned(), |v| format!("{v:.4}")),
    ]
}

/// An aligned table for people.
pub(crate) fn table(rows: &[Row], args: &Eval, clips: usize) -> String {
    let lines: Vec<[String; 11]> =
        std::iter::once(TITLES.map(str::to_owned)).chain(rows.iter().map(cells)).collect();
    let width = |i: usize| lines.iter().map(|line| line[i].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..TITLES.len()).map(width).collect();
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
    let _ = writeln!(text, "\n{}", about(args, clips));
    text
}

/// What the figures are.
pub(crate) fn about(args: &Eval, clips: usize) -> String {
    let protocol = match args.protocol {
        Protocol::Strict => "strict",
        Protocol::Quiver => "quiver",
    };
    format!(
        "{clips} clips, {}, protocol {}, seed {}; mean over clips ± 95 % confidence; PSNR in dB, -a after the best gain; worst 5 % of frames; flicker: rms along the true flow beyond the truth's",
        args.sensor, protocol, args.seed
    )
}

pub(crate) fn markdown(rows: &[Row]) -> String {
    let mut text =
        format!("| {} |\n|---|{}\n", TITLES.join(" | "), "--:|".repeat(TITLES.len() - 1));
    for row in rows {
        let _ = writeln!(text, "| {} |", cells(row).join(" | "));
    }
    text
}

/// One line per method, light level, clip and frame.
pub(crate) fn csv(rows: &[Row]) -> String {
    let mut text = "method,ppp,clip,frame,psnr_a,psnr,ssim,ssim_g\n".to_owned();
    let quoted = |name: &str| format!("\"{}\"", name.replace('"', "\"\""));
    for row in rows {
        for score in &row.scores {
            for (n, f) in score.frames.iter().enumerate() {
                let _ = writeln!(
                    text,
                    "{},{},{},{n},{},{},{},{}",
                    quoted(&row.method),
                    row.ppp,
                    quoted(&score.clip),
                    f.psnr_a,
                    f.psnr,
                    f.ssim,
                    f.ssim_g
                );
            }
        }
    }
    text
}
