//! What can go wrong in this crate.

use qudi_sim::SimError;
use std::path::PathBuf;

/// Result with the crate's error.
pub type Result<T> = std::result::Result<T, ModelError>;

/// An error: what, where; [`ModelError::help`] says what to do.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// No preset of that name.
    #[error("there is no preset `{0}`")]
    Preset(String),

    /// A size of the network.
    #[error("network.{key} {problem}")]
    Config {
        /// The key.
        key: String,
        /// What is wrong with it.
        problem: String,
    },

    /// A weight file that cannot be used.
    #[error("{}: {problem}", path.display())]
    Weights {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        help: String,
    },

    /// The burst is none that the network can take.
    #[error("{problem}")]
    Burst {
        /// What is wrong.
        problem: String,
        /// What to do.
        help: String,
    },

    /// The device failed.
    #[error("{device}: {problem}")]
    Device {
        /// The device.
        device: String,
        /// What it said.
        problem: String,
        /// What to do.
        help: String,
    },

    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },

    /// From the simulator.
    #[error(transparent)]
    Sim(#[from] SimError),
}

impl ModelError {
    /// What to do about it.
    pub fn help(&self) -> Option<String> {
        match self {
            Self::Preset(_) => {
                let names: Vec<_> = crate::config::PRESETS.iter().map(|preset| preset.0).collect();
                Some(format!("there are {}", names.join(", ")))
            }
            Self::Weights { help, .. } | Self::Burst { help, .. } | Self::Device { help, .. } => {
                Some(help.clone())
            }
            Self::Sim(error) => error.help(),
            Self::Config { .. } | Self::Io { .. } => None,
        }
    }
}
