//! `qudi config`: the settings, where they come from, what they mean.

use super::args::{Config, ConfigAction};
use crate::error::Result;
use crate::report::{Report, print};
use crate::settings::{Documented, Settings, baseline_keys, keys, recipe_keys, toml_text};
use qudi_baselines::import::{METHODS, Method};
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

/// An example of a file for `--config`.
const EXAMPLE: &str = include_str!("../../settings/example.toml");

/// Returns the reference of all keys; `docs/settings.md` is this text.
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

Unknown keys are errors everywhere. `--set` with a key that the command does not take is an error. A file and
the environment are shared between commands: there, known keys of other commands are ignored.

[Sensor files](sensors.md) hold the keys of `[sensor]` without the prefix, and `base = \"PRESET\"` starts one
from a preset. This page is the output of `qudi config docs`.

The settings of one experiment, for example:

```toml
",
    );
    text += EXAMPLE;
    text += "```

## Keys of the simulation and the sensor

Keys without a default have none, or the value of the chosen sensor.

| key | values | default | meaning |
|---|---|---|---|
";
    for Documented { name, values, default, doc, .. } in keys().iter().map(|key| &key.documented) {
        let _ = writeln!(text, "| `{name}` | {values} | {} | {doc} |", code(default));
    }
    text += "
## Keys of recipes

A recipe is a TOML file of these keys; [training](training.md) explains how they work together. `0`
stands for the number of an entry in a list. `base = \"data/open-clips.toml\"` starts a recipe from another
file. The last column names the recipes of the program that set the key.

| key | values | default | meaning | set by |
|---|---|---|---|---|
";
    for (key, recipes) in recipe_keys() {
        let Documented { name, values, default, is_required, doc, .. } = key;
        let default = if is_required { "required".to_owned() } else { code(&default) };
        let _ =
            writeln!(text, "| `{name}` | {values} | {default} | {doc} | {} |", setters(&recipes));
    }
    text += "
Recipes with `network.method` are for [learned methods of others](training.md#learned-methods-of-others),
with other keys in `[network]`:

| method | key | values | meaning |
|---|---|---|---|
";
    for (method, keys) in baseline_keys() {
        for Documented { name, values, doc, .. } in keys {
            let _ = writeln!(text, "| `{method}` | `{name}` | {values} | {doc} |");
        }
    }
    text
}

/// Returns a value in TOML as Markdown; nothing for no value.
fn code(value: &Value) -> String {
    if value.is_null() { String::new() } else { format!("`{}`", toml_text(value)) }
}

/// Returns the names of recipes, with one name for all learned methods together.
fn setters(recipes: &[&str]) -> String {
    let is_learned = |name: &&str| Method::by_name(name).is_some();
    let mut names: Vec<&str> = recipes.iter().copied().filter(|name| !is_learned(name)).collect();
    let learned: Vec<&str> = recipes.iter().copied().filter(is_learned).collect();
    if learned.len() == METHODS.len() {
        names.push("learned methods");
    } else {
        names.extend(learned);
    }
    names.join(", ")
}
