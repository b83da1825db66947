//! The uncertainty of every pixel, written next to the frames: as the network predicts it, or over samples.

use super::plan::Plan;
use crate::error::{CliError, Result};
use crate::methods::network::OwnNetwork;
use crate::methods::{Method, QUDI};
use qudi_core::Frame;
use qudi_io::capture::Capture;
use qudi_io::writer::{ArrayWriter, Planes};

/// A `.npy` file of uncertainties, float32 `[frames, height, width]`, with 3 colours last if any, or none.
#[derive(Debug)]
pub(super) struct UncertaintyFile(Option<(ArrayWriter, Planes)>);

impl UncertaintyFile {
    /// Creates the file that the plan asks for. An earlier run that finished some frames wrote no uncertainty
    /// for them.
    pub(super) fn create(
        plan: &Plan,
        method: &Method,
        capture: &Capture,
        finished: u64,
    ) -> Result<Self> {
        let Some(path) = &plan.uncertainty else { return Ok(Self(None)) };
        let Some(choice) = method.as_own() else {
            let what = format!("{} does not predict its uncertainty", method.name);
            let help = format!("use --method {}", QUDI.name);
            return Err(CliError::new(what, "--uncertainty", help));
        };
        let own = OwnNetwork::new(&plan.network, choice)?;
        let is_drawn = own.kind().is_diffusion() && !plan.network.correct;
        if plan.network.samples < 2 && is_drawn {
            return Err(CliError::new(
                "one sample has no uncertainty",
                "--uncertainty",
                "draw several with --samples K, or predict it with --correct or --method qudi-regression",
            ));
        }
        if path.extension() != Some("npy".as_ref()) {
            return Err(CliError::new(
                "uncertainties are .npy",
                path.display(),
                "name a .npy file",
            ));
        }
        if finished > 0 {
            return Err(CliError::new(
                format!("{finished} frames were restored by an earlier run, without uncertainty"),
                &plan.output,
                "write into another folder",
            ));
        }
        let size = capture.size();
        let coloured = capture.has_colours() && !plan.luma_alone;
        let planes = if coloured { Planes::Rgb } else { Planes::Gray };
        let shape = [size.height, size.width, 3];
        let shape = if coloured { &shape[..] } else { &shape[..2] };
        Ok(Self(Some((ArrayWriter::create(path, plan.overwrite, "<f4", shape)?, planes))))
    }

    /// Takes the uncertainty of a gray frame, or of the luma of colours.
    pub(super) fn push(&mut self, sigma: &Frame) -> qudi_core::Result<()> {
        match &mut self.0 {
            Some((writer, Planes::Gray)) => writer.push_f32(sigma.data.iter().copied()),
            _ => Ok(()),
        }
    }

    /// Takes the uncertainties of red, green and blue.
    pub(super) fn push_colour(&mut self, sigma: &[Frame; 3]) -> qudi_core::Result<()> {
        match &mut self.0 {
            Some((writer, Planes::Rgb)) => writer.push_f32(interleaved(sigma)),
            _ => Ok(()),
        }
    }

    pub(super) fn finish(self) -> Result<()> {
        Ok(self.0.map_or(Ok(()), |(writer, _)| writer.finish())?)
    }
}

/// Returns the values of three planes pixel by pixel.
fn interleaved([red, green, blue]: &[Frame; 3]) -> impl ExactSizeIterator<Item = f32> {
    let value = move |i: usize| [&red.data, &green.data, &blue.data][i % 3][i / 3];
    (0..3 * red.data.len()).map(value)
}
