//! Options of `qudi eval`.

use crate::args::given::{DIFFUSION, Given, OWN};
use crate::args::reading::words;
use crate::args::{Network, Reading, Shard, methods, number};
use crate::methods::{COMPARED, Method};
use clap::{Args as ClapArgs, ValueEnum, ValueHint};
use qudi_core::PppDefinition;
use std::path::PathBuf;

/// Compare methods on clips whose truth is known, or on a real capture: the same photons and frames for all
///
/// DATA is a clip, or a folder of clips: folders of images, videos, GIF, Y4M, .npy, or scene:NAME.
/// Each clip is exposed once per light level, with a seed of its own. Figures lead with PSNR after the
/// best gain (psnr-a): counts do not fix the brightness of a picture, and no method is given it.
/// Settings of `qudi simulate` apply to clips, --sum and --size as there.
///
/// With --capture, DATA is a capture in any format. It has no truth, so that there are pictures (--html) and
/// the chi-square of its counts given the result; a method that fits the noise gets below 1, one that blurs
/// or invents above.
#[derive(Debug, ClapArgs)]
pub(crate) struct Eval {
    #[command(flatten)]
    pub(crate) given: Given,
    /// A clip, a folder of clips, or a capture
    #[arg(value_hint = ValueHint::AnyPath)]
    pub(crate) data: String,
    /// DATA is a capture of counts, without truth
    #[arg(long)]
    pub(crate) capture: bool,
    /// Score these colours, a .npy of (frames, height, width, 3) in linear light, against DATA, the truth
    /// that `qudi simulate --cfa` wrote: CPSNR, CIEDE2000 and zipper error after one common gain, and LPIPS
    /// of sRGB values with --backbones
    #[arg(long, value_name = "FILE", conflicts_with_all = ["capture", "table1", "external", "join", "shard", "export_photons", "csv", "markdown", "html", "appearance", "method", "ppp", "ppp_def", "sensor", "clips", "frames", "seed", "protocol", "overlap", "mean_level", "min_psnr", "steps"], value_hint = ValueHint::FilePath)]
    pub(crate) restored: Option<PathBuf>,
    /// Methods to compare
    #[arg(long, value_name = "A,B,...", value_delimiter = ',', default_values = COMPARED, value_parser = methods())]
    pub(crate) method: Vec<&'static Method>,
    /// Compare all methods of the paper's table 1 that need no weights or whose --weights are named, with its
    /// figures
    #[arg(long, conflicts_with_all = ["method", "capture"])]
    pub(crate) table1: bool,
    /// Incident photons per pixel and frame [default: 3.25,9.75,26; of a capture: from its record, or
    /// estimated]
    #[arg(long, value_name = "PPP,...", value_delimiter = ',', allow_negative_numbers = true, value_parser = number::real(number::PPP))]
    pub(crate) ppp: Vec<f64>,
    /// What --ppp counts for clips: incident photons, detected electrons, or dn, the mean output value
    #[arg(long, value_name = "MEANING", conflicts_with = "capture", value_parser = words::<PppDefinition>(&["incident", "detected", "dn"]))]
    pub(crate) ppp_def: Option<PppDefinition>,
    /// Sensor: a name or a .toml file [default: qudi-paper; of a capture: known from record or format]
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) sensor: Option<String>,
    /// Gain of a capture in DN per electron, for sensors whose gain follows the light
    #[arg(long, value_name = "DN/E-", allow_negative_numbers = true, requires = "capture", value_parser = number::real(number::GAIN))]
    pub(crate) gain: Option<f64>,
    /// Only these clips of the folder, as those to choose settings on, or those to report on
    #[arg(long, value_name = "NAME,...", value_delimiter = ',', conflicts_with = "capture")]
    pub(crate) clips: Vec<String>,
    /// Frames of each clip, or of the capture, at most [default: 33]
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u64>(number::COUNT))]
    pub(crate) frames: Option<u64>,
    /// How photons are drawn: strict (once per clip) or quiver (anew for every window of 11, light
    /// normalised by the window, middle frames scored)
    #[arg(long, value_name = "NAME", default_value = "strict")]
    pub(crate) protocol: Protocol,
    /// Seed; each clip gets one made from it and its name [default: 1]
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=u64::MAX))]
    pub(crate) seed: Option<u64>,
    /// Mean image value that methods are given [default: as `qudi restore` finds it in each capture]
    #[arg(long = "exposure", value_name = "VALUE", allow_negative_numbers = true, value_parser = number::real(number::EXPOSURE))]
    pub(crate) mean_level: Option<f64>,
    /// Frames that neighbouring windows share, blended
    #[arg(long, value_name = "N", default_value_t = 3, allow_negative_numbers = true, value_parser = number::whole::<u64>(0..=1000))]
    pub(crate) overlap: u64,
    /// Write the exact bursts here, for programs of any kind
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub(crate) export_photons: Option<PathBuf>,
    /// Score frames that another program made of them: DIR/dog-ppp9_75.npy, or a folder of that name
    #[arg(long, value_name = "NAME=DIR")]
    pub(crate) external: Vec<External>,
    /// Do part I of N (from 1) of the clips: parts give the same figures as the whole, and their --csv files
    /// join
    #[arg(long, value_name = "I/N", conflicts_with = "capture")]
    pub(crate) shard: Option<Shard>,
    /// Join the parts of --shard, which were printed with --json: the same figures as of one run
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["capture", "shard", "external", "export_photons", "html"], value_hint = ValueHint::FilePath)]
    pub(crate) join: Vec<PathBuf>,
    /// Write every figure of every frame
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) csv: Option<PathBuf>,
    /// Write the table in Markdown
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) markdown: Option<PathBuf>,
    /// Write a report with plot and pictures as one HTML file
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) html: Option<PathBuf>,
    /// Measure LPIPS as well, after the best gain, with the weights of AlexNet and VGG16 in this folder
    /// (docs/training.md says how to get them)
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::DirPath, conflicts_with = "capture")]
    pub(crate) backbones: Option<PathBuf>,
    /// Measure appearance as well, after the best gain: GMSD, SSIMULACRA 2, butteraugli, detail over the
    /// truth's in the flattest and the most textured quarter; under the strict protocol also errors over
    /// their predicted uncertainty, and what more --steps add over what is missing, octave by octave
    #[arg(long, conflicts_with = "capture")]
    pub(crate) appearance: bool,
    /// Exit with 1 if a method's mean psnr-a over all frames is lower anywhere
    #[arg(long, value_name = "DB", allow_negative_numbers = true, value_parser = number::real(-1000.0..=1000.0))]
    pub(crate) min_psnr: Option<f64>,
    /// Numbers of reverse steps of qudi-diffusion, each evaluated for itself [default: as the weights say]
    #[arg(long, value_name = "N,...", value_delimiter = ',', groups = [OWN, DIFFUSION], help_heading = "Networks (methods qudi, qudi-regression, qudi-diffusion)", allow_negative_numbers = true, value_parser = number::whole::<usize>(1..=1000))]
    pub(crate) steps: Vec<usize>,
    #[command(flatten)]
    pub(crate) network: Network,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// How a clip becomes photons, and which frames count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Protocol {
    /// One noise realisation per clip, light normalised by the clip, every frame scored
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
