//! The command line: every sentence of `--help` is here.

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{ArgGroup, Args as ClapArgs, Parser, Subcommand, ValueEnum, ValueHint};
use clap_complete::Shell;
use qudi_sim::Size;
use qudi_sim::capture::{Axes, BitOrder, Crop, MaskChoice, Orientation, PackAxis, ReadOptions};
use serde::de::DeserializeOwned;
use std::num::NonZeroUsize;
use std::path::PathBuf;

const EXIT_CODES: &str = "Exit codes:
  0    success
  1    it worked, but a bar that was set has been missed
  2    error: usage, configuration, input, output
  130  interrupted

Settings come from built-in defaults, then --config FILE, then QUDI_* variables, then --set
KEY=VALUE, then flags; the later one wins. `qudi config show` tells which one did.";

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
    #[arg(short = 'j', long, global = true, value_name = "N")]
    pub(crate) threads: Option<NonZeroUsize>,
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
    Eval(Eval),
    Bench(Bench),
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

/// Turn video, images or synthetic scenes into photon counts
///
/// INPUT is a folder of PNG, JPEG or TIFF frames, a GIF, Y4M or .npy file, any video (decoded by
/// ffmpeg), one image to set in motion, a procedural scene (scene:dead-leaves, scene:text,
/// scene:gratings, scene:chart), or - for Y4M on standard input.
///
/// OUT is an .npy file (binary frames are packed, 8 pixels to the byte), a multi-page .tif, a
/// folder of PNG (no extension), or - for .npy on standard output. A record that makes the burst
/// again is written beside it: OUT.json, or burst.json in the folder.
#[derive(Debug, ClapArgs)]
pub(crate) struct Simulate {
    /// What to expose
    #[arg(required_unless_present = "from", conflicts_with = "from", value_hint = ValueHint::AnyPath)]
    pub(crate) input: Option<String>,
    /// Where the burst goes
    #[arg(short, long, value_name = "OUT", value_hint = ValueHint::AnyPath)]
    pub(crate) output: String,
    /// Make the burst of this record again; only outputs may be given beside it
    #[arg(long, value_name = "RECORD", value_hint = ValueHint::FilePath)]
    pub(crate) from: Option<PathBuf>,

    /// Sensor: a name (`qudi info --sensors`) or a .toml file [default: qudi-paper]
    #[arg(long, value_name = "NAME|FILE", help_heading = "Sensor")]
    pub(crate) sensor: Option<String>,
    /// Sum this many binary frames into one (7 for 3 bits)
    #[arg(long, value_name = "N", help_heading = "Sensor")]
    pub(crate) sum: Option<u32>,
    /// Bits per sample of a linear sensor
    #[arg(long, value_name = "N", help_heading = "Sensor")]
    pub(crate) bits: Option<u8>,
    /// Quantum efficiency, fill factor included
    #[arg(long, value_name = "0..1", allow_negative_numbers = true, help_heading = "Sensor")]
    pub(crate) qe: Option<f64>,
    /// Dark electrons per pixel and frame, or per second as in 7.5/s
    #[arg(long, value_name = "RATE", help_heading = "Sensor")]
    pub(crate) dark: Option<String>,
    /// Read noise in electrons rms
    #[arg(long, value_name = "E-", allow_negative_numbers = true, help_heading = "Sensor")]
    pub(crate) read_noise: Option<f64>,
    /// Full-well capacity in electrons, or `unlimited`
    #[arg(long, value_name = "E-", allow_negative_numbers = true, help_heading = "Sensor")]
    pub(crate) full_well: Option<String>,
    /// DN per electron, or a rule: quiver, unit, fwc, auto
    #[arg(long, value_name = "GAIN", help_heading = "Sensor")]
    pub(crate) gain: Option<String>,

    /// Photons per pixel and frame [default: 3.25]
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, help_heading = "Light")]
    pub(crate) ppp: Option<f64>,
    /// What PPP counts: incident photons, detected electrons, or dn (mean output value)
    #[arg(long, value_name = "MEANING", help_heading = "Light")]
    pub(crate) ppp_def: Option<String>,
    /// Image value that receives PPP photons [default: the clip's mean]
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true, help_heading = "Light")]
    pub(crate) exposure: Option<f64>,
    /// What file values mean: as-is, or srgb (decoded to linear light)
    #[arg(long, value_name = "CURVE", help_heading = "Light")]
    pub(crate) transfer: Option<String>,
    /// File value of white in .npy inputs [default: full scale of the type]
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true, help_heading = "Light")]
    pub(crate) white: Option<f64>,

    /// Output frames at most [default: all; 11 for synthetic scenes]
    #[arg(long, value_name = "N", help_heading = "Scene")]
    pub(crate) frames: Option<u64>,
    /// Instants per exposure: input frames (or renderings) that one output frame integrates
    #[arg(long, value_name = "N", help_heading = "Scene")]
    pub(crate) instants: Option<usize>,
    /// Motion of a still, as in pan:2,0.5+rotate:0.3+zoom:1.01+layers:3
    #[arg(long, value_name = "MOTION", allow_hyphen_values = true, help_heading = "Scene")]
    pub(crate) motion: Option<String>,
    /// Frame size of synthetic scenes [default: the image's; 256x256]
    #[arg(long, value_name = "HxW", help_heading = "Scene")]
    pub(crate) size: Option<Size>,
    /// Fastest motion of procedural scenes in pixels per frame [default: 2]
    #[arg(long, value_name = "PX", allow_negative_numbers = true, help_heading = "Scene")]
    pub(crate) speed: Option<f64>,
    /// Seed of the layout of synthetic scenes [default: 1]
    #[arg(long, value_name = "N", help_heading = "Scene")]
    pub(crate) scene_seed: Option<u64>,

    /// Seed of photons and noise [default: drawn and printed]
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u64>,
    /// Write binary .npy bursts with one byte per pixel
    #[arg(long, help_heading = "Outputs")]
    pub(crate) unpacked: bool,
    /// Write the true frames: .npy (float32) or a folder of 16-bit PNG
    #[arg(long, value_name = "PATH", help_heading = "Outputs", value_hint = ValueHint::AnyPath)]
    pub(crate) truth: Option<PathBuf>,
    /// Write the true flow of a synthetic scene: .npy (float32), frames-1 x (dx, dy, visible) x H x W
    #[arg(long, value_name = "FILE", help_heading = "Outputs", value_hint = ValueHint::FilePath)]
    pub(crate) flow: Option<PathBuf>,
    /// Write an animated GIF of the counts
    #[arg(long, value_name = "FILE", help_heading = "Outputs", value_hint = ValueHint::FilePath)]
    pub(crate) preview: Option<PathBuf>,
    /// Write transforms.json beside a packed burst, so that visionsim opens it
    #[arg(long, help_heading = "Outputs")]
    pub(crate) visionsim: bool,
}

/// See what the camera sees: a built-in scene, simulated, averaged, measured, in one picture
#[derive(Debug, ClapArgs)]
pub(crate) struct Demo {
    /// Picture to write [default: qudi-demo.png, overwritten]
    #[arg(short, long, value_name = "PNG", value_hint = ValueHint::FilePath)]
    pub(crate) output: Option<PathBuf>,
    /// Sensor: a name or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = "qudi-paper")]
    pub(crate) sensor: String,
    /// Photons per pixel and frame
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, default_value_t = 3.25)]
    pub(crate) ppp: f64,
    /// Seed of photons and noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) seed: u64,
}

/// Convert between lux and photons per pixel for a sensor
#[derive(Debug, ClapArgs)]
pub(crate) struct Light {
    /// Illuminance on the sensor plane in lux
    #[arg(long, value_name = "LX", allow_negative_numbers = true, required_unless_present_any = ["ppp", "scene_lux"], conflicts_with_all = ["ppp", "scene_lux"])]
    pub(crate) lux: Option<f64>,
    /// Incident photons per pixel and frame
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, conflicts_with = "scene_lux")]
    pub(crate) ppp: Option<f64>,
    /// Illuminance on a diffuse scene in lux, seen through a lens
    #[arg(long, value_name = "LX", allow_negative_numbers = true)]
    pub(crate) scene_lux: Option<f64>,
    /// Sensor: a name or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = "qudi-paper")]
    pub(crate) sensor: String,
    /// Exposure time in seconds [default: one frame of the sensor]
    #[arg(long, value_name = "S")]
    pub(crate) exposure_time: Option<f64>,
    /// Pixel pitch in micrometres [default: the sensor's]
    #[arg(long, value_name = "UM")]
    pub(crate) pitch: Option<f64>,
    /// Light of one wavelength in nanometres
    #[arg(long, value_name = "NM", default_value_t = 555.0, conflicts_with = "daylight")]
    pub(crate) wavelength: f64,
    /// Daylight, 395 to 718 nm
    #[arg(long)]
    pub(crate) daylight: bool,
    /// Reflectance of the scene, for --scene-lux
    #[arg(long, value_name = "0..1", allow_negative_numbers = true, default_value_t = 0.18)]
    pub(crate) reflectance: f64,
    /// Transmission of the lens, for --scene-lux
    #[arg(long, value_name = "0..1", allow_negative_numbers = true, default_value_t = 0.9)]
    pub(crate) transmission: f64,
    /// f-number of the lens, for --scene-lux
    #[arg(long, value_name = "N", default_value_t = 2.8)]
    pub(crate) f_number: f64,
    /// Magnification of the lens, for --scene-lux
    #[arg(long, value_name = "M", default_value_t = 0.0)]
    pub(crate) magnification: f64,
}

/// Describe anything: captures in any format, bursts, sensors, devices
#[derive(Debug, ClapArgs)]
#[group(skip)]
#[command(group(ArgGroup::new("what").required(true)))]
pub(crate) struct Info {
    /// A capture (file or folder), a burst or its record, a sensor's name or .toml file
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

/// Restore video from a capture
///
/// OUT is a folder (no extension) of 16-bit PNG with manifest.json: killed, it goes on where it
/// stopped. Or one file: .npy (float32), .tif (16 bit), .gif, .mp4 (through ffmpeg), or - for Y4M on standard output. White
/// is 1 = full scale; the scene's mean lands at --exposure.
#[derive(Debug, ClapArgs)]
pub(crate) struct Restore {
    /// The capture: a file or a folder in any format
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) capture: PathBuf,
    /// Where the frames go
    #[arg(short, long, value_name = "OUT", value_hint = ValueHint::AnyPath)]
    pub(crate) output: String,
    /// How: average (11 frames), or mle (response inverted, dark counts subtracted, length chosen)
    #[arg(long, value_name = "NAME", default_value = "mle")]
    pub(crate) method: String,
    /// Sensor that took it: a name or a .toml file [default: known from record or format]
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) sensor: Option<String>,
    /// Incident photons per pixel and frame [default: from the record, or estimated]
    #[arg(long, value_name = "PPP", allow_negative_numbers = true)]
    pub(crate) ppp: Option<f64>,
    /// Gain in DN per electron, for sensors whose gain follows the light [default: from the record]
    #[arg(long, value_name = "DN/E-", allow_negative_numbers = true)]
    pub(crate) gain: Option<f64>,
    /// Image value that PPP photons become: counts do not fix the brightness of a picture
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true, default_value_t = 0.45)]
    pub(crate) exposure: f64,
    /// Seed of methods that draw
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
    /// Frames that neighbouring windows share, blended
    #[arg(long, value_name = "N", default_value_t = 3)]
    pub(crate) overlap: u64,
    /// Do part I of N (from 1), into the same folder as the other parts
    #[arg(long, value_name = "I/N")]
    pub(crate) shard: Option<Shard>,
    /// Write the misfit of every pixel: chi-square of the counts given the result, .npy or .png
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) chi_map: Option<PathBuf>,
    /// Write a picture of the first, middle and last frame: counts above, restored below
    #[arg(long, value_name = "PNG", value_hint = ValueHint::FilePath)]
    pub(crate) side_by_side: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// Compare methods on clips whose truth is known: the same photons and frames for all
///
/// DATA is a clip, or a folder of clips: folders of images, videos, GIF, Y4M, .npy, or scene:NAME.
/// Each clip is exposed once per light level, with a seed of its own. Figures lead with PSNR after the
/// best gain (psnr-a): counts do not fix the brightness of a picture, and no method is told.
#[derive(Debug, ClapArgs)]
pub(crate) struct Eval {
    /// A clip, or a folder of clips
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) data: String,
    /// Methods to compare
    #[arg(long, value_name = "A,B,...", value_delimiter = ',', default_values_t = ["average".to_owned(), "mle".to_owned()])]
    pub(crate) method: Vec<String>,
    /// Incident photons per pixel and frame
    #[arg(long, value_name = "PPP,...", value_delimiter = ',', default_values_t = [3.25, 9.75, 26.0])]
    pub(crate) ppp: Vec<f64>,
    /// Sensor: a name or a .toml file
    #[arg(long, value_name = "NAME|FILE", default_value = "qudi-paper")]
    pub(crate) sensor: String,
    /// Frames of each clip at most
    #[arg(long, value_name = "N", default_value_t = 33)]
    pub(crate) frames: u64,
    /// How photons are drawn: strict (once per clip) or quiver (anew for every window of 11, light
    /// normalised by the window, middle frames judged)
    #[arg(long, value_name = "NAME", default_value = "strict")]
    pub(crate) protocol: Protocol,
    /// Seed; each clip gets one made from it and its name
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) seed: u64,
    /// Mean image value that methods are told
    #[arg(long, value_name = "VALUE", default_value_t = 0.45)]
    pub(crate) exposure: f64,
    /// Frames that neighbouring windows share, blended
    #[arg(long, value_name = "N", default_value_t = 3)]
    pub(crate) overlap: u64,
    /// Write the exact bursts here, for programs of any kind
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub(crate) export_photons: Option<PathBuf>,
    /// Score frames that another program made of them: DIR/dog-ppp9_75.npy, or a folder of that name
    #[arg(long, value_name = "NAME=DIR")]
    pub(crate) external: Vec<External>,
    /// Write every figure of every frame
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) csv: Option<PathBuf>,
    /// Write the table in Markdown
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) markdown: Option<PathBuf>,
    /// Write a report with plot and pictures as one HTML file
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) html: Option<PathBuf>,
    /// Exit with 1 if a method's mean psnr-a over all frames is lower anywhere
    #[arg(long, value_name = "DB", allow_negative_numbers = true)]
    pub(crate) min_psnr: Option<f64>,
}

/// Measure speed and memory of methods
///
/// Restores one window of a simulated burst over and over: one round to warm up, then medians. Keep the
/// results with --json, and compare with them later.
#[derive(Debug, ClapArgs)]
pub(crate) struct Bench {
    /// Methods to measure
    #[arg(long, value_name = "A,B,...", value_delimiter = ',', default_values_t = ["average".to_owned(), "mle".to_owned()])]
    pub(crate) method: Vec<String>,
    /// Frame size, height first
    #[arg(long, value_name = "HxW", default_value = "256x256")]
    pub(crate) size: Size,
    /// Frames of the window
    #[arg(long, value_name = "N", default_value_t = 11)]
    pub(crate) frames: usize,
    /// Measured rounds
    #[arg(long, value_name = "N", default_value_t = 7)]
    pub(crate) rounds: usize,
    /// Results of an earlier run (--json) to compare with
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) compare: Option<PathBuf>,
}

/// How a clip becomes photons, and which frames count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Protocol {
    /// One noise realisation per clip, light normalised by the clip, every frame judged
    Strict,
    /// The public code of QUIVER, seeded: overlapping windows share no photon
    Quiver,
}

/// Frames of another program.
#[derive(Clone, Debug)]
pub(crate) struct External {
    pub(crate) name: String,
    pub(crate) folder: PathBuf,
}

impl std::str::FromStr for External {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((name, folder)) if !name.is_empty() && !folder.is_empty() => {
                Ok(Self { name: name.to_owned(), folder: folder.into() })
            }
            _ => Err("expected NAME=DIR".to_owned()),
        }
    }
}

/// One of several equal parts of the work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shard {
    number: u64,
    of: u64,
}

impl Shard {
    /// Its part of `frames`.
    pub(crate) fn range(self, frames: u64) -> std::ops::Range<u64> {
        let start = |n: u64| (u128::from(frames) * u128::from(n) / u128::from(self.of)) as u64;
        start(self.number - 1)..start(self.number)
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts =
            text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((number, of)) if (1..=of).contains(&number) => Ok(Self { number, of }),
            _ => Err("expected I/N with I from 1 to N, as in 3/8".to_owned()),
        }
    }
}

/// Copy a capture from any format into one that everything reads
///
/// Pixels stay as they are unless --mask or --dcr ask for repair. With --sum N, N frames are
/// summed into each output frame. OUT is an .npy file (binary frames are packed as photoncube and
/// visionsim do), a multi-page .tif, or a folder of PNG (no extension), with a record beside it.
#[derive(Debug, ClapArgs)]
pub(crate) struct Convert {
    /// The capture: a file or a folder
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) capture: PathBuf,
    /// Where it goes
    #[arg(short, long, value_name = "OUT", value_hint = ValueHint::AnyPath)]
    pub(crate) output: PathBuf,
    /// Write binary .npy bursts with one byte per pixel
    #[arg(long)]
    pub(crate) unpacked: bool,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// Measure dark rates, hot pixels and read noise from a capture with the shutter closed
///
/// Writes a sensor file and two maps beside it (NAME.dark.npy, NAME.bad.npy), used from then on by
/// --sensor NAME.toml or --dcr NAME.toml.
#[derive(Debug, ClapArgs)]
pub(crate) struct Calibrate {
    /// The dark capture
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) capture: PathBuf,
    /// The sensor file to write
    #[arg(short, long, value_name = "TOML", value_hint = ValueHint::FilePath)]
    pub(crate) output: PathBuf,
    /// Sensor to start from: a name or a .toml file [default: known from record or format]
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) sensor: Option<String>,
    /// Gain of this capture in DN per electron, for sensors whose gain follows the light
    #[arg(long, value_name = "DN/E-", allow_negative_numbers = true)]
    pub(crate) gain: Option<f64>,
    /// Dark rate beyond which a pixel is hot: per frame, or per second as in 100/s [default: 10 x the median]
    #[arg(long, value_name = "RATE")]
    pub(crate) hot: Option<String>,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// What the user says about a capture that its file does not.
#[derive(Clone, Debug, ClapArgs)]
#[group(skip)]
#[command(next_help_heading = "Reading captures")]
pub(crate) struct Reading {
    /// Format by name (`qudi info --formats`) [default: recognised]
    #[arg(long, value_name = "NAME")]
    format: Option<String>,
    /// Which bit of a byte is the first pixel
    #[arg(long, value_name = "ORDER", value_parser = words::<BitOrder>(&["msb", "lsb"]))]
    bitorder: Option<BitOrder>,
    /// Axis along which 8 pixels share a byte
    #[arg(long, value_name = "AXIS", value_parser = words::<PackAxis>(&["width", "height", "none"]))]
    pack_axis: Option<PackAxis>,
    /// Frame size, height first: for raw files, and packed rows whose width is no multiple of 8
    #[arg(long, value_name = "HxW")]
    size: Option<Size>,
    /// Turn frames; vendor: as the camera's own software shows them
    #[arg(long, value_name = "TURN", value_parser = words::<Orientation>(&["raw", "vendor", "rot90", "rot180", "rot270", "flip-h", "flip-v", "transpose"]))]
    orient: Option<Orientation>,
    /// Order of an array's axes (time, height, width), slowest first
    #[arg(long, value_name = "AXES", value_parser = words::<Axes>(&["thw", "twh", "hwt", "wht", "htw", "wth"]))]
    axes: Option<Axes>,
    /// Colour channel to read as gray, from 0
    #[arg(long, value_name = "N")]
    channel: Option<usize>,
    /// Array (variable, data set) in a file that holds several
    #[arg(long, value_name = "NAME")]
    array: Option<String>,
    /// Values are means of N binary frames, full scale for all ones
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    levels: Option<u16>,
    /// Bits of a count, where the file does not say
    #[arg(long, value_name = "N")]
    bits: Option<u8>,
    /// Bytes before the first frame of each raw file
    #[arg(long, value_name = "BYTES")]
    header: Option<u64>,
    /// Bytes after the last frame of each raw file
    #[arg(long, value_name = "BYTES")]
    trailer: Option<u64>,
    /// Frames in each raw file but the last
    #[arg(long, value_name = "N")]
    frames_per_file: Option<u64>,
    /// First frame, from 0
    #[arg(long, value_name = "N")]
    start: Option<u64>,
    /// One past the last frame
    #[arg(long, value_name = "N")]
    end: Option<u64>,
    /// Rows and columns to keep after turning, as in 2:256,0:496
    #[arg(long, value_name = "Y0:Y1,X0:X1")]
    crop: Option<Crop>,
    /// Sum N frames into one (7 binary frames make 3 bits)
    #[arg(long, value_name = "N")]
    sum: Option<u32>,
    /// Pixels to repair: a .npy or image nonzero at bad ones, auto (found in the capture), or none
    #[arg(long, value_name = "FILE|auto|none")]
    mask: Option<MaskChoice>,
    /// Dark rates: a .npy or .mat map in counts per second, or a calibrated sensor file
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    dcr: Option<PathBuf>,
    /// Drop an incomplete last frame instead of refusing the file
    #[arg(long)]
    lenient: bool,
}

impl Reading {
    /// The options; without --mask, pixels are treated as `mask` says.
    pub(crate) fn options(&self, mask: MaskChoice) -> ReadOptions {
        let given = self.clone();
        // A dark map names its hot pixels; asking for it asks for their repair.
        let mask = if given.dcr.is_some() { MaskChoice::Auto } else { mask };
        ReadOptions {
            format: given.format,
            bit_order: given.bitorder,
            pack_axis: given.pack_axis,
            size: given.size,
            orient: given.orient,
            axes: given.axes,
            channel: given.channel,
            array: given.array,
            levels: given.levels,
            bits: given.bits,
            header: given.header,
            trailer: given.trailer,
            frames_per_file: given.frames_per_file,
            start: given.start,
            end: given.end,
            crop: given.crop,
            sum: given.sum,
            mask: given.mask.unwrap_or(mask),
            dcr: given.dcr,
            lenient: given.lenient,
        }
    }
}

/// One of some words, read as the type that serde names so.
fn words<T: DeserializeOwned + Clone + Send + Sync + 'static>(
    all: &'static [&'static str],
) -> impl TypedValueParser<Value = T> {
    PossibleValuesParser::new(all)
        .try_map(|word| serde_json::from_value::<T>(serde_json::Value::String(word)))
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
