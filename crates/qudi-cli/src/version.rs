//! The version of the program, its commit, its features, and the kernels that it uses on this machine.

use qudi_model::MatrixUnits;
use std::env::consts::{ARCH, OS};
use std::fmt::Write;
use std::sync::LazyLock;

/// Commit of the sources, where it was known when the program was built.
pub(crate) const COMMIT: Option<&str> = option_env!("QUDI_COMMIT");

/// Returns the lines of `qudi --version`; `-V` prints the first alone.
pub fn long() -> &'static str {
    static TEXT: LazyLock<String> = LazyLock::new(lines);
    &TEXT
}

fn lines() -> String {
    let mut text = env!("CARGO_PKG_VERSION").to_owned();
    let kernels = match MatrixUnits::chosen() {
        Ok(units) => units.to_string(),
        Err(error) => error.to_string(),
    };
    let features = env!("QUDI_FEATURES");
    let system = format!("{ARCH} {OS}");
    for (key, value) in [
        ("commit", COMMIT.unwrap_or("unknown")),
        ("features", if features.is_empty() { "none" } else { features }),
        ("kernels", &kernels),
        ("system", &system),
    ] {
        let _ = write!(text, "\n{key:<10}{value}");
    }
    text
}
