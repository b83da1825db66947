//! Restoring for a calling program: frames go to it instead of a file.

use super::args::{Restore, Tonemap};
use super::chi_square_map::ChiSquareMap;
use super::output::toned;
use super::plan::Plan;
use super::run::Job;
use crate::args::Global;
use crate::capture::{Input, Source};
use crate::colour::{Rendering, encoded};
use crate::error::{CliError, Result};
use crate::report::Report;
use crate::settings::Settings;
use qudi_core::Frame;
use qudi_io::restore::RestoreSink;
use serde_json::{Value, json};

/// A program that receives restored frames.
pub trait Receiver {
    /// Takes the settings that all frames depend on, with the number of frames, if it is known.
    ///
    /// # Errors
    /// The receiver's own; the run ends with it.
    fn start(&mut self, settings: &Value, frames: Option<u64>) -> qudi_core::Result<()>;

    /// Takes the next frame.
    ///
    /// # Errors
    /// The receiver's own; the run ends with it.
    fn frame(&mut self, frame: &Frame) -> qudi_core::Result<()>;

    /// Takes red, green and blue of the next frame, of captures behind a colour filter.
    ///
    /// # Errors
    /// The receiver's own; the run ends with it.
    fn colour(&mut self, frame: &[Frame; 3]) -> qudi_core::Result<()>;

    /// Takes the uncertainty of the frame that came last, from methods that predict it.
    ///
    /// # Errors
    /// The receiver's own; the run ends with it.
    fn uncertainty(&mut self, sigma: &Frame) -> qudi_core::Result<()>;

    /// Takes the uncertainties of red, green and blue of the frame that came last, in place of a gray one.
    ///
    /// # Errors
    /// The receiver's own; the run ends with it.
    fn colour_uncertainty(&mut self, sigma: &[Frame; 3]) -> qudi_core::Result<()>;
}

/// A sink that hands frames to a receiver and measures their chi-square.
struct Sink<'a> {
    receiver: &'a mut dyn Receiver,
    map: ChiSquareMap,
    tonemap: Tonemap,
    /// Rendering of colours for the eye, where colours are restored.
    rendering: Option<Rendering>,
}

impl RestoreSink for Sink<'_> {
    fn frame(&mut self, _: u64, restored: &Frame, counts: &[u16]) -> qudi_core::Result<()> {
        self.receiver.frame(&toned(self.tonemap, restored))?;
        self.map.add(restored, counts)
    }

    fn colour(&mut self, _: u64, restored: &[Frame; 3], counts: &[u16]) -> qudi_core::Result<()> {
        match &self.rendering {
            Some(rendering) if self.tonemap == Tonemap::Srgb => {
                self.receiver.colour(&encoded(&rendering.rendered(restored)))?;
            }
            _ => self.receiver.colour(restored)?,
        }
        self.map.add_colour(restored, counts)
    }

    fn uncertainty(&mut self, _: u64, sigma: &Frame) -> qudi_core::Result<()> {
        if self.rendering.is_some() { Ok(()) } else { self.receiver.uncertainty(sigma) }
    }

    fn colour_uncertainty(&mut self, _: u64, sigma: &[Frame; 3]) -> qudi_core::Result<()> {
        self.receiver.colour_uncertainty(sigma)
    }
}

/// Restores `input`, or the capture that `args` name, for `receiver`; returns the document that `--json`
/// prints. Of parts of the work, the receiver gets its own alone.
pub(crate) fn run(
    mut args: Restore,
    input: Option<Input>,
    settings: &Settings,
    global: &Global,
    report: &Report,
    receiver: &mut dyn Receiver,
) -> Result<Value> {
    refuse_files(&args)?;
    let shard = args.shard.take();
    let plan = Plan::new(&args, global, false)?;
    let source = match input {
        Some(input) => Source { input, ..plan.source() },
        None => plan.source(),
    };
    let mut job = Job::prepare(&plan, &source, settings, report)?;
    let settings = job.settings(&plan)?;
    let frames = job.schedule.instants.pictures(job.capture());
    let part = match (shard, frames) {
        (Some(shard), Some(frames)) => shard.range(frames),
        (Some(_), None) => {
            let help = "store the capture in a file to share the work";
            return Err(CliError::new("a stream comes once and whole", "--shard", help));
        }
        (None, frames) => 0..frames.unwrap_or(u64::MAX),
    };
    receiver.start(&settings, frames.map(|_| part.end - part.start))?;
    let map = ChiSquareMap::new(job.capture().size(), frames, &job.acquisition);
    let map = map.behind(job.capture().filter().cloned());
    let rendering = job.rendering.clone();
    let mut sink = Sink { receiver, map, tonemap: plan.tonemap(), rendering };
    job.run(part, &mut sink, &plan.network, report)?;
    let results = job.results(&plan, sink.map.chi_square(), true)?;
    crate::capture::remarks(job.capture(), report);
    for warning in &job.warnings {
        report.warning(warning);
    }
    Ok(json!({"settings": settings, "results": results}))
}

/// Refuses options for files, which nobody writes here.
fn refuse_files(args: &Restore) -> Result<()> {
    let given = [
        (args.chi_map.is_some(), "--chi-map"),
        (args.side_by_side.is_some(), "--side-by-side"),
        (args.html.is_some(), "--html"),
        (args.challenge, "--challenge"),
        (args.uncertainty.is_some(), "--uncertainty"),
        (args.float, "--float"),
        (args.fps.is_some(), "--fps"),
    ];
    let Some((_, flag)) = given.into_iter().find(|(given, _)| *given) else { return Ok(()) };
    Err(CliError::new("no file is written", flag, "leave it out: frames and sigma are returned"))
}
