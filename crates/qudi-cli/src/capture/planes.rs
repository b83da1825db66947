//! Captures of three full planes: red and blue are read next to green.

use super::Source;
use crate::error::{CliError, Result};
use qudi_burst::PlaneFrames;
use qudi_core::sensor::Sensor;
use qudi_io::capture::Capture;
use qudi_io::description::ReadOptions;

/// Channels of red and of blue.
const OTHERS: [usize; 2] = [0, 2];

/// The planes of red and of blue of a capture whose green plane is read elsewhere.
pub(crate) struct OtherPlanes([Capture; 2]);

impl OtherPlanes {
    /// Opens the planes with the sums and the parts of `green`.
    ///
    /// # Errors
    /// [`CliError`] for a pipe, or if they cannot be read.
    pub(crate) fn open(source: &Source<'_>, sensor: &Sensor, green: &Capture) -> Result<Self> {
        if source.input.is_pipe() {
            return Err(CliError::new(
                "three planes of colour in a pipe",
                green.path().display(),
                "store the capture in a file, or read one plane as gray with --channel 0 to 2",
            ));
        }
        let open = |channel| -> Result<Capture> {
            let (channel, sum) = (Some(channel), Some(green.summed()));
            let options = ReadOptions { channel, sum, signed: true, ..source.options.clone() };
            Ok(source.input.open(&options, Some(sensor))?.divided_as(green))
        };
        let [red, blue] = OTHERS.map(open);
        Ok(Self([red?, blue?]))
    }
}

impl PlaneFrames for OtherPlanes {
    fn read(&mut self, first: u64, frames: usize) -> qudi_core::Result<[Vec<Vec<u16>>; 2]> {
        let mut planes = [Vec::new(), Vec::new()];
        for (plane, capture) in planes.iter_mut().zip(&mut self.0) {
            for frame in first..first + frames as u64 {
                let mut counts = vec![0; capture.size().pixels()];
                capture.read(frame, &mut counts)?;
                plane.push(counts);
            }
        }
        Ok(planes)
    }
}
