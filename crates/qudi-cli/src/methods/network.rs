//! The network behind `--method qudi`: weights, device, options.

use super::options::NetworkOptions;
use crate::device;
use crate::error::{CliError, Result};
use crate::memory::available_bytes;
use crate::weights::Weights;
use qudi_core::Size;
use qudi_core::restorer::{Acquisition, Restorer};
use qudi_core::sensor::Sensor;
use qudi_model::checkpoint::{Description, ModelKind};
use qudi_model::restorer::{Model, QudiRestorer, SampleOptions};

/// How far outside the light it was trained for a network may be used: it has not seen such noise.
const TOLERATED: f64 = 10.0;

/// The restorer, and how it makes frames: by regression or diffusion, and on which device.
pub(crate) fn restorer(
    options: &NetworkOptions,
    acquisition: &Acquisition,
    size: Size,
) -> Result<(Box<dyn Restorer>, String)> {
    let device = device::open(&options.device)?;
    options.check_steps()?;
    let (network, description) = options.weights.load(&device.device)?;
    check(&description, acquisition)?;
    if matches!(device.name.as_str(), "cpu" | "ndarray") {
        check_memory(&description, options.tile, size, available_bytes())?;
    }
    let model = Model {
        network,
        config: description.network,
        kind: description.kind.unwrap_or(ModelKind::Diffusion),
        window: description.window,
    };
    let restorer = QudiRestorer::new(model, sample_options(options)?, &device.device)?;
    let way = options.mode()?;
    Ok((Box::new(restorer), format!(" ({way}) on {}", device.name)))
}

pub(crate) fn sample_options(options: &NetworkOptions) -> Result<SampleOptions> {
    Ok(SampleOptions {
        steps: options.steps()?,
        spacing: options.spacing,
        sampler: options.sampler,
        samples: options.samples,
        tile: options.tile,
    })
}

/// Refuses tiles that memory cannot hold, before the system ends the program for it.
fn check_memory(
    description: &Description,
    tile: usize,
    size: Size,
    available: Option<u64>,
) -> Result<()> {
    let network = &description.network;
    let needed = |tile: usize| {
        let side = |length: usize| length.min(tile);
        let size = Size { height: side(size.height), width: side(size.width) };
        network.memory(size, description.window)
    };
    let Some(available) = available.filter(|&available| needed(tile) > available) else {
        return Ok(());
    };
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    let what = format!(
        "tiles of {tile} pixels take about {:.1} GiB, {:.1} GiB are free",
        gib(needed(tile)),
        gib(available)
    );
    let smallest = 4 * network.multiple();
    let fitting = (smallest..tile).rev().find(|&tile| tile % 32 == 0 && needed(tile) <= available);
    let help = match fitting {
        Some(fitting) => format!("--tile {fitting} fits"),
        None => "free some memory, or use smaller weights".to_owned(),
    };
    Err(CliError::new(what, "--tile", help))
}

/// What went wrong on a device, with a way out; `problem` are its own words.
pub(crate) fn device_failed(problem: &str, options: &NetworkOptions) -> CliError {
    let half = options.tile / 2 / 32 * 32;
    let help = if half >= 64 {
        format!(
            "--tile {half} needs a quarter of the memory; `qudi selftest` checks the device; or --device cpu"
        )
    } else {
        "check the device with `qudi selftest`, or use --device cpu".to_owned()
    };
    CliError::new(format!("the device failed: {problem}"), &options.device, help)
}

/// Whether a sensor counts like one that the weights were trained for: the same response, and full scales
/// within a factor of four.
fn is_like(sensor: &Sensor, trained: &str) -> bool {
    // Sums of binary frames are listed as `name x frames`.
    let (name, frames) = trained.split_once(" x ").unwrap_or((trained, ""));
    let Ok(mut known) = Sensor::load(name) else { return true };
    if let Ok(frames) = frames.parse() {
        known.frames_summed = frames;
    }
    let ratio = f64::from(sensor.max_count()) / f64::from(known.max_count());
    known.response == sensor.response && (0.25..=4.0).contains(&ratio)
}

/// Whether the weights that come along were trained for such a capture.
pub(crate) fn built_in_knows(acquisition: &Acquisition) -> Result<bool> {
    Ok(check(&Weights::BuiltIn.describe()?, acquisition).is_ok())
}

/// Refuses a capture far outside what the weights were trained for.
fn check(description: &Description, acquisition: &Acquisition) -> Result<()> {
    let [least, most] = description.ppp;
    if acquisition.ppp < least / TOLERATED || acquisition.ppp > most * TOLERATED {
        return Err(CliError::new(
            format!(
                "{:.4} photons per pixel and frame; outside the training range {least} to {most}",
                acquisition.ppp
            ),
            "--weights",
            "sum frames (--sum N) or average fewer, give --ppp if it was estimated wrongly, or train for this light",
        ));
    }
    let sensor = &acquisition.sensor;
    if !description.sensors.iter().any(|trained| is_like(sensor, trained)) {
        let response = format!("{:?}", sensor.response).to_lowercase();
        return Err(CliError::new(
            format!(
                "sensor {} is {response} and counts up to {}; the weights were trained for {}",
                sensor.name,
                sensor.max_count(),
                description.sensors.join(", ")
            ),
            "--weights",
            "sum binary frames to the depth that the weights know (--sum N), or train for this sensor",
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use qudi_model::config::NetworkConfig;

    fn description(sensors: &[&str]) -> Description {
        Description {
            program: String::new(),
            preset: None,
            network: NetworkConfig::preset("small").unwrap_or_else(|e| panic!("{e}")),
            window: 11,
            sensors: sensors.iter().map(|&name| name.to_owned()).collect(),
            ppp: [1.0, 30.0],
            data: Vec::new(),
            steps: 0,
            commit: None,
            licence: String::new(),
            default_steps: None,
            kind: None,
        }
    }

    #[test]
    fn tiles_that_do_not_fit_name_one_that_does() {
        let about = description(&["qudi-paper"]);
        let size = Size { height: 2000, width: 3000 };
        let check = |tile, available| check_memory(&about, tile, size, Some(available));
        assert!(check(512, 4 << 30).is_ok());
        assert!(check_memory(&about, 4096, size, None).is_ok());
        let Err(CliError::Error { what, help: Some(help), .. }) = check(1024, 1 << 30) else {
            panic!("a tile of 1024 in 1 GiB");
        };
        assert!(what.contains("1.0 GiB are free"), "{what}");
        let fitting = help.split_whitespace().nth(1).and_then(|tile| tile.parse().ok());
        let fitting: usize = fitting.unwrap_or_else(|| panic!("{help}"));
        assert!((192..512).contains(&fitting) && check(fitting, 1 << 30).is_ok(), "{help}");
        assert!(check(fitting + 32, 1 << 30).is_err());
        // The whole frame is smaller than the tile.
        let small = Size { height: 128, width: 128 };
        assert!(check_memory(&about, 1024, small, Some(1 << 30)).is_ok());
    }

    #[test]
    fn sensors_are_like_those_of_their_kind() {
        let load = |name: &str| Sensor::load(name).unwrap_or_else(|e| panic!("{e}"));
        let mut binary = load("swissspad2");
        assert!(is_like(&load("qudi-paper"), "qudi-paper"));
        assert!(!is_like(&binary, "qudi-paper"));
        assert!(is_like(&binary, "swissspad2"));
        assert!(!is_like(&binary, "swissspad2 x 7"));
        binary.frames_summed = 7;
        assert!(is_like(&binary, "spad512s x 15"));
        assert!(is_like(&binary, "a sensor of the user's own"));
    }
}
