//! The built-in sensors: `sensors/*.toml` of this crate.

/// A built-in sensor.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    /// Its name on the command line.
    pub name: &'static str,
    /// Its document, with sources.
    pub toml: &'static str,
}

macro_rules! presets {
    ($($name:literal),* $(,)?) => {
        /// All built-in sensors, the default first.
        pub const PRESETS: &[Preset] = &[$(Preset {
            name: $name,
            toml: include_str!(concat!("../../sensors/", $name, ".toml")),
        }),*];
    };
}

presets!(
    "qudi-paper",
    "ideal",
    "ideal-binary",
    "swissspad2",
    "swissspad3",
    "spad512s",
    "spad-qvga",
    "colorspad-ss2",
    "qis-ma2017",
    "qis16-gj",
    "qis4-gj",
    "qis163-gj",
    "cis-phone",
);

/// Returns the preset of this name.
pub fn preset(name: &str) -> Option<&'static Preset> {
    PRESETS.iter().find(|p| p.name == name)
}
