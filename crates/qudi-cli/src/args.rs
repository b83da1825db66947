//! The command line: every sentence of `--help` is here.

mod convert;
mod eval;
mod network;
mod number;
mod reading;
mod restore;
mod simulate;
mod train;

pub(crate) use convert::{Calibrate, Convert};
pub(crate) use eval::{Bench, Eval, External, Protocol};
pub(crate) use network::{Network, SamplerName, SpacingName};
pub(crate) use reading::Reading;
pub(crate) use restore::{Restore, Shard};
pub(crate) use simulate::Simulate;
pub(crate) use train::Train;

use clap::{ArgGroup, Args as ClapArgs, Parser, Subcommand, ValueEnum, ValueHint};
use clap_complete::Shell;
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
#[command(name = "qudi", version, propagate_version = true, after_help = EXIT_CODES)]
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
    #[arg(short = 'j', long, global = true, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=number::MOST_THREADS))]
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
    #[cfg(feature = "remote")]
    Serve(Serve),
    Convert(Box<Convert>),
    Calibrate(Box<Calibrate>),
    Demo(Demo),
    Light(Light),
    Info(Box<Info>),
    Config(Config),
    Completions(Completions),
    #[command(hide = true)]
    Man(Man),
}

impl Command {
    /// The name on the command line.
    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::Simulate(_) => "simulate",
            Self::Restore(_) => "restore",
            Self::Train(_) => "train",
            Self::Publish(_) => "publish",
            Self::Eval(_) => "eval",
            Self::Bench(_) => "bench",
            Self::Selftest(_) => "selftest",
            #[cfg(feature = "remote")]
            Self::Serve(_) => "serve",
            Self::Convert(_) => "convert",
            Self::Calibrate(_) => "calibrate",
            Self::Demo(_) => "demo",
            Self::Light(_) => "light",
            Self::Info(_) => "info",
            Self::Config(_) => "config",
            Self::Completions(_) => "completions",
            Self::Man(_) => "man",
        }
    }
}

/// Check that a device computes what Burn's stock operations do on the processor: every operation of the network, and a
/// small network whole
///
/// Exits with 1 if a result is off. GPU drivers and backends have had wrong kernels; run this once on yours.
#[derive(Debug, ClapArgs)]
pub(crate) struct Selftest {
    /// The device: auto, cpu, ndarray, wgpu, vulkan, cuda, metal, or one of several, as wgpu:1
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub(crate) device: String,
    /// Checks whose names contain one of these
    #[arg(long, value_name = "A,B,...", value_delimiter = ',')]
    pub(crate) only: Vec<String>,
}

/// Let other machines compute on this one's devices, with --device ws://HOST:PORT there, until Ctrl-C
///
/// Operations and tensors cross the network unencrypted, so serve within a network that you trust. Where others can reach it, server
/// and clients need the same word in QUDI_TOKEN. Both must be of the same version.
#[cfg(feature = "remote")]
#[derive(Debug, ClapArgs)]
pub(crate) struct Serve {
    /// Devices to serve, as for train
    #[arg(long, value_name = "NAME,...", value_delimiter = ',', default_value = "auto")]
    pub(crate) device: Vec<String>,
    /// Where to listen; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:4001")]
    pub(crate) listen: std::net::SocketAddr,
}

/// See what the camera sees, and what every method makes of it: a built-in scene in one picture and one page
#[derive(Debug, ClapArgs)]
pub(crate) struct Demo {
    /// Picture to write [default: qudi-demo.png, overwritten]
    #[arg(short, long, value_name = "PNG", value_hint = ValueHint::FilePath)]
    pub(crate) output: Option<PathBuf>,
    /// Sensor: a name or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = "qudi-paper")]
    pub(crate) sensor: String,
    /// Photons per pixel and frame
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, default_value_t = 3.25, value_parser = number::real(number::PPP))]
    pub(crate) ppp: f64,
    /// Seed of photons and noise
    #[arg(long, value_name = "N", default_value_t = 1, allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=u64::MAX))]
    pub(crate) seed: u64,
    #[command(flatten)]
    pub(crate) network: Network,
}

/// Convert between lux and photons per pixel for a sensor
#[derive(Debug, ClapArgs)]
pub(crate) struct Light {
    /// Illuminance on the sensor plane in lux
    #[arg(long, value_name = "LX", allow_negative_numbers = true, required_unless_present_any = ["ppp", "scene_lux"], conflicts_with_all = ["ppp", "scene_lux"], value_parser = number::real(0.0..=1e9))]
    pub(crate) lux: Option<f64>,
    /// Incident photons per pixel and frame
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, conflicts_with = "scene_lux", value_parser = number::real(0.0..=1e9))]
    pub(crate) ppp: Option<f64>,
    /// Illuminance on a diffuse scene in lux, seen through a lens
    #[arg(long, value_name = "LX", allow_negative_numbers = true, value_parser = number::real(0.0..=1e9))]
    pub(crate) scene_lux: Option<f64>,
    /// Sensor: a name or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = "qudi-paper")]
    pub(crate) sensor: String,
    /// Exposure time in seconds [default: one frame of the sensor]
    #[arg(long, value_name = "S", allow_negative_numbers = true, value_parser = number::real(1e-12..=1e6))]
    pub(crate) exposure_time: Option<f64>,
    /// Pixel pitch in micrometres [default: the sensor's]
    #[arg(long, value_name = "UM", allow_negative_numbers = true, value_parser = number::real(1e-3..=1e6))]
    pub(crate) pitch: Option<f64>,
    /// Light of one wavelength in nanometres
    #[arg(long, value_name = "NM", default_value_t = 555.0, conflicts_with = "daylight", allow_negative_numbers = true, value_parser = number::real(380.0..=780.0))]
    pub(crate) wavelength: f64,
    /// Daylight, 395 to 718 nm
    #[arg(long)]
    pub(crate) daylight: bool,
    /// Reflectance of the scene, for --scene-lux
    #[arg(long, value_name = "0..1", allow_negative_numbers = true, default_value_t = 0.18, value_parser = number::real(0.0..=1.0))]
    pub(crate) reflectance: f64,
    /// Transmission of the lens, for --scene-lux
    #[arg(long, value_name = "0..1", allow_negative_numbers = true, default_value_t = 0.9, value_parser = number::real(0.0..=1.0))]
    pub(crate) transmission: f64,
    /// f-number of the lens, for --scene-lux
    #[arg(long, value_name = "N", default_value_t = 2.8, allow_negative_numbers = true, value_parser = number::real(0.1..=1000.0))]
    pub(crate) f_number: f64,
    /// Magnification of the lens, for --scene-lux
    #[arg(long, value_name = "M", default_value_t = 0.0, allow_negative_numbers = true, value_parser = number::real(0.0..=1000.0))]
    pub(crate) magnification: f64,
}

/// Describe anything: captures in any format, bursts, weights, sensors, devices
#[derive(Debug, ClapArgs)]
#[group(skip)]
#[command(group(ArgGroup::new("what").required(true)))]
pub(crate) struct Info {
    /// A capture (file or folder), a burst or its record, weights (.safetensors, or `weights` for those that come along), a
    /// sensor's name or .toml file
    #[arg(group = "what", value_hint = ValueHint::AnyPath)]
    pub(crate) subject: Option<String>,
    /// List the built-in sensors
    #[arg(long, group = "what")]
    pub(crate) sensors: bool,
    /// List the formats that captures are read from
    #[arg(long, group = "what")]
    pub(crate) formats: bool,
    /// List the compute devices of this machine
    #[arg(long, group = "what")]
    pub(crate) devices: bool,
    #[command(flatten)]
    pub(crate) look: Look,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// How a capture is looked at.
#[derive(Debug, ClapArgs)]
#[group(skip)]
#[command(next_help_heading = "Captures")]
pub(crate) struct Look {
    /// Sensor that took it: a name or a .toml file [default: known from record or format]
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) sensor: Option<String>,
    /// Write the mean picture as PNG: response inverted, bad pixels repaired
    #[arg(long, value_name = "PNG", value_hint = ValueHint::FilePath)]
    pub(crate) preview: Option<PathBuf>,
}

/// Write weights in half precision, half the size, with their SHA-256 beside them
#[derive(Debug, ClapArgs)]
pub(crate) struct Publish {
    /// Weights that `qudi train` wrote
    #[arg(value_hint = ValueHint::FilePath)]
    pub(crate) weights: PathBuf,
    /// Where they go: .safetensors
    #[arg(short, long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) output: PathBuf,
}

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

/// Print a completion script for a shell
#[derive(Debug, ClapArgs)]
pub(crate) struct Completions {
    /// Which shell
    pub(crate) shell: Shell,
}

/// Write the manual pages
#[derive(Debug, ClapArgs)]
pub(crate) struct Man {
    /// Folder for the pages [default: the main page on standard output]
    pub(crate) folder: Option<PathBuf>,
}
