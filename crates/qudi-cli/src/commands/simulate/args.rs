//! Options of `qudi simulate`.

use crate::settings::KeyFlags;
use clap::{Args as ClapArgs, ValueHint};
use std::path::PathBuf;

/// Turn video, images or synthetic scenes into photon counts
///
/// INPUT is a folder of PNG, JPEG or TIFF frames, a GIF, Y4M or .npy file, any video (decoded by
/// ffmpeg), one image to set in motion, a procedural scene (scene:dead-leaves, scene:text,
/// scene:gratings, scene:chart), or - for Y4M on standard input.
///
/// OUT is an .npy file (binary frames are packed, 8 pixels to the byte), a multi-page .tif, a
/// folder of PNG (no extension), or - for .npy on standard output. A record that makes the burst
/// again is written next to it: OUT.json, or burst.json in the folder.
#[derive(Debug, ClapArgs)]
pub(crate) struct Simulate {
    /// What to expose
    #[arg(required_unless_present = "from", conflicts_with = "from", value_hint = ValueHint::AnyPath)]
    pub(crate) input: Option<String>,
    /// Where the burst goes
    #[arg(short, long, value_name = "OUT", value_hint = ValueHint::AnyPath)]
    pub(crate) output: String,
    /// Make the burst of this record again; only outputs may be given with it
    #[arg(long, value_name = "RECORD", value_hint = ValueHint::FilePath)]
    pub(crate) from: Option<PathBuf>,

    #[command(flatten)]
    pub(crate) keys: KeyFlags,

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
    /// Write transforms.json next to a packed burst, so that visionsim opens it
    #[arg(long, help_heading = "Outputs")]
    pub(crate) visionsim: bool,
}
