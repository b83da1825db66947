//! `qudi info`: captures, bursts, weights, sensors, devices.

use super::args::Info;
use super::capture;
use super::record::{origin, record_document};
use crate::args::Global;
use crate::error::{CliError, Result};
use crate::methods::{QUDI_DIFFUSION, QUDI_REGRESSION, learned_names};
use crate::report::Report;
use crate::settings::{Settings, recipe_keys, toml_text};
use crate::weights::{BuiltIn, Weights};
use burn::tensor::Device;
use qudi_baselines::import::{Contents, describe};
use qudi_core::sensor::{PRESETS, Response, Sensor, preset};
use qudi_io::codec::FORMATS;
use qudi_io::sidecar::Sidecar;
use qudi_layers::Provenance;
use serde_json::{Map, Value, json};
use std::fmt::Write;
use std::path::{Path, PathBuf};

pub(crate) fn run(
    info: &Info,
    settings: &Settings,
    global: &Global,
    report: &Report,
) -> Result<()> {
    if info.sensors || info.formats || info.devices {
        settings.refuse(&["sensor."], "by lists")?;
    }
    if info.sensors {
        return sensors(report);
    }
    if info.formats {
        return formats(report);
    }
    if info.devices {
        return devices(report);
    }
    let subject = info.subject.as_deref().unwrap_or_default();
    let path = Path::new(subject);
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let transforms = path.file_name().is_some_and(|name| name == "transforms.json");
    match extension.as_deref() {
        Some("toml") => sensor(subject, settings, report),
        Some("safetensors" | "pth" | "pt") if path.is_file() => {
            settings.refuse(&["sensor."], "for weights")?;
            match describe(path, &Device::flex())? {
                Some(contents) => learned(&contents, path, report),
                None if extension.as_deref() == Some("safetensors") => {
                    let (text, document) = weights(&Weights::File(path.to_owned()))?;
                    report.result(&text, || document)
                }
                None => Err(CliError::new(
                    "weights of no network that is known here",
                    path.display(),
                    format!("known are {}", learned_names().join(", ")),
                )),
            }
        }
        Some("json") if path.is_file() && !transforms => {
            settings.refuse(&["sensor."], "for records: name the burst")?;
            burst(path, report)
        }
        _ if path.exists() => {
            let beside = [PathBuf::from(format!("{subject}.json")), path.join("burst.json")];
            // A record that cannot be read is remarked upon when the capture is opened.
            let record = beside.into_iter().find(|record| record.is_file());
            let record = record.and_then(|path| Some((Sidecar::load(&path).ok()?, path)));
            capture::run(path, record.as_ref(), info, settings, global, report)
        }
        _ if preset(subject).is_some() => sensor(subject, settings, report),
        _ if subject == "weights" => {
            settings.refuse(&["sensor."], "for weights")?;
            built_in_weights(report)
        }
        _ => Err(CliError::new(
            format!("there is no file and no sensor named `{subject}`"),
            subject,
            "list sensors with `qudi info --sensors`",
        )),
    }
}

fn sensors(report: &Report) -> Result<()> {
    let sensors =
        PRESETS.iter().map(|p| Sensor::load(p.name)).collect::<qudi_core::Result<Vec<_>>>()?;
    let mut text = format!(
        "{:<15}{:<8}{:>4}{:>8}{:>9}{:>7}{:>8}  summary\n",
        "name", "kind", "bits", "QE", "dark", "read", "fps"
    );
    for s in &sensors {
        let mark = |key: &str, value: String| {
            if s.unverified.iter().any(|u| u == key) { format!("{value}?") } else { value }
        };
        let _ = writeln!(
            text,
            "{:<15}{:<8}{:>4}{:>8}{:>9}{:>7}{:>8}  {}",
            s.name,
            if s.response == Response::Binary { "binary" } else { "linear" },
            mark("bits", s.bits.to_string()),
            mark("quantum_efficiency", format!("{:.3}", s.quantum_efficiency)),
            mark("dark", s.dark.to_string()),
            mark("read_noise", s.read_noise.to_string()),
            s.fps.map_or("-".to_owned(), |fps| fps.to_string()),
            s.summary
        );
    }
    text += "\n?  no source confirms this number.  Sources: `qudi info NAME`.  dark: e- per frame, or per second (/s); read noise in e-.\n";
    report.result(&text, || json!(sensors))
}

/// Describes the networks in the program.
fn built_in_weights(report: &Report) -> Result<()> {
    let methods = [
        (QUDI_REGRESSION.name, BuiltIn::Regression),
        (QUDI_DIFFUSION.name, BuiltIn::Diffusion),
        ("qudi-diffusion --correct", BuiltIn::Correction),
    ];
    let (mut texts, mut documents) = (Vec::new(), Map::new());
    for (method, network) in methods {
        let (text, document) = weights(&Weights::BuiltIn(network))?;
        texts.push(format!("method      {method}\n{text}"));
        documents.insert(method.to_owned(), document);
    }
    report.result(&texts.join("\n\n"), || Value::Object(documents))
}

/// Returns a description of weights, in words and as a document.
fn weights(weights: &Weights) -> Result<(String, Value)> {
    let d = weights.describe()?;
    let sizes = d.network.parameters(&Device::flex());
    let kind = d.network.kind();
    let steps = d.sampling.map_or(String::new(), |s| format!("; {} steps by default", s.steps));
    let passes = match d.passes {
        1 => String::new(),
        passes => format!("; has learnt {passes} passes"),
    };
    let preset = d.network.preset_name().unwrap_or("own sizes");
    let mut lines = vec![
        ("network", format!("{preset}, {sizes} parameters")),
        ("window", format!("{} frames", d.window)),
        ("restores by", format!("{kind}{steps}{passes}")),
    ];
    lines.extend(provenance(&d.provenance));
    lines.push(("sha-256", weights.sha256()?));
    let text = to_text(&lines) + &recipes(&d.provenance);
    Ok((text, json!(d)))
}

/// Returns lines about the training of weights.
fn provenance(p: &Provenance) -> [(&'static str, String); 5] {
    let commit = p.commit.as_ref().map_or(String::new(), |c| format!(", commit {c}"));
    let [least, most] = p.ppp;
    [
        ("sensors", p.sensors.join(", ")),
        ("light", format!("{least} to {most} photons per pixel and frame")),
        ("trained", format!("{} steps on {}", p.steps, p.data.join(", "))),
        ("made by", p.program.clone() + &commit),
        ("licence", p.licence.clone()),
    ]
}

/// Formats the recipes of all stages: every key that is set, and the defaults of other keys of `train`.
fn recipes(p: &Provenance) -> String {
    let mut text = String::new();
    for (number, recipe) in p.recipes.iter().enumerate() {
        let table: toml::Table = recipe.parse().unwrap_or_default();
        let _ = write!(text, "\nrecipe of stage {}\n\n{recipe}", number + 1);
        let unset = recipe_defaults(&table);
        if !unset.is_empty() {
            let _ = writeln!(text, "\ndefaults    {}", unset.join(", "));
        }
    }
    text
}

/// Returns the keys of `train` that a recipe leaves at their defaults, as they would be set.
fn recipe_defaults(recipe: &toml::Table) -> Vec<String> {
    let is_set = |name: &str| {
        let (part, keys) = name.split_once('.')?;
        let mut value = recipe.get(part)?;
        for key in keys.split('.') {
            value = value.get(key)?;
        }
        Some(())
    };
    let keys = recipe_keys().into_iter().map(|(key, _)| key);
    let unset = keys.filter(|key| {
        let of_training = key.name.starts_with("train.") && !key.name.contains(".0");
        of_training && !key.default.is_null() && is_set(&key.name).is_none()
    });
    unset.map(|key| format!("{} = {}", key.name, toml_text(&key.default))).collect()
}

/// Formats lines of keys and values.
fn to_text(lines: &[(&str, String)]) -> String {
    let mut text = String::new();
    for (key, value) in lines {
        let _ = writeln!(text, "{key:<12}{value}");
    }
    text
}

/// Describes weights of a learned method of others.
fn learned(contents: &Contents, path: &Path, report: &Report) -> Result<()> {
    let Contents { method, sizes, parameters, description } = contents;
    let sha256 = Weights::File(path.to_owned()).sha256()?;
    let name = method.name();
    let mut lines =
        vec![("network", format!("{name}, {parameters} parameters")), ("sizes", sizes.clone())];
    if let Some(d) = description {
        lines.push(("bursts", format!("{} frames", d.frames)));
        lines.extend(provenance(&d.provenance));
    }
    lines.extend([
        ("use", format!("--method {name} --weights {name}={}", path.display())),
        ("sha-256", sha256.clone()),
    ]);
    let trained = description.as_ref().map(|description| recipes(&description.provenance));
    report.result(&(to_text(&lines) + &trained.unwrap_or_default()), || {
        let mut document =
            json!({"method": name, "parameters": parameters, "sizes": sizes, "sha256": sha256});
        if let Some(description) = description {
            document["trained"] = json!(description);
        }
        document
    })
}

fn sensor(name: &str, settings: &Settings, report: &Report) -> Result<()> {
    let sensor = settings.sensor(name)?;
    // A preset as it was written, with the remarks on its numbers.
    let text = match preset(name) {
        Some(preset) if !settings.overrides_sensor() => preset.toml.to_owned(),
        _ => {
            toml::to_string(&sensor).map_err(|e| CliError::new(e, name, "report this as a bug"))?
        }
    };
    report.result(&text, || json!(sensor))
}

/// Describes a record without its burst.
fn burst(path: &Path, report: &Report) -> Result<()> {
    let record = Sidecar::load(path)?;
    let burst = match &record {
        Sidecar::Simulated(record) => &record.burst,
        Sidecar::Converted(conversion) => &conversion.burst,
    };
    let mut text = format!(
        "{:<11}{} of {}, {} bit, counts up to {}\n",
        "frames", burst.frames, burst.size, burst.bits, burst.max_count
    );
    if let Some(fps) = burst.fps {
        let _ = writeln!(text, "{:<11}{fps} frames per second", "rate");
    }
    report.result(&(text + &origin(&record, path)), || record_document(&record))
}

/// Lists the formats that captures are read from.
fn formats(report: &Report) -> Result<()> {
    let width = FORMATS.iter().map(|format| format.name.len()).max().unwrap_or(0) + 2;
    let lines: Vec<String> =
        FORMATS.iter().map(|f| format!("{:width$}{}\n", f.name, f.title)).collect();
    let text =
        format!("{}\nlayouts and how they are recognised: docs/formats.md\n", lines.concat());
    report.result(&text, || {
        FORMATS.iter().map(|f| json!({"name": f.name, "title": f.title})).collect()
    })
}

fn devices(report: &Report) -> Result<()> {
    let devices = crate::device::list();
    let mut text = String::new();
    for device in &devices {
        let _ = writeln!(text, "{:<14}{}", device.name, device.description);
    }
    report.result(&text, || {
        devices.iter().map(|d| json!({"device": d.name, "description": d.description})).collect()
    })
}
