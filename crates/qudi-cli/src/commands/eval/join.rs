//! Parts of an evaluation, which `--shard` made on several machines, joined to the whole.

use super::about::about;
use super::capture::Evaluation;
use super::exact_json;
use super::score::{Row, Score};
use crate::error::{CliError, Result};
use qudi_core::regular_file::read_text;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Bytes of a document: a megabyte or so for a clip.
const MAX_DOCUMENT_BYTES: u64 = 1 << 30;

/// Joins the documents that parts printed with `--json`, in their order.
///
/// # Errors
/// [`CliError`] if a file is no document of an evaluation, parts differ in more than their clips, or a clip
/// is in two of them.
pub(super) fn join(paths: &[PathBuf]) -> Result<Evaluation> {
    let mut joined: Option<(Value, Vec<Row>)> = None;
    for path in paths {
        let (settings, rows) = part(path)?;
        let Some((all_settings, all_rows)) = &mut joined else {
            joined = Some((settings, rows));
            continue;
        };
        let refuse = |what: String| {
            let help = "join parts of one evaluation: the same command, but for --shard";
            Err(CliError::new(what, path.display(), help))
        };
        let bare = |settings: &Value| {
            let mut settings = settings.clone();
            settings["clips"] = Value::Null;
            settings
        };
        if bare(&settings) != bare(all_settings) || rows.len() != all_rows.len() {
            return refuse("a part of another evaluation".to_owned());
        }
        let clips = |settings: &Value| settings["clips"].as_array().cloned().unwrap_or_default();
        let (mut all, more) = (clips(all_settings), clips(&settings));
        if let Some(clip) = more.iter().find(|clip| all.contains(clip)) {
            return refuse(format!("clip {clip} is in another part, too"));
        }
        all.extend(more);
        all_settings["clips"] = Value::Array(all);
        for (row, more) in all_rows.iter_mut().zip(rows) {
            if (&row.method, row.steps, row.ppp) != (&more.method, more.steps, more.ppp) {
                return refuse("a part with other methods or light levels".to_owned());
            }
            row.refused = row.refused.take().or(more.refused);
            row.scores.extend(more.scores);
        }
    }
    let Some((settings, rows)) = joined else {
        return Err(CliError::new("no part to join", "--join", "name the documents of all parts"));
    };
    let about = about(&settings, &rows);
    Ok(Evaluation { rows, pictures: Vec::new(), about, settings })
}

/// Reads the settings and the rows of a part.
fn part(path: &Path) -> Result<(Value, Vec<Row>)> {
    let text = read_text(path, MAX_DOCUMENT_BYTES, "read the part")?;
    let refuse = |what: String| {
        CliError::new(what, path.display(), "name what `qudi eval --shard I/N --json` printed")
    };
    let mut document =
        exact_json::parse(&text).map_err(|e| refuse(format!("not a document: {e}")))?;
    let rows = document.as_object_mut().and_then(|document| document.remove("rows"));
    let Some(Value::Array(rows)) = rows else {
        return Err(refuse("no rows of an evaluation in it".to_owned()));
    };
    let row = |value: &Value| {
        let text = |key: &str| value[key].as_str().map(str::to_owned);
        let scores = value["clips"].as_array()?.iter().map(Score::from_json);
        Some(Row {
            method: text("method")?,
            trained: text("trained"),
            steps: value["steps"].as_u64().map(|steps| steps as usize),
            ppp: value["ppp"].as_f64()?,
            refused: text("refused"),
            scores: scores.collect::<Option<_>>()?,
        })
    };
    let rows: Option<Vec<Row>> = rows.iter().map(row).collect();
    let rows = rows.ok_or_else(|| refuse("a row that is none of an evaluation".to_owned()))?;
    Ok((document, rows))
}
