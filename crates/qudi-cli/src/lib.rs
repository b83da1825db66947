//! The program `qudi`: simulate, restore and measure video from single-photon cameras.
//!
//! [`main`] is the whole program. Other programs [`call`] a command, [`restore`] what they hold, [`open`] a
//! capture and [`write_frames`].
#![warn(missing_docs)]

mod args;
mod calls;
mod capture;
mod colour;
mod commands;
mod device;
mod error;
mod interrupt;
mod memory;
mod methods;
mod places;
mod report;
mod settings;
mod version;
mod weights;

use args::{Args, Command};
use clap::Parser;
use qudi_model::MatrixUnits;
use std::ffi::OsString;

pub use calls::{call, methods, open, restore, sensor, write_frames};
pub use capture::Input;
pub use commands::restore::caller::Receiver;
pub use error::{Cause, CliError};
pub use memory::keep_freed_pages;
pub use report::{Listener, Message};
pub use version::long as version;

/// Runs the program with the arguments of a process, of which the first is the program's own name, and
/// returns its exit code. Call [`keep_freed_pages`] first where mimalloc is the allocator.
pub fn main(arguments: &[OsString]) -> u8 {
    #[cfg(any(feature = "wgpu", feature = "vulkan"))]
    device::quieten_drivers();
    if let Err(error) = check_arguments(arguments) {
        return report::Report::plain().error(&error);
    }
    let args = match Args::try_parse_from(arguments) {
        Ok(args) => args,
        Err(refusal) => match CliError::of_value(&refusal) {
            Some(error) => return report::Report::plain().error(&error),
            None => return refused(&refusal),
        },
    };
    let report = report::Report::new(&args.global);
    match run(&args, &report) {
        Ok(()) => 0,
        Err(error) => report.error(&error),
    }
}

/// Prints help, version, or what is wrong with the arguments, as clap words it.
fn refused(refusal: &clap::Error) -> u8 {
    // Nothing can be done if standard output is gone.
    let _ = refusal.print();
    u8::try_from(refusal.exit_code()).unwrap_or(1)
}

/// Refuses names that are no text: they could not be written into records.
fn check_arguments(arguments: &[OsString]) -> error::Result<()> {
    match arguments.iter().find(|argument| argument.to_str().is_none()) {
        None => Ok(()),
        Some(argument) => Err(CliError::new(
            "an argument is not UTF-8, so no record could name it",
            argument.display(),
            "rename the file or folder",
        )),
    }
}

fn run(args: &Args, report: &report::Report) -> error::Result<()> {
    interrupt::install();
    if let Some(threads) = args.global.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    }
    run_command(args, report)
}

/// Runs the command of `args` on this thread.
fn run_command(args: &Args, report: &report::Report) -> error::Result<()> {
    MatrixUnits::chosen()?;
    // Loaded for every command, so that none ignores what is set.
    let settings = settings::Settings::load(&args.global, args.command.name())?;
    places::check(&args.command, &settings, &args.global)?;
    match &args.command {
        Command::Simulate(simulate) => {
            commands::simulate::run::run(simulate, settings, &args.global, report)
        }
        Command::Restore(restore) => {
            commands::restore::run::run(restore, &settings, &args.global, report)
        }
        Command::Train(train) => commands::train::run::run(train, &settings, &args.global, report),
        Command::Publish(publish) => commands::publish::run::run(publish, &args.global, report),
        Command::Eval(eval) => commands::eval::run::run(eval, &settings, &args.global, report),
        Command::Bench(bench) => commands::bench::run::run(bench, &settings, report),
        Command::Selftest(selftest) => commands::selftest::run::run(selftest, report),
        Command::Convert(convert) => commands::convert::run::run(convert, &args.global, report),
        Command::Calibrate(calibrate) => {
            commands::calibrate::run::run(calibrate, &settings, &args.global, report)
        }
        Command::Demo(demo) => commands::demo::run::run(demo, &settings, &args.global, report),
        Command::Light(light) => commands::light::run::run(light, &settings, report),
        Command::Info(info) => commands::info::run::run(info, &settings, &args.global, report),
        Command::Look(look) => commands::look::run::run(look, &settings, &args.global, report),
        Command::View(view) => commands::view::run::run(view, &settings, &args.global, report),
        Command::Config(config) => commands::config::run::run(config, &settings, report),
        Command::Completions(completions) => commands::completions::run::run(completions),
        Command::Man(man) => commands::completions::run::man(man),
    }
}
