//! The console: results go to standard output, everything else to standard error. No other file prints.
#![allow(clippy::print_stdout, clippy::print_stderr)]

use crate::args::{Color, Global};
use crate::error::{CliError, Result, stdout_error};
use crate::interrupt;
use crate::report::json::document;
use crate::report::{Listener, Message, duration, printable};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use qudi_core::progress::Progress;
use std::io::{IsTerminal, Write};
use std::time::Instant;
use tracing_subscriber::EnvFilter;

/// Prints what a run has to say, as its options ask, or tells it to the program that called.
pub(crate) struct Report {
    json: bool,
    volume: Volume,
    color: bool,
    listener: Option<Listener>,
}

/// The amount of text that a run prints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Volume {
    Quiet,
    Normal,
    Verbose,
}

impl Report {
    pub(crate) fn new(global: &Global) -> Self {
        let color = match global.color {
            Color::Always => true,
            Color::Never => false,
            Color::Auto => {
                std::io::stderr().is_terminal()
                    && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
            }
        };
        let (volume, level) = match (global.quiet, global.verbose) {
            (true, _) => (Volume::Quiet, "error"),
            (false, 0) => (Volume::Normal, "warn"),
            (false, 1) => (Volume::Verbose, "info"),
            (false, _) => (Volume::Verbose, "debug"),
        };
        let filter = EnvFilter::try_from_env("QUDI_LOG").unwrap_or_else(|_| EnvFilter::new(level));
        // Setting it twice can only happen in tests, and then the first one serves.
        let _ = tracing_subscriber::fmt()
            .with_env_filter(filter)
            .with_writer(std::io::stderr)
            .with_ansi(color)
            .without_time()
            .with_target(false)
            .try_init();
        Self { json: global.json, volume, color, listener: None }
    }

    /// Makes a report for errors that occur before the options are known.
    pub(crate) fn plain() -> Self {
        Self { json: false, volume: Volume::Normal, color: false, listener: None }
    }

    /// Makes a report that prints nothing and tells `listener` instead.
    pub(crate) fn to(listener: Listener) -> Self {
        Self { json: true, volume: Volume::Normal, color: false, listener: Some(listener) }
    }

    fn tell(&self, message: impl FnOnce() -> Message) -> bool {
        self.listener.as_ref().inspect(|listener| listener(message())).is_some()
    }

    pub(crate) fn json(&self) -> bool {
        self.json
    }

    /// Prints a result: the JSON document if asked for, else the text unless quiet.
    pub(crate) fn result(
        &self,
        text: &str,
        json: impl FnOnce() -> serde_json::Value,
    ) -> Result<()> {
        if let Some(listener) = &self.listener {
            listener(Message::Result(json()));
            return Ok(());
        }
        if self.json {
            return print(&document(&json()));
        }
        if self.volume == Volume::Quiet { Ok(()) } else { print(&printable(text)) }
    }

    /// Prints a remark to the standard error.
    pub(crate) fn remark(&self, text: &str) {
        if self.tell(|| Message::Note(text.trim_start_matches("note: ").to_owned())) {
            return;
        }
        if self.volume != Volume::Quiet {
            eprintln!("{}", printable(text));
        }
    }

    /// Prints what makes a result doubtful.
    pub(crate) fn warning(&self, text: &str) {
        if !self.tell(|| Message::Warning(text.to_owned())) {
            self.remark(&format!("warning: {text}"));
        }
    }

    /// Makes a progress bar, which is hidden off a terminal, under --json and under --quiet; with --verbose,
    /// log lines take its place.
    pub(crate) fn bar(&self) -> Bar {
        let shown = !self.json && self.volume == Volume::Normal && std::io::stderr().is_terminal();
        let target =
            if shown { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(None, target);
        let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}");
        bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        Bar { line: bar, tenth: 0, work: Work::default(), listener: self.listener.clone() }
    }

    /// Prints an error and returns the exit code of the program.
    pub(crate) fn error(&self, error: &CliError) -> u8 {
        match error {
            CliError::BrokenPipe => 0,
            CliError::Interrupted => {
                self.remark("interrupted: nothing was written");
                interrupt::EXIT_CODE
            }
            CliError::Stopped(what) => {
                self.remark(what);
                interrupt::EXIT_CODE
            }
            CliError::TimeOver(what) => {
                self.remark(what);
                0
            }
            CliError::Missed(what) => {
                self.remark(what);
                1
            }
            CliError::Error { what, place, help, .. } => {
                let (red, bold, plain) =
                    if self.color { ("\x1b[1;31m", "\x1b[1m", "\x1b[0m") } else { ("", "", "") };
                let mut text = format!("{red}error:{plain} {}\n", printable(what));
                if let Some(place) = place {
                    text += &format!("  {bold}where:{plain} {}\n", printable(place));
                }
                if let Some(help) = help {
                    text += &format!("  {bold}help:{plain} {}\n", printable(help));
                }
                // Nothing can be done if standard error is gone as well.
                let _ = std::io::stderr().write_all(text.as_bytes());
                2
            }
        }
    }
}

/// Prints text that was asked for by name, also when quiet.
pub(crate) fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    let end = if text.ends_with('\n') { "" } else { "\n" };
    write!(out, "{text}{end}").and_then(|()| out.flush()).map_err(stdout_error)
}

/// Shows the progress of one command.
pub(crate) struct Bar {
    line: ProgressBar,
    tenth: u64,
    work: Work,
    listener: Option<Listener>,
}

/// The work that a bar shows.
#[derive(Debug, Default)]
struct Work {
    what: &'static str,
    /// When it was heard of first, and how much of it was done then.
    start: Option<(Instant, u64)>,
    /// Its speed and the time left, in words.
    speed: String,
}

impl Work {
    fn measure(&mut self, done: u64, total: Option<u64>) {
        let (start, before) = *self.start.get_or_insert_with(|| (Instant::now(), done));
        let (seconds, made) = (start.elapsed().as_secs_f64(), done.saturating_sub(before) as f64);
        if made == 0.0 || seconds == 0.0 {
            return;
        }
        let rate = made / seconds;
        self.speed = if rate >= 1.0 {
            format!(", {rate:.1} a second")
        } else {
            format!(", {:.1} s each", 1.0 / rate)
        };
        if let Some(left) = total.map(|total| total.saturating_sub(done)).filter(|&left| left > 0) {
            self.speed += &format!(", {} left", duration(left as f64 / rate));
        }
    }
}

impl Bar {
    /// Shows how far the work `what` has come; another `what` starts at zero.
    pub(crate) fn update(&mut self, what: &'static str, done: u64, total: Option<u64>) {
        if self.work.what != what {
            self.work = Work { what, ..Work::default() };
            self.line.reset();
            self.tenth = 0;
        }
        if let Some(listener) = &self.listener {
            listener(Message::Progress { what: what.to_owned(), done, total });
        }
        self.work.measure(done, total);
        let speed = self.work.speed.clone();
        self.line.set_message(format!("{what}{speed}"));
        if let Some(total) = total {
            self.line.set_length(total);
        }
        self.line.set_position(done);
        let tenth = total.map_or(done / 100, |total| 10 * done / total.max(1));
        if tenth > self.tenth {
            self.tenth = tenth;
            let total = total.map_or("?".to_owned(), |total| total.to_string());
            tracing::info!("{what}: {done}/{total} frames{speed}");
        }
    }

    /// Shows what is done for the next frames of the work.
    pub(crate) fn stage(&self, progress: Progress) {
        let Progress { stage, done, total } = progress;
        let Work { what, speed, .. } = &self.work;
        self.line.set_message(format!("{what}{speed}: {stage} {done}/{total}"));
        if done == 0 {
            tracing::info!("{stage} of {total}");
        }
    }

    /// Shows the progress of training, with figures in `words`.
    pub(crate) fn learning(&mut self, words: String, done: u64, total: u64) {
        if let Some(listener) = &self.listener {
            listener(Message::Progress { what: words.clone(), done, total: Some(total) });
        }
        self.line.set_length(total);
        self.line.set_position(done);
        let percent = 100 * done / total.max(1);
        if percent > self.tenth {
            self.tenth = percent;
            tracing::info!("step {done}/{total}: {words}");
        }
        self.line.set_message(words);
    }

    /// Prints a remark above the bar.
    pub(crate) fn above(&self, text: &str, report: &Report) {
        self.line.suspend(|| report.remark(text));
    }

    /// Warns above the bar.
    pub(crate) fn warning(&self, text: &str, report: &Report) {
        self.line.suspend(|| report.warning(text));
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.line.finish_and_clear();
    }
}
