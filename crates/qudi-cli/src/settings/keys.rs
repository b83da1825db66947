//! Every settings key: its name, default, meaning, and the flag of `qudi simulate` that sets it.
//!
//! All else derives from this table: `qudi config docs`, the names of environment variables, the flags with
//! their help, and the check that every command applies a key or refuses it.

/// One settings key.
#[derive(Debug)]
pub(crate) struct Key {
    /// Dotted name.
    pub(crate) name: &'static str,
    /// TOML text of the default; empty for none.
    pub(crate) default: &'static str,
    /// Meaning and unit.
    pub(crate) doc: &'static str,
    /// Meaning of text without quotes.
    pub(crate) kind: Kind,
    /// The flag of `qudi simulate` that sets it.
    pub(crate) flag: Option<KeyFlag>,
}

/// Meaning of text without quotes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// As it stands.
    Text,
    /// As TOML if it is TOML, else as it stands.
    Value,
}

/// A flag that sets a key.
#[derive(Clone, Copy, Debug)]
pub(crate) struct KeyFlag {
    /// Name without dashes.
    pub(crate) long: &'static str,
    /// Placeholder of the value in `--help`.
    pub(crate) value: &'static str,
    /// Heading in `--help`.
    pub(crate) heading: &'static str,
}

impl Key {
    const fn new(name: &'static str, default: &'static str, doc: &'static str, kind: Kind) -> Self {
        Self { name, default, doc, kind, flag: None }
    }

    const fn flag(
        mut self,
        long: &'static str,
        value: &'static str,
        heading: &'static str,
    ) -> Self {
        self.flag = Some(KeyFlag { long, value, heading });
        self
    }
}

const fn value(name: &'static str, default: &'static str, doc: &'static str) -> Key {
    Key::new(name, default, doc, Kind::Value)
}

const fn text(name: &'static str, default: &'static str, doc: &'static str) -> Key {
    Key::new(name, default, doc, Kind::Text)
}

/// All keys. The part `[sensor]` overrides the values of the chosen sensor.
pub(crate) const KEYS: &[Key] = &[
    text("simulate.sensor", "\"qudi-paper\"", "sensor preset, or path of a sensor file").flag("sensor", "NAME|FILE", "Sensor"),
    value("simulate.ppp", "3.25", "photons per pixel and output frame, in the sense of `ppp_def`").flag("ppp", "PPP", "Light"),
    text("simulate.ppp_def", "\"incident\"", "what `ppp` counts: `incident` photons, `detected` electrons (dark ones included), or `dn`, the mean output value").flag("ppp-def", "MEANING", "Light"),
    value("simulate.exposure", "", "image value that receives `ppp` photons; the mean of the clip if unset").flag("exposure", "VALUE", "Light"),
    value("simulate.seed", "", "seed of photons and noise; drawn and printed if unset").flag("seed", "N", "Options"),
    text("simulate.transfer", "\"as-is\"", "what file values mean: `as-is`, or `srgb` to decode them to linear light").flag("transfer", "CURVE", "Light"),
    value("simulate.white", "", "file value of white in `.npy` inputs; full scale of the type if unset").flag("white", "VALUE", "Light"),
    value("simulate.frames", "", "output frames at most; all, or 11 of a synthetic scene, if unset").flag("frames", "N", "Scene"),
    value("simulate.instants", "1", "input frames or renderings that one output frame integrates").flag("instants", "N", "Scene"),
    value("simulate.frames_per_image", "1", "times that each frame of a recorded clip comes in a row, as cameras faster than the video see it").flag("frames-per-image", "N", "Scene"),
    text("simulate.motion", "", "motion of a still, as in `pan:2,0.5+rotate:0.3+zoom:1.01+layers:3` (pixels, degrees and magnification per frame; number of cut-outs)").flag("motion", "MOTION", "Scene"),
    text("simulate.size", "", "frame size of synthetic scenes, `HxW` (height first)").flag("size", "HxW", "Scene"),
    value("simulate.speed", "2.0", "fastest motion of procedural scenes, in pixels per frame").flag("speed", "PX", "Scene"),
    value("simulate.scene_seed", "1", "seed of the layout of synthetic scenes").flag("scene-seed", "N", "Scene"),
    text("sensor.response", "", "`linear` (counts electrons) or `binary` (at least one detection, or none)"),
    value("sensor.bits", "", "bits per sample of a native frame; 1 for binary sensors").flag("bits", "N", "Sensor"),
    value("sensor.quantum_efficiency", "", "detections per photon on the pixel's pitch: PDE with fill factor").flag("qe", "0..1", "Sensor"),
    value("sensor.dark", "", "dark electrons per pixel: a number is per native frame, `\"7.5/s\"` per second").flag("dark", "RATE", "Sensor"),
    value("sensor.read_noise", "", "read noise, e- rms").flag("read-noise", "E-", "Sensor"),
    value("sensor.offset", "", "pedestal of a linear sensor in DN: added by `simulate`, subtracted when captures are read").flag("offset", "DN", "Sensor"),
    value("sensor.threshold", "", "photon counting: DN above the pedestal beyond which a sample is one detection (binary sensors)"),
    value("sensor.full_well", "", "full-well capacity, e-; `\"unlimited\"` for none").flag("full-well", "E-", "Sensor"),
    value("sensor.gain", "", "DN per e-, or `quiver` (0.5 (2^bits - 1) / PPP), `unit` (1), `fwc` (full scale at full well), `auto` (half scale at the mean)").flag("gain", "GAIN", "Sensor"),
    value("sensor.fps", "", "native frames per second"),
    value("sensor.pitch_um", "", "pixel pitch, micrometres"),
    value("sensor.frames_summed", "", "binary frames summed into one output frame").flag("sum", "N", "Sensor"),
    value("sensor.rolling_shutter", "", "time from the first row to the last as a share of a native frame, 0 to 1: `simulate` shows each row the scene of its own time, rounded to `instants`").flag("rolling-shutter", "0..1", "Sensor"),
    value("sensor.defects.seed", "", "seed of the camera's pixel pattern"),
    value("sensor.defects.dark_spread", "", "standard deviation of ln(dark rate) over the good pixels"),
    text("sensor.defects.dark_map", "", "`.npy` of [height][width] dark rates in e- per pixel and native frame"),
    text("sensor.defects.bad_pixels", "", "`.npy` of [height][width], nonzero where captures are repaired"),
    value("sensor.defects.hot_fraction", "", "fraction of hot pixels"),
    value("sensor.defects.hot_dark", "", "dark rate of a hot pixel, as `dark`"),
    value("sensor.defects.dead_fraction", "", "fraction of dead pixels, which read 0"),
    value("sensor.defects.crosstalk", "", "probability that a detection also fires a given one of the 4 neighbours"),
    value("sensor.defects.afterpulse", "", "probability that a detection fires the pixel again in the next binary frame"),
    value("sensor.defects.dead_time_ns", "", "non-paralysable dead time of a photon counter, ns"),
];
