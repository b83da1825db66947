//! The burst that benchmarks restore, and the median of their times.

use super::args::Bench;
use crate::error::Result;
use qudi_core::restorer::Acquisition;
use qudi_core::sensor::Sensor;
use qudi_core::{Camera, Light};
use qudi_sim::scene::{Procedural, ProceduralScene};

/// The clip's mean image value, close enough for a benchmark.
const EXPOSURE: f64 = 0.45;

/// Returns the median.
pub(super) fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// Simulates a burst to restore.
pub(super) fn burst(args: &Bench) -> Result<(Vec<Vec<u16>>, Acquisition)> {
    let sensor = Sensor::load("qudi-paper")?;
    let light = Light { ppp: 3.25, mean_level: EXPOSURE };
    let scene =
        Procedural { kind: ProceduralScene::DeadLeaves, size: args.size, seed: 1, speed: 2.0 };
    let scene = scene.scene();
    let mut camera = Camera::new(&sensor, args.size, light, 1)?;
    let mut counts = Vec::with_capacity(args.frames);
    for t in 0..args.frames {
        counts.push(camera.expose(t as u64, &[&scene.render(t as f64)])?);
    }
    let acquisition = Acquisition::new(sensor, light.ppp, light.mean_level)?.with_seed(1);
    Ok((counts, acquisition))
}
