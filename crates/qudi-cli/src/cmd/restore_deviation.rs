//! How far each pixel may be off, written beside the frames: what the network tells of its errors, or the deviation over
//! samples.

use crate::args::{Network, Restore};
use crate::error::{Fault, Result};
use qudi_core::Frame;
use qudi_core::atomic_file::Overwrite;
use qudi_io::capture::Capture;
use qudi_io::writer::ArrayWriter;
use std::path::Path;

/// A `.npy` file of deviations, float32 `[frames, height, width]`, or none.
#[derive(Debug)]
pub(crate) struct Deviation(Option<ArrayWriter>);

/// Whether the network, asked so, tells its errors without samples.
pub(crate) fn tells_errors(network: &Network) -> Result<bool> {
    Ok(network.steps()? == 0 && network.weights().describe()?.network.pre.uncertainty)
}

impl Deviation {
    /// The file that was asked for. `finished` frames were there already; theirs would be missing.
    pub(crate) fn create(
        args: &Restore,
        method: &str,
        capture: &Capture,
        finished: u64,
        overwrite: Overwrite,
    ) -> Result<Self> {
        let Some(path) = &args.deviation else { return Ok(Self(None)) };
        if method != "qudi" {
            let what = format!("{method} does not tell how far it may be off");
            return Err(Fault::new(what, "--uncertainty", "use --method qudi"));
        }
        if args.network.samples() < 2 && !tells_errors(&args.network)? {
            return Err(Fault::new(
                "there is no deviation of one sample",
                "--uncertainty",
                "draw several with --samples K, or none with --steps 0 if the weights tell errors (`qudi info FILE`)",
            ));
        }
        if path.extension() != Some("npy".as_ref()) {
            return Err(Fault::new("deviations are .npy", path.display(), "name a .npy file"));
        }
        if finished > 0 {
            return Err(Fault::new(
                format!(
                    "{finished} frames were restored by an earlier run, without their deviation"
                ),
                Path::new(&args.output).display(),
                "write into another folder",
            ));
        }
        let size = capture.size();
        let shape = [size.height, size.width];
        Ok(Self(Some(ArrayWriter::create(path, overwrite, "<f4", &shape)?)))
    }

    pub(crate) fn push(&mut self, deviation: &Frame) -> qudi_core::Result<()> {
        let values = deviation.data.iter().copied();
        self.0.as_mut().map_or(Ok(()), |writer| writer.push_f32(values))
    }

    pub(crate) fn finish(self) -> Result<()> {
        Ok(self.0.map_or(Ok(()), ArrayWriter::finish)?)
    }
}
