//! The command line: options of every command, and groups of options that several commands share.

#[cfg(test)]
mod documented;
pub(crate) mod given;
mod methods;
mod network;
pub(crate) mod number;
pub(crate) mod reading;
mod shard;
mod sum;
pub(crate) mod tiff_samples;

pub(crate) use methods::methods;
pub(crate) use network::{Network, Steps};
pub(crate) use reading::Reading;
pub(crate) use shard::Shard;
pub(crate) use sum::Sum;

use crate::commands::bench::args::Bench;
use crate::commands::calibrate::args::Calibrate;
use crate::commands::completions::args::{Completions, Man};
use crate::commands::config::args::Config;
use crate::commands::convert::args::Convert;
use crate::commands::demo::args::Demo;
use crate::commands::eval::args::Eval;
use crate::commands::info::args::Info;
use crate::commands::light::args::Light;
use crate::commands::look::args::Look;
use crate::commands::publish::args::Publish;
use crate::commands::restore::args::Restore;
use crate::commands::selftest::args::Selftest;
use crate::commands::simulate::args::Simulate;
use crate::commands::train::args::Train;
use crate::commands::view::args::View;
use crate::version;
use clap::{Args as ClapArgs, Parser, Subcommand, ValueEnum, ValueHint};
use qudi_core::atomic_file::Overwrite;
use std::path::PathBuf;

const EXIT_CODES: &str = "Exit codes:
  0    success
  1    it worked, but a bar that was set has been missed
  2    error: usage, configuration, input, output
  130  interrupted

Settings come from built-in defaults, then --config FILE, then QUDI_* variables, then --set
KEY=VALUE, then flags; the later one wins. `qudi config show` tells which one did. Unknown keys are
errors. A file and the environment may hold keys of other commands; --set may not.";

/// Simulate, restore and measure video from single-photon cameras.
///
/// Not related to the laboratory-control suite Qudi (Ulm-IQO/qudi).
#[derive(Debug, Parser)]
#[command(name = "qudi", version, long_version = version::long(), propagate_version = true, after_help = EXIT_CODES)]
pub(crate) struct Args {
    #[command(flatten)]
    pub(crate) global: Global,
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// Options of every command.
#[derive(Clone, Debug, ClapArgs)]
#[command(next_help_heading = "Global options")]
pub(crate) struct Global {
    /// Settings file (TOML); see `qudi config docs`
    #[arg(short, long, global = true, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) config: Option<PathBuf>,
    /// Set one key, as in --set sensor.read_noise=0.5
    #[arg(long, global = true, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// Threads to use [default: all cores]
    #[arg(short = 'j', long, global = true, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=number::MAX_THREADS))]
    pub(crate) threads: Option<usize>,
    /// Print one JSON document instead of text
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// Print errors only
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
    /// Say more; twice for details
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub(crate) verbose: u8,
    /// Colours in messages
    #[arg(long, global = true, value_name = "WHEN", default_value = "auto")]
    pub(crate) color: Color,
    /// Overwrite existing outputs
    #[arg(short, long, global = true)]
    pub(crate) force: bool,
}

impl Global {
    /// Returns what is done with existing outputs.
    pub(crate) fn overwrite(&self) -> Overwrite {
        if self.force { Overwrite::Yes } else { Overwrite::No }
    }
}

/// When to colour messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Color {
    /// On a terminal, unless `NO_COLOR` is set
    Auto,
    /// Always
    Always,
    /// Never
    Never,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    Simulate(Box<Simulate>),
    Restore(Box<Restore>),
    Train(Box<Train>),
    Publish(Publish),
    Eval(Box<Eval>),
    Bench(Box<Bench>),
    Selftest(Selftest),
    Convert(Box<Convert>),
    Calibrate(Box<Calibrate>),
    Demo(Demo),
    Light(Light),
    Info(Box<Info>),
    Look(Box<Look>),
    View(Box<View>),
    Config(Config),
    Completions(Completions),
    Man(Man),
}

impl Command {
    /// Returns the name on the command line.
    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::Simulate(_) => "simulate",
            Self::Restore(_) => "restore",
            Self::Train(_) => "train",
            Self::Publish(_) => "publish",
            Self::Eval(_) => "eval",
            Self::Bench(bench) if bench.train.is_some() => "bench --train",
            Self::Bench(_) => "bench",
            Self::Selftest(_) => "selftest",
            Self::Convert(_) => "convert",
            Self::Calibrate(_) => "calibrate",
            Self::Demo(_) => "demo",
            Self::Light(_) => "light",
            Self::Info(_) => "info",
            Self::Look(_) => "look",
            Self::View(_) => "view",
            Self::Config(_) => "config",
            Self::Completions(_) => "completions",
            Self::Man(_) => "man",
        }
    }
}
