//! `qudi config`: the settings, where they come from, what they mean.

use super::args::{Config, ConfigAction};
use crate::error::Result;
use crate::report::{Report, print};
use crate::settings::{KEYS, Settings, baseline_sizes, shown_recipe, toml_text};
use serde_json::{Value, json};
use std::fmt::Write;

pub(crate) fn run(config: &Config, settings: &Settings, report: &Report) -> Result<()> {
    match config.action {
        ConfigAction::Show => show(settings, report),
        ConfigAction::Docs => print(&docs()),
    }
}

fn show(settings: &Settings, report: &Report) -> Result<()> {
    let text_of = |value: &Value| match value {
        Value::Null => "-".to_owned(),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let recipe = settings.recipe_changes().iter();
    let recipe = recipe.map(|(name, value, origin)| (name.as_str(), value, origin.as_str()));
    let all: Vec<_> = settings.iter().chain(recipe).collect();
    let rows: Vec<_> =
        all.iter().map(|&(name, value, origin)| (name, text_of(value), origin)).collect();
    let names = rows.iter().map(|r| r.0.len()).max().unwrap_or(0);
    let values = rows.iter().map(|r| r.1.len()).max().unwrap_or(0);
    let mut text = String::new();
    for (name, value, origin) in &rows {
        let _ = writeln!(text, "{name:names$}  {value:values$}  {origin}");
    }
    report.result(&text, || {
        all.iter()
            .map(|(name, value, origin)| json!({"key": name, "value": value, "origin": origin}))
            .collect()
    })
}

/// Writes the reference of all keys; `configs/README.md` is this text.
fn docs() -> String {
    let mut text = String::from(
        "# Settings

Every command reads settings in layers; the later one wins:

1. built-in defaults,
2. `--config FILE`, a TOML file of the keys below,
3. the environment: `QUDI_SIMULATE_PPP` sets `simulate.ppp`, and so on for every key,
4. `--set KEY=VALUE`,
5. flags.

| keys | commands that take them |
|---|---|
| `simulate.*` | `simulate`; `eval` on clips, where its own flags win |
| `sensor.*` | `simulate`, `eval`, `restore`, `info`, `calibrate`, `light`, `demo`: on top of the chosen sensor |
| `network.*`, `data.*`, `train.*`, `validation.*` | `train`: on top of the chosen recipe |

Unknown keys are errors everywhere. `--set` with a key that the command does not take is an error. A file and the
environment are shared between commands: there, known keys of other commands are left alone.

Sensor files in `sensors/` hold the keys of `[sensor]` without the prefix, and `base = \"PRESET\"` starts one from a
preset. This page is the output of `qudi config docs`.

## Keys of the simulation and the sensor

| key | default | meaning |
|---|---|---|
",
    );
    for key in KEYS {
        let default =
            if key.default.is_empty() { String::new() } else { format!("`{}`", key.default) };
        let _ = writeln!(text, "| `{}` | {default} | {} |", key.name, key.doc);
    }
    let (preset, keys) = shown_recipe();
    let _ = write!(
        text,
        "
## Keys of recipes

Keys of `qudi train`, with their values in `{preset}.toml`; numbers in them count the entries of lists. What they mean
stands in [training](../docs/training.md).

| key | `{preset}` |
|---|---|
"
    );
    for (key, value) in keys {
        let _ = writeln!(text, "| `{key}` | `{}` |", toml_text(&value));
    }
    text += "
Recipes with `network.method` are for [learned methods of others](../docs/training.md#learned-methods-of-others), with
other keys in `[network]`:

| recipe | keys of `[network]` besides `method` |
|---|---|
";
    for (recipe, sizes) in baseline_sizes() {
        let sizes = sizes.iter().map(|(key, value)| format!("`{key} = {}`", toml_text(value)));
        let sizes = sizes.collect::<Vec<_>>().join(", ");
        let _ = writeln!(text, "| `baselines/{recipe}.toml` | {sizes} |");
    }
    text
}
