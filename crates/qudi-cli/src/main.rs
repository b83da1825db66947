//! `qudi`: simulate, restore and measure video from single-photon cameras.

mod args;
mod cmd;
mod device;
mod error;
mod interrupt;
mod keys;
mod report;
mod settings;

use args::{Args, Command};
use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    let args = Args::parse();
    let report = report::Report::new(&args.global);
    match run(&args, &report) {
        Ok(()) => ExitCode::SUCCESS,
        Err(fault) => report.fault(&fault),
    }
}

fn run(args: &Args, report: &report::Report) -> error::Result<()> {
    interrupt::install();
    if let Some(threads) = args.global.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads.get()).build_global()?;
    }
    match &args.command {
        Command::Simulate(simulate) => cmd::simulate::run(simulate, &args.global, report),
        Command::Demo(demo) => cmd::demo::run(demo, &args.global, report),
        Command::Light(light) => cmd::light::run(light, &args.global, report),
        Command::Info(info) => cmd::info::run(info, report),
        Command::Config(config) => cmd::config::run(config, &args.global, report),
        Command::Completions(completions) => cmd::completions::run(completions),
        Command::Man(man) => cmd::completions::man(man),
    }
}
