//! The keys that each command takes; it refuses all others by name.

/// The parts of a recipe, the keys of `qudi train`.
pub(super) const RECIPE: &[&str] = &["network", "data", "train", "validation"];

/// The parts of settings that do not belong to recipes.
pub(super) const SETTINGS: &[&str] = &["simulate", "sensor"];

/// Commands with the parts of the settings that they take. Commands that are not listed take none.
const COMMANDS: &[(&str, &[&[&str]])] = &[
    ("simulate", &[SETTINGS]),
    ("eval", &[SETTINGS]),
    ("restore", &[&["sensor"]]),
    ("info", &[&["sensor"]]),
    ("look", &[&["sensor"]]),
    ("view", &[&["sensor"]]),
    ("calibrate", &[&["sensor"]]),
    ("light", &[&["sensor"]]),
    ("demo", &[&["sensor"]]),
    ("train", &[RECIPE]),
    ("bench --train", &[RECIPE]),
    ("config", &[SETTINGS, RECIPE]),
];

/// Returns true if a command takes a key.
pub(super) fn takes(command: &str, key: &str) -> bool {
    let part = key.split('.').next().unwrap_or_default();
    parts(command).any(|taken| taken == part)
}

/// Returns the parts that a command takes, as in `sensor.*`; empty if there are none.
pub(super) fn taken(command: &str) -> String {
    parts(command).map(|part| format!("{part}.*")).collect::<Vec<_>>().join(", ")
}

/// Returns the commands that take a part of the settings.
pub(super) fn takers(part: &str) -> Vec<&'static str> {
    let all = COMMANDS.iter().map(|(command, _)| *command);
    all.filter(|command| parts(command).any(|taken| taken == part)).collect()
}

fn parts(command: &str) -> impl Iterator<Item = &'static str> {
    let found = COMMANDS.iter().find(|(name, _)| *name == command);
    found.into_iter().flat_map(|(_, lists)| lists.iter().copied().flatten().copied())
}
