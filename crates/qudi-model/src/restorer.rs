//! Parts of both restorers: a model, and the bursts and tiles that it takes.

use qudi_core::{Error, Result};

/// The fewest frames of a window.
pub const MIN_FRAMES: usize = 3;

/// A network with its sizes.
#[derive(Debug)]
pub struct Model<N, C> {
    /// The network, on the device that computes.
    pub network: N,
    /// Its sizes.
    pub config: C,
    /// The usual number of frames of a window.
    pub window: usize,
    /// Passes of encoding that the network has learnt.
    pub passes: usize,
}

/// Refuses bursts that are too short.
pub(crate) fn check_frames(frames: usize, window: usize) -> Result<()> {
    if frames >= MIN_FRAMES {
        return Ok(());
    }
    Err(Error::request(
        format!("a burst of {frames} frames"),
        "method",
        format!("it needs at least {MIN_FRAMES}, better {window}"),
    ))
}

/// Refuses tiles that are too small for a network that needs multiples of `multiple`.
pub(crate) fn check_tile(tile: usize, multiple: usize) -> Result<()> {
    let smallest = 4 * multiple;
    if tile >= smallest {
        return Ok(());
    }
    let what = format!("tiles of {tile} pixels");
    Err(Error::request(what, "tile", format!("this network needs at least {smallest}")))
}
