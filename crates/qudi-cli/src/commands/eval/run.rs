//! `qudi eval`: methods against known truth on the same photons, or on a real capture without one.

use super::about::about;
use super::args::{Eval, External, Protocol};
use super::capture::{Evaluation, evaluate_capture};
use super::clip::Clip;
use super::colour::score_files;
use super::exposed_clip::ExposedClip;
use super::exposing::Exposing;
use super::html::{Pictures, html, loop_frames};
use super::join::join;
use super::mark::remarks;
use super::metrics::{METRICS, Metric, PSNR_A, Part};
use super::plan::Plan;
use super::score::{Row, Score};
use super::table::{frames, looks, summary};
use super::table1;
use crate::args::Global;
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::methods::trained::refusal;
use crate::report::{Output, Report, csv, markdown};
use crate::settings::Settings;
use qudi_core::Frame;
use qudi_core::atomic_file::refuse_taken;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

pub(crate) fn run(
    args: &Eval,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    if let Some(restored) = &args.restored {
        let backbones = args.backbones.as_deref();
        return score_files(Path::new(&args.data), restored, backbones, report);
    }
    let overwrite = global.overwrite();
    let output = |path: &Option<PathBuf>| Output::open(path.as_deref(), overwrite);
    let (csv_file, markdown_file) = (output(&args.csv)?, output(&args.markdown)?);
    let html_file = output(&args.html)?;
    if let Some(folder) = &args.export_photons {
        refuse_taken(folder, overwrite)?;
    }
    let plan = Plan::new(args, overwrite)?;
    let Evaluation { rows, pictures, about, settings } = if !args.join.is_empty() {
        join(&args.join)?
    } else if args.capture {
        evaluate_capture(&plan, settings, report)?
    } else {
        evaluate_clips(&plan, settings, report)?
    };
    for remark in remarks(&rows) {
        report.warning(&remark);
    }
    for (row, score) in rows.iter().flat_map(|row| row.scores.iter().map(move |s| (row, s))) {
        if let Some([low, high]) = score.range {
            let frames = format!("{} of {} at {} PPP", row.method, score.clip, row.ppp);
            report.remark(&format!("note: values of {frames} run from {low:.4} to {high:.4}"));
        }
    }
    csv_file.write(|| Ok(csv::table(&frames(&rows))))?;
    let mut further = looks(&rows);
    let mut about = about;
    if args.table1 {
        further.insert(
            0,
            (
                "The paper's table 1, and the same methods here",
                table1::table(&rows, plan.has_light_of_paper()),
            ),
        );
        about = format!("{about}\n{}", table1::REASONS);
    }
    html_file.write(|| html(&rows, &further, &pictures, &about))?;
    let table = summary(&rows);
    markdown_file.write(|| {
        let further = further.iter();
        let further =
            further.map(|(title, table)| format!("\n{title}:\n\n{}", markdown::table(table)));
        Ok(markdown::table(&table) + &further.collect::<String>())
    })?;
    let shown = further.iter().map(|(title, table)| format!("{title}\n{}\n", table.to_text()));
    let text = format!("{}\n{}{about}\n", table.to_text(), shown.collect::<String>());
    report.result(&text, || document(settings, &rows))?;
    match args.min_psnr.and_then(|bar| missed(&rows, bar)) {
        Some(missed) => Err(CliError::Missed(missed)),
        None => Ok(()),
    }
}

/// Returns what misses a least psnr-a: the first method that is worse, or was not measured.
fn missed(rows: &[Row], bar: f64) -> Option<String> {
    let psnr_a = |row: &Row| row.over_clips(&PSNR_A).map_or(f64::NAN, |s| s.mean);
    let row = rows.iter().find(|row| row.refused.is_some() || PSNR_A.misses(psnr_a(row), bar))?;
    let (method, ppp) = (row.label(), row.ppp);
    Some(match &row.refused {
        Some(reason) => format!("missed: {method} was not measured at {ppp} PPP: {reason}"),
        None => {
            format!("missed: {method} reaches {:.2} dB at {ppp} PPP, below {bar}", psnr_a(row))
        }
    })
}

/// Evaluates every method on every clip at every light level.
fn evaluate_clips(plan: &Plan, settings: &Settings, report: &Report) -> Result<Evaluation> {
    let exposing = Exposing::new(plan, settings)?;
    let set = settings.given("simulate.ppp")?.map(|ppp: f64| vec![ppp]);
    let levels = match &plan.ppp[..] {
        [] => &set.unwrap_or(table1::LEVELS.to_vec())[..],
        given => given,
    };
    let mut clips = Clip::only(Clip::find(&plan.data)?, &plan.clips, &plan.data)?;
    if let Some(shard) = plan.shard {
        let part = shard.range(clips.len() as u64);
        clips = clips.drain(part.start as usize..part.end as usize).collect();
        if clips.is_empty() {
            let help = "ask for at most as many parts as there are clips";
            return Err(CliError::new("this part holds no clip", "--shard", help));
        }
    }
    if let Some(folder) = &plan.export_photons {
        std::fs::create_dir_all(folder)
            .map_err(|e| qudi_core::Error::io("create the folder", folder, e))?;
    }
    let names: Vec<String> = clips.iter().map(|clip| clip.name().to_owned()).collect();
    let mut rows: Vec<Row> = Vec::new();
    for &ppp in levels {
        let own = plan.contenders.iter().map(|contender| contender.row(ppp));
        let row = |external: &External| Row::new(external.name.clone(), ppp);
        rows.extend(own.chain(plan.external.iter().map(row)));
    }
    let each = rows.len() / levels.len();
    let mut pictures = Vec::new();
    let mut bar = report.bar();
    let total = (clips.len() * levels.len()) as u64;
    let shown = match plan.protocol {
        Protocol::Strict => loop_frames(total as usize * (each + 2)),
        // Windows whose middle frames are scored have none at the ends.
        Protocol::Quiver => 1,
    };
    // By value: what was found out about a clip goes with it.
    for (i, clip) in clips.into_iter().enumerate() {
        for (j, &ppp) in levels.iter().enumerate() {
            bar.update("evaluating", (i * levels.len() + j) as u64, Some(total));
            if interrupt::check().is_break() {
                return Err(CliError::Interrupted);
            }
            let mut exposed = clip.expose(plan, &exposing, ppp)?;
            for note in exposed.notes.iter().filter(|_| j == 0) {
                report.warning(note);
            }
            if plan.pictures {
                pictures.push(exposed.show(shown));
            }
            score_all(plan, &exposed, &mut rows[j * each..][..each], pictures.last_mut())?;
        }
    }
    drop(bar);
    let settings = json!({
        "protocol": plan.protocol,
        "data": plan.data,
        "clips": names,
        "sensor": exposing.sensor,
        "seed": exposing.seed,
        "exposure": plan.mean_level,
        "overlap": plan.overlap,
        "lpips_missing": plan.appearance && plan.perceptual.is_none(),
    });
    let about = about(&settings, &rows);
    Ok(Evaluation { rows, pictures, about, settings })
}

/// Adds the scores of every method on a clip to the rows of its light level, and the pictures to the others
/// of it.
fn score_all(
    plan: &Plan,
    clip: &ExposedClip,
    rows: &mut [Row],
    mut pictures: Option<&mut Pictures>,
) -> Result<()> {
    let mut add = |row: &mut Row, mut score: Score| {
        if let Some(pictures) = &mut pictures {
            pictures.add(&row.label(), &mut score);
        }
        row.scores.push(score);
    };
    let mut fewest: Option<Vec<Frame>> = None;
    let (own, others) = rows.split_at_mut(plan.contenders.len());
    for (contender, row) in plan.contenders.iter().zip(own) {
        let provenance = contender.provenance.as_ref();
        row.refused = provenance.and_then(|provenance| refusal(provenance, &clip.acquisition));
        if row.refused.is_some() {
            continue;
        }
        let score = match plan.protocol {
            Protocol::Strict => {
                let (score, frames) = clip.score_method(contender, plan, fewest.as_deref())?;
                if contender.steps.is_some() {
                    fewest.get_or_insert(frames);
                }
                score
            }
            Protocol::Quiver => clip.score_windows(contender)?,
        };
        add(row, score);
    }
    for (external, row) in plan.external.iter().zip(others) {
        add(row, clip.score_external(external)?);
    }
    Ok(())
}

/// Makes the JSON document, without unknown values.
fn document(mut settings: Value, rows: &[Row]) -> Value {
    let row = |row: &Row| {
        let of = |metric: &Metric| {
            Some(json!({
                "centre": row.centre(metric)?,
                "all": row.over_clips(metric)?,
                "frames": row.over_frames(metric)?,
            }))
        };
        let figures = json!({
            "method": row.method,
            "trained": row.trained,
            "steps": row.steps,
            "ppp": row.ppp,
            "refused": row.refused,
            "added_over_missed": row.added(),
            "chi_square": row.mean(|s| s.chi_square),
            "flicker": row.mean(|s| s.flicker),
            "flow": row.flow(),
            "seconds_per_frame": row.mean(|s| s.seconds_per_frame),
            "peak_mib": row.peak_mib(),
            "clips": row.scores,
        });
        let Value::Object(mut figures) = figures else { return figures };
        let means = METRICS.iter().filter(|metric| metric.part != Part::Frames);
        figures.extend(means.map(|metric| (metric.key.to_owned(), json!(of(metric)))));
        figures.retain(|_, figure| !figure.is_null());
        Value::Object(figures)
    };
    settings["rows"] = rows.iter().map(row).collect();
    settings
}
