//! Options of `qudi config`.

use clap::{Args as ClapArgs, Subcommand};

/// Show settings and where they come from
#[derive(Debug, ClapArgs)]
pub(crate) struct Config {
    #[command(subcommand)]
    pub(crate) action: ConfigAction,
}

#[derive(Debug, Subcommand)]
pub(crate) enum ConfigAction {
    /// Every key with its value and origin
    Show,
    /// Every key with its meaning, as Markdown
    Docs,
}
