//! Files and folders that a command reads.

use crate::args::{Command, Global, Network, Reading};
use crate::commands::eval::clip_places;
use crate::commands::simulate::args::Simulate;
use crate::commands::train::args::Train;
use crate::settings::Settings;
use qudi_core::sensor::{Sensor, load_document};
use qudi_io::codec::files_of;
use qudi_io::sidecar::{Record, Sidecar, beside};
use qudi_train::{RECIPE, Recipe};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Returns everything that the arguments and settings name: captures with their records, maps of sensors,
/// settings, recipes with what they learn from, packs, weights, masks, clips. What cannot be read is left
/// out: the command itself says so.
pub(super) fn inputs_of(command: &Command, settings: &Settings, global: &Global) -> Vec<PathBuf> {
    let mut inputs = Inputs { settings, list: global.config.clone().into_iter().collect() };
    inputs.maps_of_settings();
    match command {
        Command::Simulate(args) => inputs.simulation(args),
        Command::Restore(args) => {
            inputs.capture(&args.capture, &args.reading, args.sensor.as_deref());
            inputs.weights(&args.network);
        }
        Command::Convert(args) => inputs.capture(&args.capture, &args.reading, None),
        Command::Calibrate(args) => {
            inputs.capture(&args.capture, &args.reading, args.sensor.as_deref());
        }
        Command::Publish(args) => inputs.list.push(args.weights.clone()),
        Command::Eval(args) => {
            let sensor = args.sensor.as_deref();
            if args.capture {
                inputs.capture(Path::new(&args.data), &args.reading, sensor);
            } else {
                inputs.list.extend(clip_places(&args.data));
                inputs.list.extend(args.reading.files().into_iter().map(Path::to_owned));
                inputs.sensor_or_setting(sensor);
            }
            inputs.list.extend(args.join.iter().cloned());
            inputs.list.extend(args.external.iter().map(|external| external.folder.clone()));
            inputs.list.extend(args.backbones.clone());
            inputs.weights(&args.network);
        }
        Command::Bench(args) => {
            inputs.list.extend(args.compare.clone());
            inputs.weights(&args.network);
        }
        Command::Demo(args) => {
            inputs.sensor(&args.sensor);
            inputs.weights(&args.network);
        }
        Command::Light(args) => inputs.sensor(&args.sensor),
        Command::Info(args) => {
            if let Some(subject) = &args.subject {
                inputs.sensor(subject);
                inputs.capture(Path::new(subject), &args.reading, args.sensor.as_deref());
            }
        }
        Command::Look(args) => {
            inputs.capture(&args.capture, &args.reading, args.sensor.as_deref());
        }
        Command::Train(args) => inputs.training(args, global),
        Command::Selftest(_)
        | Command::Config(_)
        | Command::Completions(_)
        | Command::Man(_)
        | Command::View(_) => {}
    }
    inputs.list
}

struct Inputs<'a> {
    settings: &'a Settings,
    list: Vec<PathBuf>,
}

impl Inputs<'_> {
    /// Adds maps that settings give to any sensor.
    fn maps_of_settings(&mut self) {
        for key in ["sensor.defects.dark_map", "sensor.defects.bad_pixels"] {
            let map = self.settings.get::<Option<Value>>(key).ok().flatten();
            self.list.extend(map.as_ref().and_then(Value::as_str).map(PathBuf::from));
        }
    }

    /// Adds a sensor's file and its maps; built-in sensors have none.
    fn sensor(&mut self, name: &str) {
        self.list.push(PathBuf::from(name));
        let document = load_document(name).unwrap_or(Value::Null);
        for key in ["/defects/dark_map", "/defects/bad_pixels"] {
            self.list.extend(document.pointer(key).and_then(Value::as_str).map(PathBuf::from));
        }
    }

    /// Adds the sensor that is named, or else the settings' own.
    fn sensor_or_setting(&mut self, name: Option<&str>) {
        if let Some(name) = name {
            self.sensor(name);
        } else if let Ok(name) = self.settings.get::<String>("simulate.sensor") {
            self.sensor(&name);
        }
    }

    /// Adds the maps of a sensor in a record.
    fn maps(&mut self, sensor: &Sensor) {
        self.list.extend(sensor.defects.dark_map.iter().map(PathBuf::from));
        self.list.extend(sensor.defects.bad_pixels.iter().map(PathBuf::from));
    }

    /// Adds a capture with its record, and what is read with it.
    fn capture(&mut self, path: &Path, reading: &Reading, sensor: Option<&str>) {
        self.list.extend(files_of(path));
        for record in [beside(path), path.join("burst.json")] {
            let sensor = match Sidecar::load(&record) {
                Ok(Sidecar::Simulated(record)) => Some(record.simulation.sensor),
                Ok(Sidecar::Converted(conversion)) => conversion.sensor,
                Err(_) => None,
            };
            if let Some(sensor) = sensor {
                self.maps(&sensor);
            }
        }
        for file in reading.files() {
            // A calibrated sensor file has maps of its own.
            self.sensor(&file.to_string_lossy());
        }
        if let Some(name) = sensor {
            self.sensor(name);
        }
    }

    fn weights(&mut self, network: &Network) {
        self.list.extend(network.weight_files().cloned());
    }

    fn simulation(&mut self, args: &Simulate) {
        if let Some(path) = &args.from {
            self.list.push(path.clone());
            if let Ok(record) = Record::load(path) {
                self.list.push(PathBuf::from(record.simulation.input.place()));
                self.maps(&record.simulation.sensor);
            }
        }
        let input = args.input.iter().filter(|input| !input.starts_with("scene:"));
        self.list.extend(input.map(PathBuf::from));
        if let Ok(settings) = self.settings.clone().with_flags(&args.keys) {
            let mut with_flags = Inputs { settings: &settings, list: Vec::new() };
            with_flags.maps_of_settings();
            with_flags.sensor_or_setting(None);
            self.list.append(&mut with_flags.list);
        }
    }

    fn training(&mut self, args: &Train, global: &Global) {
        let own = args.output.as_ref().map(|folder| folder.join(RECIPE));
        let name = args.recipe.clone().or(own.as_ref().map(|own| own.display().to_string()));
        let is_own =
            own.is_some_and(|own| name.as_deref().is_some_and(|name| own == Path::new(name)));
        if let Some(name) = name {
            // A run that goes on writes its own recipe again, as it was.
            self.list.extend(Some(PathBuf::from(&name)).filter(|_| !(is_own && args.resume)));
            self.list.extend(Recipe::base_file(Path::new(&name)));
            if let Ok(recipe) = Recipe::load(&name, &[]) {
                self.recipe(&recipe, args.data.as_deref());
            }
        }
        self.list.extend(args.init.iter().chain(&args.backbones).cloned());
        self.list.extend(args.pack.iter().filter(|_| !args.prepare && !global.force).cloned());
    }

    /// Adds files and folders that a recipe learns from and is measured on, and its sensors.
    fn recipe(&mut self, recipe: &Recipe, data: Option<&Path>) {
        let stages = recipe.stages().unwrap_or_default();
        for recipe in std::iter::once(recipe).chain(stages.iter().map(|(_, recipe)| recipe)) {
            let sources = recipe.packed_sources();
            let from = sources.iter().flat_map(|source| &source.from);
            let files = from.flat_map(|from| data.iter().map(move |data| data.join(from)));
            self.list.extend(files);
            recipe.data.sensor.iter().for_each(|mix| self.sensor(&mix.name));
            if let Some(validation) = &recipe.validation {
                self.sensor(&validation.sensor);
            }
        }
    }
}
