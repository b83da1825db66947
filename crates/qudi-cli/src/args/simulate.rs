//! Options of `qudi simulate`.

use clap::{Args as ClapArgs, ValueHint};
use qudi_core::Size;
use std::path::PathBuf;

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
    /// Write the true frames: .npy (float32), .tif, or a folder of 16-bit PNG
    #[arg(long, value_name = "PATH", help_heading = "Outputs", value_hint = ValueHint::AnyPath)]
    pub(crate) truth: Option<PathBuf>,
    /// Write the true frames' .tif with 32-bit float samples instead of 16-bit ones
    #[arg(long, requires = "truth", help_heading = "Outputs")]
    pub(crate) float: bool,
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
