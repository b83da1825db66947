//! Restoring pictures of a capture as they are asked for.

use super::args::Restore;
use super::plan::Plan;
use super::run::{Job, describe};
use crate::args::Global;
use crate::capture::Source;
use crate::colour::Rendering;
use crate::commands::look::run::JUDGED_BYTES;
use crate::commands::look::strip::strip;
use crate::error::Result;
use crate::report::Report;
use crate::report::player::counts_frame;
use crate::settings::Settings;
use qudi_core::{Frame, Size};
use qudi_io::restore::RestoreSink;
use std::ops::Range;

/// A capture with a method that restores any of its pictures, as `qudi restore` would.
pub(crate) struct OnDemand {
    plan: Plan,
    job: Job,
}

impl OnDemand {
    /// Opens the capture that `args` name, and makes the restorer. Bad frames are looked for in a part, since
    /// nobody waits for a page until all of a long capture is read.
    pub(crate) fn new(
        args: &Restore,
        settings: &Settings,
        global: &Global,
        report: &Report,
    ) -> Result<Self> {
        let plan = Plan::new(args, global, false)?;
        let source = Source { judged: JUDGED_BYTES, ..plan.source() };
        let job = Job::prepare(&plan, &source, settings, report)?;
        Ok(Self { plan, job })
    }

    /// Returns the number of pictures.
    pub(crate) fn pictures(&self) -> u64 {
        self.job.schedule.instants.pictures(self.job.capture()).unwrap_or(0)
    }

    pub(crate) fn size(&self) -> Size {
        self.job.capture().size()
    }

    /// Returns the name of the method.
    pub(crate) fn method(&self) -> &'static str {
        self.job.method.name
    }

    /// Returns true if the capture was simulated, from images as screens show them.
    pub(crate) fn is_simulated(&self) -> bool {
        self.job.capture().info().mean_level.is_some()
    }

    /// Returns how colours are rendered, if there are any.
    pub(crate) fn rendering(&self) -> Option<Rendering> {
        self.job.rendering.clone()
    }

    /// Draws light and change of the capture over time.
    pub(crate) fn strip(&self) -> Option<String> {
        strip(self.job.capture().timeline(), self.job.capture().findings())
    }

    /// Returns what makes the pictures doubtful.
    pub(crate) fn warnings(&self) -> &[String] {
        &self.job.warnings
    }

    /// Describes the capture and its light in lines.
    pub(crate) fn describe(&self) -> String {
        let capture = self.plan.capture.display().to_string();
        describe(&capture, &self.job, self.pictures(), 0, None, None)
    }

    /// Reads the counts of a picture, full scale for 1.
    pub(crate) fn counts(&mut self, picture: u64) -> Result<Frame> {
        let max_count = self.job.acquisition.sensor.max_count();
        let instants = self.job.schedule.instants;
        let capture = &mut self.job.aligned.capture;
        let size = capture.size();
        let mut counts = vec![0; size.pixels()];
        instants.read(capture, picture, &mut counts)?;
        Ok(counts_frame(size, &counts, max_count))
    }

    /// Restores pictures and hands them to `sink`.
    pub(crate) fn restore(
        &mut self,
        pictures: Range<u64>,
        sink: &mut dyn RestoreSink,
        report: &Report,
    ) -> Result<()> {
        self.job.run(pictures, sink, &self.plan.network, report)
    }
}
