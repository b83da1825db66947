//! What a run ran on.

use crate::device::Opened;
use serde_json::json;

/// Name of the description in a run's folder.
pub(crate) const ENVIRONMENT: &str = "environment.json";

/// Program, system and devices as a JSON document.
pub(crate) fn environment(devices: &[Opened]) -> String {
    let names: Vec<&str> = devices.iter().map(|device| device.name.as_str()).collect();
    let started = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    let document = json!({
        "program": concat!("qudi ", env!("CARGO_PKG_VERSION")),
        "commit": option_env!("QUDI_COMMIT"),
        "system": std::env::consts::OS,
        "architecture": std::env::consts::ARCH,
        "cores": std::thread::available_parallelism().map_or(1, usize::from),
        "threads": rayon::current_num_threads(),
        "devices": names,
        "arguments": std::env::args().collect::<Vec<_>>(),
        "started_unix": started.map_or(0, |time| time.as_secs()),
    });
    serde_json::to_string_pretty(&document).unwrap_or_else(|e| e.to_string())
}
