//! Every settings key, its default and its meaning. `qudi config docs` prints this table.

/// One settings key.
#[derive(Debug)]
pub(crate) struct Key {
    /// Dotted name.
    pub(crate) name: &'static str,
    /// TOML text of the default; empty for none.
    pub(crate) default: &'static str,
    /// Meaning and unit.
    pub(crate) doc: &'static str,
}

const fn key(name: &'static str, default: &'static str, doc: &'static str) -> Key {
    Key { name, default, doc }
}

/// All keys. Those of `[sensor]` override the chosen sensor's own values.
pub(crate) const KEYS: &[Key] = &[
    key("simulate.sensor", "\"qudi-paper\"", "sensor preset, or path of a sensor file"),
    key("simulate.ppp", "3.25", "photons per pixel and output frame, in the sense of `ppp_def`"),
    key(
        "simulate.ppp_def",
        "\"incident\"",
        "what `ppp` counts: `incident` photons, `detected` electrons (dark ones included), or `dn`, the mean output value",
    ),
    key(
        "simulate.exposure",
        "",
        "image value that receives `ppp` photons; the mean of the clip if unset",
    ),
    key("simulate.seed", "", "seed of photons and noise; drawn and printed if unset"),
    key(
        "simulate.transfer",
        "\"as-is\"",
        "what file values mean: `as-is`, or `srgb` to decode them to linear light",
    ),
    key(
        "simulate.white",
        "",
        "file value of white in `.npy` inputs; full scale of the type if unset",
    ),
    key("simulate.frames", "", "output frames at most; all, or 11 of a synthetic scene, if unset"),
    key("simulate.instants", "1", "input frames or renderings that one output frame integrates"),
    key(
        "simulate.motion",
        "",
        "motion of a still, as in `pan:2,0.5+rotate:0.3+zoom:1.01+layers:3` (pixels, degrees and magnification per frame; number of cut-outs)",
    ),
    key("simulate.size", "", "frame size of synthetic scenes, `HxW` (height first)"),
    key("simulate.speed", "2.0", "fastest motion of procedural scenes, in pixels per frame"),
    key("simulate.scene_seed", "1", "seed of the layout of synthetic scenes"),
    key(
        "sensor.response",
        "",
        "`linear` (counts electrons) or `binary` (at least one detection, or none)",
    ),
    key("sensor.bits", "", "bits per sample of a native frame; 1 for binary sensors"),
    key(
        "sensor.quantum_efficiency",
        "",
        "detections per photon on the pixel's pitch: PDE with fill factor",
    ),
    key(
        "sensor.dark",
        "",
        "dark electrons per pixel: a number is per native frame, `\"7.5/s\"` per second",
    ),
    key("sensor.read_noise", "", "read noise, e- rms"),
    key("sensor.full_well", "", "full-well capacity, e-; `\"unlimited\"` for none"),
    key(
        "sensor.gain",
        "",
        "DN per e-, or `quiver` (0.5 (2^bits - 1) / PPP), `unit` (1), `fwc` (full scale at full well), `auto` (half scale at the mean)",
    ),
    key("sensor.fps", "", "native frames per second"),
    key("sensor.pitch_um", "", "pixel pitch, micrometres"),
    key("sensor.frames_summed", "", "binary frames summed into one output frame"),
    key("sensor.defects.seed", "", "seed of the camera's pixel pattern"),
    key(
        "sensor.defects.dark_spread",
        "",
        "standard deviation of ln(dark rate) over the good pixels",
    ),
    key(
        "sensor.defects.dark_map",
        "",
        "`.npy` of [height][width] dark rates in e- per pixel and native frame",
    ),
    key(
        "sensor.defects.bad_pixels",
        "",
        "`.npy` of [height][width], nonzero where captures are repaired",
    ),
    key("sensor.defects.hot_fraction", "", "fraction of hot pixels"),
    key("sensor.defects.hot_dark", "", "dark rate of a hot pixel, as `dark`"),
    key("sensor.defects.dead_fraction", "", "fraction of dead pixels, which read 0"),
    key(
        "sensor.defects.crosstalk",
        "",
        "probability that a detection also fires a given one of the 4 neighbours",
    ),
    key(
        "sensor.defects.afterpulse",
        "",
        "probability that a detection fires the pixel again in the next binary frame",
    ),
    key("sensor.defects.dead_time_ns", "", "non-paralysable dead time of a photon counter, ns"),
];
