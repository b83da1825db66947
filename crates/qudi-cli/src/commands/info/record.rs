//! Records of bursts: where a burst comes from, and how to make it again.

use qudi_io::sidecar::Sidecar;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::Path;

/// Returns the record as a JSON document.
pub(crate) fn record_document(record: &Sidecar) -> Value {
    match record {
        Sidecar::Simulated(record) => json!(record),
        Sidecar::Converted(conversion) => json!(conversion),
    }
}

/// Describes where a burst comes from, and how to make it again.
pub(crate) fn origin(record: &Sidecar, path: &Path) -> String {
    let mut text = String::new();
    let mut line = |key: &str, value: String| {
        let _ = writeln!(text, "{key:<11}{value}");
    };
    match record {
        Sidecar::Simulated(record) => {
            let (simulation, light) = (&record.simulation, record.light);
            let sensor = &simulation.sensor.name;
            line("simulated", format!("sensor {sensor}, gain {:.4} DN/e-", record.gain));
            let (ppp, mean_level) = (light.ppp, light.mean_level);
            line("", format!("{ppp:.4} incident photons/pixel/frame, exposure {mean_level:.4}"));
            line("scene", simulation.input.place());
            line("seed", simulation.seed.to_string());
            line("made by", record.program.clone());
            line("again", format!("qudi simulate --from {} -o OUT", path.display()));
        }
        Sidecar::Converted(conversion) => {
            line("converted", format!("from {}", conversion.capture.display()));
            line("made by", conversion.program.clone());
        }
    }
    text
}
