//! Files and folders that a command writes.

use crate::args::{Command, Global};
use crate::commands::simulate::args::Simulate;
use crate::commands::train::args::Train;
use crate::commands::train::run_files;
use qudi_io::writer::BurstFormat;
use std::path::{Path, PathBuf};

/// Returns all outputs that the arguments name.
pub(super) fn outputs_of(command: &Command, global: &Global) -> Vec<PathBuf> {
    let mut list: Vec<PathBuf> = Vec::new();
    match command {
        Command::Simulate(args) => simulated(args, &mut list),
        Command::Restore(args) => {
            list.push(PathBuf::from(&args.output));
            let beside = [&args.chi_map, &args.side_by_side, &args.html, &args.uncertainty];
            list.extend(beside.into_iter().flatten().cloned());
        }
        Command::Convert(args) => {
            list.push(args.output.clone());
            list.extend(record(&args.output));
        }
        Command::Calibrate(args) => {
            list.extend(calibration_maps(&args.output));
            list.push(args.output.clone());
        }
        Command::Publish(args) => {
            list.extend([args.output.clone(), args.output.with_extension("sha256")]);
        }
        Command::Eval(args) => {
            let outputs = [&args.csv, &args.markdown, &args.html, &args.export_photons];
            list.extend(outputs.into_iter().flatten().cloned());
        }
        Command::Demo(args) => {
            let picture = args.output.clone().unwrap_or_else(|| PathBuf::from("qudi-demo.png"));
            list.push(picture.with_extension("html"));
            list.extend(args.animate.then(|| picture.with_extension("gif")));
            list.push(picture);
        }
        Command::Info(args) => list.extend(args.preview.clone()),
        Command::Look(args) => {
            list.push(args.output.clone().unwrap_or_else(|| default_look(&args.capture)));
        }
        Command::Train(args) => trained(args, global, &mut list),
        Command::Bench(_)
        | Command::Selftest(_)
        | Command::Light(_)
        | Command::Config(_)
        | Command::Completions(_)
        | Command::Man(_)
        | Command::View(_) => {}
    }
    list
}

/// Returns the maps that `qudi calibrate` writes next to a sensor file: dark rates, bad pixels.
pub(crate) fn calibration_maps(sensor: &Path) -> [PathBuf; 2] {
    ["dark", "bad"].map(|map| sensor.with_extension(format!("{map}.npy")))
}

/// Returns the page that `qudi look` writes if none is named.
pub(crate) fn default_look(capture: &Path) -> PathBuf {
    let stem = capture.file_stem().unwrap_or(capture.as_os_str()).to_string_lossy().into_owned();
    PathBuf::from(format!("{stem}-look.html"))
}

/// Returns the record next to a burst; the record of a folder lies in the folder.
fn record(burst: &Path) -> Option<PathBuf> {
    let format = BurstFormat::for_path(burst, 1, true).ok()?;
    Some(format.record_path(burst)).filter(|record| !record.starts_with(burst))
}

fn simulated(args: &Simulate, list: &mut Vec<PathBuf>) {
    let output = Path::new(&args.output);
    list.push(output.to_owned());
    if args.output != "-" {
        list.extend(record(output));
        list.extend(args.visionsim.then(|| output.with_file_name("transforms.json")));
    }
    list.extend([&args.truth, &args.flow, &args.preview].into_iter().flatten().cloned());
}

/// Adds what a training run writes into an existing folder, and its pack and bursts where they lie elsewhere.
/// A folder that it makes itself cannot hold an input.
fn trained(args: &Train, global: &Global, list: &mut Vec<PathBuf>) {
    let run = args.output.as_ref().filter(|folder| folder.exists());
    if let Some(folder) = run {
        let files = if folder.is_dir() { run_files(folder) } else { vec![folder.clone()] };
        list.extend(files);
    }
    let inside = |path: &Path| args.output.as_ref().is_some_and(|folder| path.starts_with(folder));
    let written = args.prepare || global.force;
    let pack = args.pack.iter().filter(|pack| !inside(pack) && (written || !pack.exists()));
    list.extend(pack.cloned());
    list.extend(args.bursts.iter().filter(|bursts| !inside(bursts) && bursts.exists()).cloned());
}
