//! `qudi config`: the settings, where they come from, what they mean.

use crate::args::{Config, ConfigAction, Global};
use crate::error::Result;
use crate::keys::KEYS;
use crate::report::{Report, print};
use crate::settings::Settings;
use serde_json::{Value, json};
use std::fmt::Write;

pub(crate) fn run(config: &Config, global: &Global, report: &Report) -> Result<()> {
    match config.action {
        ConfigAction::Show => show(&Settings::load(global, Vec::new())?, report),
        ConfigAction::Docs => print(&docs()),
    }
}

fn show(settings: &Settings, report: &Report) -> Result<()> {
    let text_of = |value: &Value| match value {
        Value::Null => "-".to_owned(),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let rows: Vec<_> =
        settings.iter().map(|(name, value, origin)| (name, text_of(value), origin)).collect();
    let names = rows.iter().map(|r| r.0.len()).max().unwrap_or(0);
    let values = rows.iter().map(|r| r.1.len()).max().unwrap_or(0);
    let mut text = String::new();
    for (name, value, origin) in &rows {
        let _ = writeln!(text, "{name:names$}  {value:values$}  {origin}");
    }
    report.result(&text, || {
        settings
            .iter()
            .map(|(name, value, origin)| json!({"key": name, "value": value, "origin": origin}))
            .collect()
    })
}

/// The reference of all keys; `configs/README.md` is this text.
fn docs() -> String {
    let mut text = String::from(
        "# Settings

Keys of `--config FILE` (TOML) and `--set KEY=VALUE`. `QUDI_SIMULATE_PPP` in the environment sets
`simulate.ppp`, and so on for every key. Later layers win: defaults, file, environment, `--set`,
flags. Unknown keys are errors. Keys of `[sensor]` override the chosen sensor; sensor files in
`sensors/` hold the same keys without the prefix, and `base = \"PRESET\"` starts one from a preset.

This page is the output of `qudi config docs`.

| key | default | meaning |
|---|---|---|
",
    );
    for key in KEYS {
        let default =
            if key.default.is_empty() { String::new() } else { format!("`{}`", key.default) };
        let _ = writeln!(text, "| `{}` | {default} | {} |", key.name, key.doc);
    }
    text
}
