//! The environment of a run.

use crate::device::Opened;
use crate::error::Result;
use crate::version::COMMIT;
use qudi_io::restore::Fingerprint;
use serde_json::json;
use std::path::Path;

/// Name of the description in a run's folder.
pub(crate) const ENVIRONMENT: &str = "environment.json";

/// Returns program, system and devices as a JSON document.
pub(crate) fn environment(devices: &[Opened], pack: &Path) -> Result<String> {
    let names: Vec<&str> = devices.iter().map(|device| device.name.as_str()).collect();
    let started = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    let pack = pack.is_file().then(|| Fingerprint::of(pack)).transpose()?;
    let document = json!({
        "program": concat!("qudi ", env!("CARGO_PKG_VERSION")),
        "commit": COMMIT,
        "system": std::env::consts::OS,
        "architecture": std::env::consts::ARCH,
        "cores": std::thread::available_parallelism().map_or(1, usize::from),
        "threads": rayon::current_num_threads(),
        "devices": names,
        "pack": pack,
        "arguments": std::env::args().collect::<Vec<_>>(),
        "started_unix": started.map_or(0, |time| time.as_secs()),
    });
    Ok(serde_json::to_string_pretty(&document).unwrap_or_else(|e| e.to_string()))
}
