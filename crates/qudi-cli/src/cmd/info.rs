//! `qudi info`: sensors, devices, and bursts that this program wrote.

use crate::args::Info;
use crate::error::{Fault, Result};
use crate::report::Report;
use qudi_sim::record::Record;
use qudi_sim::sensor::{PRESETS, Response, Sensor, preset};
use serde_json::json;
use std::fmt::Write;
use std::path::{Path, PathBuf};

pub(crate) fn run(info: &Info, report: &Report) -> Result<()> {
    if info.sensors {
        return sensors(report);
    }
    if info.devices {
        return devices(report);
    }
    let subject = info.subject.as_deref().unwrap_or_default();
    let record = [
        PathBuf::from(subject),
        PathBuf::from(format!("{subject}.json")),
        Path::new(subject).join("burst.json"),
    ]
    .into_iter()
    .find(|path| path.extension().is_some_and(|e| e == "json") && path.is_file());
    match record {
        Some(path) => burst(&path, report),
        None if preset(subject).is_some()
            || Path::new(subject).extension().is_some_and(|e| e == "toml") =>
        {
            sensor(subject, report)
        }
        None if Path::new(subject).exists() => Err(Fault::new(
            "no record lies beside it, so nothing is known about it",
            subject,
            "give a burst made by `qudi simulate`, its .json, or a sensor",
        )),
        None => Err(Fault::new(
            format!("there is no file and no sensor named `{subject}`"),
            subject,
            "list sensors with `qudi info --sensors`",
        )),
    }
}

fn sensors(report: &Report) -> Result<()> {
    let sensors =
        PRESETS.iter().map(|p| Sensor::load(p.name)).collect::<qudi_sim::Result<Vec<_>>>()?;
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

fn sensor(name: &str, report: &Report) -> Result<()> {
    let sensor = Sensor::load(name)?;
    // A preset as it was written, with the remarks on its numbers.
    let text = match preset(name) {
        Some(preset) => preset.toml.to_owned(),
        None => {
            toml::to_string(&sensor).map_err(|e| Fault::new(e, name, "report this as a bug"))?
        }
    };
    report.result(&text, || json!(sensor))
}

fn burst(path: &Path, report: &Report) -> Result<()> {
    let record = Record::load(path)?;
    let (burst, simulation) = (&record.burst, &record.simulation);
    let mut text = String::new();
    let _ = writeln!(
        text,
        "burst     {} frames of {}, {} bit, counts up to {}",
        burst.frames, burst.size, burst.bits, burst.max_count
    );
    let packing =
        if burst.bitpack { ", 8 pixels per byte, first pixel in the highest bit" } else { "" };
    let _ =
        writeln!(text, "layout    {}{packing}", json!(burst.format).as_str().unwrap_or_default());
    if let Some(fps) = burst.fps {
        let _ = writeln!(text, "rate      {fps} frames per second");
    }
    let _ = writeln!(text, "sensor    {}, gain {:.4} DN/e-", simulation.sensor.name, record.gain);
    let _ = writeln!(
        text,
        "light     {:.4} incident photons/pixel/frame, exposure {:.4}",
        record.light.ppp, record.light.exposure
    );
    let _ = writeln!(text, "scene     {}", simulation.input.place());
    let _ = writeln!(text, "seed      {}", simulation.seed);
    let _ = writeln!(
        text,
        "made by   {}; again: qudi simulate --from {} -o OUT",
        record.program,
        path.display()
    );
    report.result(&text, || json!(record))
}

fn devices(report: &Report) -> Result<()> {
    let devices = crate::device::list();
    let mut text = String::new();
    for device in &devices {
        let _ = writeln!(text, "{:<10}{}", device.name, device.description);
    }
    report.result(&text, || {
        devices.iter().map(|d| json!({"device": d.name, "description": d.description})).collect()
    })
}
