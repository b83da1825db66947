//! Options of `qudi restore`.

use crate::args::given::{DIFFUSION, Given};
use crate::args::{Network, Reading, Shard, Steps, methods, number};
use crate::colour::Gains;
use crate::methods::Method;
use clap::{Args as ClapArgs, ValueEnum, ValueHint};
use std::path::PathBuf;

/// The tone curve of what is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Tonemap {
    /// Values are written as they are
    None,
    /// The curve of sRGB (IEC 61966-2-1)
    Srgb,
}

/// Restore video from a capture
///
/// OUT is a folder (no extension) of 16-bit PNG with manifest.json: killed, it goes on where it stopped. Or
/// one file: .npy (float32), .tif (16 bit, or --float), .gif, .mp4 (through ffmpeg), or - for Y4M on standard
/// output. White is 1 = full scale; the scene's mean lands at --exposure.
#[derive(Debug, ClapArgs)]
pub(crate) struct Restore {
    #[command(flatten)]
    pub(crate) given: Given,
    /// The capture: a file or a folder in any format, or - for a pipe of .npy or raw frames (--format raw-u8
    /// --size HxW)
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) capture: PathBuf,
    /// Where the frames go
    #[arg(short, long, value_name = "OUT", value_hint = ValueHint::AnyPath)]
    pub(crate) output: String,
    /// How frames are restored [default: qudi; qbp-refined for sensors and light that the built-in weights do
    /// not know, and mle where the dark rate is unknown, too]
    #[arg(long, value_name = "NAME", value_parser = methods())]
    pub(crate) method: Option<&'static Method>,
    /// Sensor that took it: a name or a .toml file [default: known from record or format]
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) sensor: Option<String>,
    /// Incident photons per pixel and frame [default: from the record, or estimated]
    #[arg(long, value_name = "PPP", allow_negative_numbers = true, value_parser = number::real(number::PPP))]
    pub(crate) ppp: Option<f64>,
    /// Gain in DN per electron, for sensors whose gain follows the light [default: from the record]
    #[arg(long, value_name = "DN/E-", allow_negative_numbers = true, value_parser = number::real(number::GAIN))]
    pub(crate) gain: Option<f64>,
    /// Image value that PPP photons become: counts do not fix the brightness of a picture [default: 0.45, or
    /// less where parts of the scene would be brighter than white]
    #[arg(long = "exposure", value_name = "VALUE", allow_negative_numbers = true, value_parser = number::real(number::EXPOSURE))]
    pub(crate) mean_level: Option<f64>,
    /// Seed of the diffusion [default: 0]
    #[arg(long, value_name = "N", group = DIFFUSION, allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=u64::MAX))]
    pub(crate) seed: Option<u64>,
    /// Frames that neighbouring windows share, blended
    #[arg(long, value_name = "N", default_value_t = 3, allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=1000))]
    pub(crate) overlap: u64,
    /// Make a picture of every Nth frame of the capture only, counted before frames are summed; below the
    /// number of frames summed (--sum), sums slide
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u64>(number::COUNT))]
    pub(crate) every: Option<u64>,
    /// Restore luma alone of a capture behind a colour filter
    #[arg(long)]
    pub(crate) gray: bool,
    /// White balance of a capture behind a colour filter: gains of red, green and blue, for what is shown;
    /// .npy and float .tif hold the sensor's own colours [default: the sensor file's, or guessed]
    #[arg(long, value_name = "R,G,B", conflicts_with = "gray")]
    pub(crate) wb: Option<Gains>,
    /// Tone curve of what is written: none (values follow the light, as in the clip), or srgb, which
    /// brightens shadows for the eye [default: none; srgb for pictures in colour]
    #[arg(long, value_name = "CURVE")]
    pub(crate) tonemap: Option<Tonemap>,
    /// Frames per second of what plays (.gif, .mp4, Y4M) [default: 25; the capture's own rate is in the
    /// manifest]
    #[arg(long, value_name = "RATE", allow_negative_numbers = true, value_parser = number::real(number::PLAYED_FPS))]
    pub(crate) fps: Option<f64>,
    /// Do part I of N (from 1), into the same folder as the other parts
    #[arg(long, value_name = "I/N")]
    pub(crate) shard: Option<Shard>,
    /// Write .tif with 32-bit float samples, nothing clipped, instead of 16-bit ones
    #[arg(long)]
    pub(crate) float: bool,
    /// CAPTURE is a set of the Single Photon Challenge (SCENE/FRAME.npy), OUT the .zip that its site takes:
    /// the last picture of every cube in colour, scored where SCENE/FRAME.png is there. Killed, it goes on
    /// after the last finished picture
    #[arg(long, conflicts_with_all = [
        "sensor", "ppp", "gain", "mean_level", "overlap", "every", "gray", "wb", "tonemap", "fps", "shard", "float",
        "chi_map", "side_by_side", "html", "uncertainty", "format", "bitorder", "pack_axis", "size", "orient",
        "axes", "channel", "cfa", "array", "levels", "bits", "offset", "threshold", "header", "trailer",
        "frames_per_file", "start", "end", "crop", "mask", "dcr", "lenient",
    ])]
    pub(crate) challenge: bool,
    /// With --challenge: score LPIPS as well, as the site does, with the weights of AlexNet in this folder
    /// (docs/training.md says how to get them)
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::DirPath, requires = "challenge")]
    pub(crate) backbones: Option<PathBuf>,
    /// Write the misfit of every pixel: chi-square of the counts given the result, .npy or .png
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) chi_map: Option<PathBuf>,
    /// Write a picture of the first, middle and last frame: counts above, restored below (of colours,
    /// their luma)
    #[arg(long, value_name = "PNG", value_hint = ValueHint::FilePath)]
    pub(crate) side_by_side: Option<PathBuf>,
    /// Write a page that plays: counts, restored frames, uncertainty and misfit under a slider, the settings
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) html: Option<PathBuf>,
    /// Write the uncertainty of every pixel, or of every colour of it, .npy: the sigma that the network
    /// predicts, or that over --samples K
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) uncertainty: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) steps: Steps,
    #[command(flatten)]
    pub(crate) network: Network,
    #[command(flatten)]
    pub(crate) reading: Reading,
}
