//! `qudi`: simulate, restore and measure video from single-photon cameras.

mod args;
mod cmd;
mod device;
mod error;
mod fields;
mod interrupt;
mod memory;
mod places;
#[cfg(feature = "remote")]
mod remote;
mod report;
mod settings;
mod weights;

use args::{Args, Command};
use clap::Parser;
use error::Fault;
use std::process::ExitCode;

/// See [`memory::keep_freed_pages`].
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    memory::keep_freed_pages();
    if let Err(fault) = check_arguments() {
        return report::Report::plain().fault(&fault);
    }
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(refusal) => match Fault::of_value(&refusal) {
            Some(fault) => return report::Report::plain().fault(&fault),
            None => refusal.exit(),
        },
    };
    let report = report::Report::new(&args.global);
    match run(&args, &report) {
        Ok(()) => ExitCode::SUCCESS,
        Err(fault) => report.fault(&fault),
    }
}

/// Names that are no text could not be written into records.
fn check_arguments() -> error::Result<()> {
    match std::env::args_os().find(|argument| argument.to_str().is_none()) {
        None => Ok(()),
        Some(argument) => Err(Fault::new(
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
    // Loaded for every command, so that none ignores what it was told.
    let settings = settings::Settings::load(&args.global, args.command.name())?;
    match &args.command {
        Command::Simulate(simulate) => cmd::simulate::run(simulate, settings, &args.global, report),
        Command::Restore(restore) => cmd::restore::run(restore, &settings, &args.global, report),
        Command::Train(train) => cmd::train::run(train, &settings, &args.global, report),
        Command::Publish(publish) => cmd::publish::run(publish, &args.global, report),
        Command::Eval(eval) => cmd::eval::run(eval, &settings, &args.global, report),
        Command::Bench(bench) => cmd::bench::run(bench, &args.global, report),
        Command::Selftest(selftest) => cmd::selftest::run(selftest, report),
        #[cfg(feature = "remote")]
        Command::Serve(serve) => cmd::serve::run(serve, report),
        Command::Convert(convert) => cmd::convert::run(convert, &args.global, report),
        Command::Calibrate(calibrate) => {
            cmd::calibrate::run(calibrate, &settings, &args.global, report)
        }
        Command::Demo(demo) => cmd::demo::run(demo, &settings, &args.global, report),
        Command::Light(light) => cmd::light::run(light, &settings, report),
        Command::Info(info) => cmd::info::run(info, &settings, &args.global, report),
        Command::Config(config) => cmd::config::run(config, &settings, report),
        Command::Completions(completions) => cmd::completions::run(completions),
        Command::Man(man) => cmd::completions::man(man),
    }
}
