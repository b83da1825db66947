//! The keys of `[simulate]`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Input, light and scene of a simulation.
#[derive(Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Simulate {
    /// Sensor preset, or path of a sensor file.
    sensor: String,
    /// Photons per pixel and output frame, in the sense of `ppp_def`.
    ppp: f64,
    /// What `ppp` counts: `incident` photons, `detected` electrons (dark ones included), or `dn`, the mean
    /// output value.
    ppp_def: String,
    /// Image value that receives `ppp` photons; the mean of the clip if unset.
    exposure: Option<f64>,
    /// Seed of photons and noise; drawn and printed if unset.
    seed: Option<u64>,
    /// What file values mean: `as-is`, or `srgb` to decode them to linear light.
    transfer: String,
    /// File value of white in `.npy` inputs; full scale of the type if unset.
    white: Option<f64>,
    /// Output frames at most; all, or 11 of a synthetic scene, if unset.
    frames: Option<u64>,
    /// Input frames or renderings that one output frame integrates.
    instants: usize,
    /// Times that each frame of a recorded clip comes in a row, as cameras faster than the video see it.
    frames_per_image: usize,
    /// Motion of a still, as in `pan:2,0.5+rotate:0.3+zoom:1.01+layers:3` (pixels, degrees and magnification
    /// per frame; number of cut-outs).
    motion: Option<String>,
    /// Frame size of synthetic scenes, `HxW` (height first).
    size: Option<String>,
    /// Fastest motion of procedural scenes, in pixels per frame.
    speed: f64,
    /// Seed of the layout of synthetic scenes.
    scene_seed: u64,
}

impl Default for Simulate {
    fn default() -> Self {
        Self {
            sensor: "qudi-paper".to_owned(),
            ppp: 3.25,
            ppp_def: "incident".to_owned(),
            exposure: None,
            seed: None,
            transfer: "as-is".to_owned(),
            white: None,
            frames: None,
            instants: 1,
            frames_per_image: 1,
            motion: None,
            size: None,
            speed: 2.0,
            scene_seed: 1,
        }
    }
}
