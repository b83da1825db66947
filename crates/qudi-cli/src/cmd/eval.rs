//! `qudi eval`: methods against known truth, on the same photons.

use crate::args::{Eval, Global, Protocol};
use crate::cmd::eval_clip::{Clip, Score};
use crate::cmd::eval_html::html;
use crate::cmd::eval_table::{about, csv, markdown, table};
use crate::cmd::methods::METHODS;
use crate::error::{Fault, Result};
use crate::interrupt;
use crate::report::Report;
use qudi_sim::metrics::Statistics;
use qudi_sim::output::{Overwrite, PendingFile, refuse_taken};
use qudi_sim::sensor::Sensor;
use serde_json::{Value, json};
use std::io::Write;
use std::path::Path;

/// All scores of one method at one light level.
pub(crate) struct Row {
    pub(crate) method: String,
    pub(crate) ppp: f64,
    /// One per clip.
    pub(crate) scores: Vec<Score>,
}

/// A figure of a frame, and its name.
type Figure = fn(&crate::cmd::eval_clip::FrameScore) -> f64;

impl Row {
    /// Statistics over clips of the mean over each clip's frames.
    pub(crate) fn over_clips(&self, figure: Figure) -> Option<Statistics> {
        let means: Vec<f64> = self
            .scores
            .iter()
            .map(|score| score.frames.iter().map(figure).sum::<f64>() / score.frames.len() as f64)
            .collect();
        Statistics::of(&means)
    }

    /// Statistics over clips of the frame in the middle.
    pub(crate) fn centre(&self, figure: Figure) -> Option<Statistics> {
        let centres: Vec<f64> =
            self.scores.iter().map(|s| figure(&s.frames[s.frames.len() / 2])).collect();
        Statistics::of(&centres)
    }

    /// Statistics over all frames of all clips.
    pub(crate) fn over_frames(&self, figure: Figure) -> Option<Statistics> {
        let all: Vec<f64> = self.scores.iter().flat_map(|s| &s.frames).map(figure).collect();
        Statistics::of(&all)
    }

    /// Mean over clips, where known.
    pub(crate) fn mean(&self, value: impl Fn(&Score) -> Option<f64>) -> Option<f64> {
        let known: Option<Vec<f64>> = self.scores.iter().map(value).collect();
        known.and_then(|values| Statistics::of(&values)).map(|statistics| statistics.mean)
    }
}

pub(crate) fn run(args: &Eval, global: &Global, report: &Report) -> Result<()> {
    let overwrite = if global.force { Overwrite::Yes } else { Overwrite::No };
    for path in [&args.csv, &args.markdown, &args.html, &args.export_photons].into_iter().flatten()
    {
        refuse_taken(path, overwrite)?;
    }
    if let Some(unknown) = args.method.iter().find(|name| !METHODS.contains(&name.as_str())) {
        return Err(Fault::new(
            format!("no method named `{unknown}`"),
            "--method",
            format!("there are {}", METHODS.join(" and ")),
        ));
    }
    if args.protocol == Protocol::Quiver
        && (args.export_photons.is_some() || !args.external.is_empty())
    {
        return Err(Fault::new(
            "the quiver protocol draws new photons for every window",
            "--protocol",
            "other programs are compared under the strict protocol",
        ));
    }
    let sensor = Sensor::load(&args.sensor)?;
    let clips = Clip::find(&args.data)?;
    if let Some(folder) = &args.export_photons {
        std::fs::create_dir_all(folder)
            .map_err(|e| qudi_sim::SimError::io("create the folder", folder, e))?;
    }
    let mut rows: Vec<Row> = Vec::new();
    let names: Vec<&String> =
        args.method.iter().chain(args.external.iter().map(|external| &external.name)).collect();
    for &ppp in &args.ppp {
        rows.extend(names.iter().map(|&name| Row {
            method: name.clone(),
            ppp,
            scores: Vec::new(),
        }));
    }
    let mut pictures = Vec::new();
    let mut bar = report.bar();
    let total = (clips.len() * args.ppp.len()) as u64;
    for (i, clip) in clips.iter().enumerate() {
        for (j, &ppp) in args.ppp.iter().enumerate() {
            bar.update("evaluating", (i * args.ppp.len() + j) as u64, Some(total));
            if interrupt::check().is_break() {
                return Err(Fault::Interrupted);
            }
            let exposed = clip.expose(args, &sensor, ppp, overwrite)?;
            if args.html.is_some() {
                pictures.push(exposed.pictures());
            }
            for (k, name) in names.iter().enumerate() {
                let external = k.checked_sub(args.method.len()).map(|k| &args.external[k]);
                let score = match (external, args.protocol) {
                    (Some(external), _) => exposed.score_external(external)?,
                    (None, Protocol::Strict) => exposed.score_method(name, args)?,
                    (None, Protocol::Quiver) => exposed.score_windows(name)?,
                };
                rows[j * names.len() + k].scores.push(score);
            }
        }
    }
    drop(bar);
    write(args.csv.as_deref(), &csv(&rows), overwrite)?;
    if args.html.is_some() {
        let page = html(&rows, &pictures, &about(args, clips.len()));
        write(args.html.as_deref(), &page, overwrite)?;
    }
    write(args.markdown.as_deref(), &markdown(&rows), overwrite)?;
    report.result(&table(&rows, args, clips.len()), || document(args, &sensor, &rows))?;
    let psnr_a = |row: &Row| row.over_clips(|f| f.psnr_a).map_or(f64::NAN, |s| s.mean);
    match args.min_psnr {
        Some(bar) => match rows.iter().find(|row| psnr_a(row) < bar) {
            Some(row) => Err(Fault::Missed(format!(
                "missed: {} reaches {:.2} dB at {} PPP, below {bar}",
                row.method,
                psnr_a(row),
                row.ppp
            ))),
            None => Ok(()),
        },
        None => Ok(()),
    }
}

fn write(path: Option<&Path>, text: &str, overwrite: Overwrite) -> Result<()> {
    let Some(path) = path else { return Ok(()) };
    let mut file = PendingFile::create(path, overwrite)?;
    file.write_all(text.as_bytes()).map_err(|e| file.fault(e))?;
    Ok(file.finish()?)
}

fn document(args: &Eval, sensor: &Sensor, rows: &[Row]) -> Value {
    let row = |row: &Row| {
        json!({
            "method": row.method,
            "ppp": row.ppp,
            "psnr_a": {"centre": row.centre(|f| f.psnr_a), "all": row.over_clips(|f| f.psnr_a), "frames": row.over_frames(|f| f.psnr_a)},
            "psnr": {"centre": row.centre(|f| f.psnr), "all": row.over_clips(|f| f.psnr)},
            "ssim": {"centre": row.centre(|f| f.ssim), "all": row.over_clips(|f| f.ssim)},
            "ssim_g": {"centre": row.centre(|f| f.ssim_g), "all": row.over_clips(|f| f.ssim_g)},
            "chi_square": row.mean(|s| s.chi_square),
            "flicker": row.mean(|s| s.flicker),
            "seconds_per_frame": row.mean(|s| s.seconds_per_frame),
            "clips": row.scores,
        })
    };
    json!({
        "protocol": args.protocol,
        "data": args.data,
        "sensor": sensor,
        "seed": args.seed,
        "exposure": args.exposure,
        "overlap": args.overlap,
        "rows": rows.iter().map(row).collect::<Vec<_>>(),
    })
}
