//! `qudi`: simulate, restore and measure video from single-photon cameras.

mod args;
mod capture;
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
use error::CliError;
use qudi_model::MatrixUnits;
use std::process::ExitCode;

/// See [`memory::keep_freed_pages`].
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    memory::keep_freed_pages();
    #[cfg(any(feature = "wgpu", feature = "vulkan"))]
    device::quieten_drivers();
    if let Err(error) = check_arguments() {
        return report::Report::plain().error(&error);
    }
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(refusal) => match CliError::of_value(&refusal) {
            Some(error) => return report::Report::plain().error(&error),
            None => refusal.exit(),
        },
    };
    let report = report::Report::new(&args.global);
    match run(&args, &report) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => report.error(&error),
    }
}

/// Names that are no text could not be written into records.
fn check_arguments() -> error::Result<()> {
    match std::env::args_os().find(|argument| argument.to_str().is_none()) {
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
        Command::Bench(bench) => commands::bench::run::run(bench, &args.global, report),
        Command::Selftest(selftest) => commands::selftest::run::run(selftest, report),
        Command::Convert(convert) => commands::convert::run::run(convert, &args.global, report),
        Command::Calibrate(calibrate) => {
            commands::calibrate::run::run(calibrate, &settings, &args.global, report)
        }
        Command::Demo(demo) => commands::demo::run::run(demo, &settings, &args.global, report),
        Command::Light(light) => commands::light::run::run(light, &settings, report),
        Command::Info(info) => commands::info::run::run(info, &settings, &args.global, report),
        Command::Look(look) => commands::look::run::run(look, &settings, &args.global, report),
        Command::Config(config) => commands::config::run::run(config, &settings, report),
        Command::Completions(completions) => commands::completions::run::run(completions),
        Command::Man(man) => commands::completions::run::man(man),
    }
}
