//! The paper's table 1, and the same metrics measured here.

use super::metrics::{LPIPS_ALEX, LPIPS_VGG, Metric, PSNR, PSNR_A, SSIM};
use super::score::Row;
use super::table::steps;
use crate::methods::Method;
use crate::methods::options::NetworkOptions;
use crate::report::{Cell, Column, Table};

/// Light levels of the table, and default of clips.
pub(super) const LEVELS: [f64; 3] = [3.25, 9.75, 26.0];

/// PSNR in dB and SSIM at the three levels (Quanta Diffusion, table 1).
const PAPER: [(&str, [[f64; 2]; 3]); 11] = [
    ("transform-denoise", [[21.32, 0.718], [23.15, 0.767], [22.31, 0.781]]),
    ("qbp", [[15.94, 0.129], [19.19, 0.265], [20.80, 0.411]]),
    ("qbp-bm3d", [[21.55, 0.703], [22.20, 0.690], [22.86, 0.783]]),
    ("student-teacher", [[18.72, 0.401], [16.52, 0.248], [13.29, 0.074]]),
    ("rvrt", [[19.41, 0.354], [21.67, 0.457], [21.75, 0.497]]),
    ("emvd", [[20.02, 0.587], [21.06, 0.605], [23.41, 0.558]]),
    ("flornn", [[21.03, 0.679], [25.61, 0.709], [27.85, 0.778]]),
    ("memdeblur", [[19.49, 0.387], [14.49, 0.111], [16.01, 0.171]]),
    ("spk2imgnet", [[20.39, 0.564], [19.67, 0.673], [14.98, 0.686]]),
    ("quiver", [[26.21, 0.790], [26.81, 0.825], [27.94, 0.845]]),
    ("qudi", [[28.64, 0.811], [30.52, 0.862], [32.55, 0.888]]),
];

/// Reasons why the figures differ.
pub(super) const REASONS: &str = "The paper's figures are not these ones: it scored 31 clips of \
    I2-2000FPS, plain PSNR and SSIM, where nobody says how brightness was found; psnr is plain here, \
    psnr-a is after the best gain. Here every frame counts, and all methods get the same photons; \
    the public programs score one frame each, not the same, and draw new noise for every window. \
    Weights of others were trained for one light level and one gain. qudi here is not the authors' \
    network.";

/// Returns the methods of the table that can run: without weights, with built-in or with named ones.
pub(super) fn methods(network: &NetworkOptions) -> Vec<&'static Method> {
    let can_run = |method: &&Method| {
        method.as_learned().is_none_or(|learned| network.weights_of(learned).is_ok())
    };
    PAPER.iter().filter_map(|(name, _)| Method::by_name(name)).filter(can_run).collect()
}

/// Makes the table, with the paper's figures if the light is the paper's. Methods without weights for this
/// light and sensor say so.
pub(super) fn table(rows: &[Row], has_light_of_paper: bool) -> Table {
    let mut table = Table::new(vec![
        Column::new("method", "method"),
        Column::new("steps", "steps"),
        Column::new("ppp", "PPP"),
        Column::new("paper_psnr", "paper: PSNR"),
        Column::new("paper_ssim", "SSIM"),
        Column::new("psnr", "here: psnr"),
        Column::new("psnr_a", "psnr-a"),
        Column::new("ssim", "SSIM"),
        Column::new("lpips_alex", "lpips-alex"),
        Column::new("lpips_vgg", "lpips-vgg"),
        Column::new("note", "note"),
    ]);
    let mut levels: Vec<f64> = rows.iter().map(|row| row.ppp).collect();
    levels.dedup();
    for ppp in levels {
        let level = LEVELS.iter().position(|level| *level == ppp).filter(|_| has_light_of_paper);
        for (method, paper) in &PAPER {
            let of_paper = |axis: usize, digits: usize| {
                Cell::number(level.map(|level| paper[level][axis]), digits)
            };
            let mine = rows.iter().filter(|row| row.method == *method && row.ppp == ppp);
            let mut mine: Vec<Option<&Row>> = mine.map(Some).collect();
            if mine.is_empty() {
                mine.push(None);
            }
            for row in mine {
                let mean = |metric: &Metric| {
                    let mean = row.and_then(|row| row.over_clips(metric)).map(|s| s.mean);
                    Cell::number(mean, metric.digits)
                };
                let note = match row {
                    Some(Row { refused: Some(reason), .. }) => Cell::text(reason.clone()),
                    Some(Row { trained: Some(trained), .. }) => {
                        Cell::text(format!("trained here: {trained}"))
                    }
                    Some(_) => Cell::Unknown,
                    None => Cell::text(format!("no weights: --weights {method}=FILE")),
                };
                table.rows.push(vec![
                    Cell::text(*method),
                    row.map_or(Cell::Unknown, steps),
                    Cell::Exact(ppp),
                    of_paper(0, 2),
                    of_paper(1, 3),
                    mean(&PSNR),
                    mean(&PSNR_A),
                    mean(&SSIM),
                    mean(&LPIPS_ALEX),
                    mean(&LPIPS_VGG),
                    note,
                ]);
            }
        }
    }
    table.without_unknown_columns()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_methods_of_the_paper_are_here() {
        assert!(PAPER.iter().all(|(name, _)| Method::by_name(name).is_some()));
    }
}
