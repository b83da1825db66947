//! Watching a run: progress, pictures, report.

use super::environment::ENVIRONMENT;
use super::loops::{Loop, loops};
use super::pictures::strip;
use super::report::{Source, page};
use crate::error::{CliError, Result};
use crate::interrupt;
use crate::report::{Bar, Report};
use qudi_core::Error;
use qudi_core::atomic_file::{Overwrite, PendingFile};
use qudi_core::limits::RECORD_BYTES;
use qudi_core::regular_file::read_limited;
use qudi_train::{Event, METRICS, RECIPE, Recipe, StepReport, Validation};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Folder of pictures in a run's folder.
pub(super) const SAMPLES: &str = "samples";

/// Loops of the last validation, in the folder of pictures.
const LOOPS: &str = "loops.json";

/// Name of the report.
pub(super) const REPORT: &str = "report.html";

/// Formats quality at every light level.
pub(crate) fn quality_text(means: &[(f64, [f64; 3])]) -> String {
    let one = |(ppp, [psnr_a, _, ssim]): &(f64, [f64; 3])| {
        format!("{ppp} PPP: psnr-a {psnr_a:.2} dB, ssim {ssim:.3}")
    };
    means.iter().map(one).collect::<Vec<_>>().join("; ")
}

/// Means of psnr-a, PSNR and SSIM at every light level.
pub(crate) type Means = Vec<(f64, [f64; 3])>;

/// Shows a run's progress and writes its pictures.
pub(crate) struct Watch<'a> {
    report: &'a Report,
    folder: &'a Path,
    steps: u64,
    samples: f64,
    bar: Bar,
    start: Instant,
    taken: u64,
    /// Moving average of the loss.
    loss: Option<f64>,
    /// Means of the last validation.
    last: Option<Means>,
    error: Option<CliError>,
    /// The time to stop.
    end: Option<Instant>,
}

impl<'a> Watch<'a> {
    pub(crate) fn new(
        recipe: &Recipe,
        folder: &'a Path,
        end: Option<Instant>,
        report: &'a Report,
    ) -> Self {
        Self {
            report,
            folder,
            steps: recipe.train.steps,
            samples: (recipe.train.batch * recipe.train.accumulate) as f64,
            bar: report.bar(),
            start: Instant::now(),
            taken: 0,
            loss: None,
            last: None,
            error: None,
            end,
        }
    }

    pub(crate) fn event(&mut self, event: &Event<'_>) -> ControlFlow<()> {
        let shown = match event {
            Event::Step(step) => {
                self.step(step);
                Ok(())
            }
            Event::Validation(validation) => self.validation(validation),
            Event::Saved(_) => Ok(()),
            Event::Dead(layers) => {
                self.bar.warning(&dead_text(layers), self.report);
                Ok(())
            }
        };
        if let Err(error) = shown {
            self.error = Some(error);
        }
        if self.error.is_some() || self.is_over() {
            return ControlFlow::Break(());
        }
        interrupt::check()
    }

    /// Returns true once the time to stop has come.
    pub(crate) fn is_over(&self) -> bool {
        self.end.is_some_and(|end| Instant::now() >= end)
    }

    fn step(&mut self, step: &StepReport) {
        self.taken += 1;
        let loss = self.loss.map_or(step.loss.total, |loss| 0.98 * loss + 0.02 * step.loss.total);
        self.loss = Some(loss);
        let rate = self.samples * self.taken as f64 / self.start.elapsed().as_secs_f64();
        let text = format!("loss {loss:.5} rate {:.1e} {rate:.2} samples/s", step.lr);
        self.bar.learning(text, step.step, self.steps);
    }

    /// Returns the means of the last validation, or the error of watching.
    pub(crate) fn finish(self) -> Result<Option<Means>> {
        match self.error {
            Some(error) => Err(error),
            None => Ok(self.last),
        }
    }

    fn validation(&mut self, validation: &Validation) -> Result<()> {
        let minutes = self.start.elapsed().as_secs_f64() / 60.0;
        // None before the first step.
        let loss = self.loss.map_or(String::new(), |loss| format!("loss {loss:.5}; "));
        let text = format!(
            "step {} of {}, {minutes:.1} min: {loss}{}",
            validation.step,
            self.steps,
            quality_text(&validation.means())
        );
        self.bar.above(&text, self.report);
        self.last = Some(validation.means());
        let folder = self.folder.join(SAMPLES);
        let made = std::fs::create_dir_all(&folder);
        made.map_err(|e| Error::io("make the folder of pictures", &folder, e))?;
        let name = format!("step-{:07}.png", validation.step);
        strip(&validation.clips).save(&folder.join(name), Overwrite::Yes)?;
        let loops = serde_json::to_string(&loops(validation)).unwrap_or_default();
        write(&folder, LOOPS, loops.as_bytes())?;
        write_report(self.folder)
    }
}

/// Writes a file of the run.
pub(crate) fn write(folder: &Path, name: &str, bytes: &[u8]) -> Result<()> {
    Ok(PendingFile::write_whole(&folder.join(name), bytes, Overwrite::Yes)?)
}

/// Writes the report of a run's folder.
pub(crate) fn write_report(folder: &Path) -> Result<()> {
    let read = |name: &str| {
        let path = folder.join(name);
        std::fs::read_to_string(&path).map_err(|e| Error::io("read the run", &path, e))
    };
    let samples = folder.join(SAMPLES);
    let pictures = std::fs::read_dir(&samples).into_iter().flatten().flatten();
    let pictures = pictures.map(|entry| entry.path());
    let last: Option<PathBuf> =
        pictures.filter(|path| path.extension().is_some_and(|kind| kind == "png")).max();
    let picture = last.and_then(|path| std::fs::read(path).ok());
    // A page without loops is better than none.
    let loops = read_limited(&samples.join(LOOPS), RECORD_BYTES, "read the loops").ok();
    let loops = loops.and_then(|text| serde_json::from_slice::<Vec<Loop>>(&text).ok());
    let text = page(Source {
        metrics: &read(METRICS)?,
        recipe: &read(RECIPE)?,
        environment: &read(ENVIRONMENT)?,
        picture: picture.as_deref(),
        loops: loops.unwrap_or_default(),
    })?;
    write(folder, REPORT, text.as_bytes())
}

/// Says which layers are dead, and what to do.
fn dead_text(layers: &[String]) -> String {
    const NAMED: usize = 4;
    let named = layers.iter().take(NAMED).map(String::as_str).collect::<Vec<_>>().join(", ");
    let others = match layers.len().saturating_sub(NAMED) {
        0 => String::new(),
        others => format!(" and {others} more"),
    };
    format!(
        "no gradient reaches {named}{others}: these layers learn no more (all units are off); \
         start again with network.linear_entries=true, where the network has it, or a lower train.lr"
    )
}
