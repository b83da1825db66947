//! `qudi completions` and `qudi man`, both made from the command line's definition.

use super::args::{Completions, Man};
use crate::args::Args;
use crate::error::{CliError, Result};
use crate::report::print;
use clap::{CommandFactory, ValueEnum};
use clap_complete::Shell;

pub(crate) fn run(completions: &Completions) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(completions.shell, &mut Args::command(), "qudi", &mut script);
    print(&String::from_utf8_lossy(&script))
}

pub(crate) fn man(man: &Man) -> Result<()> {
    let write = |e: std::io::Error| {
        CliError::new(format!("cannot write the manual: {e}"), "man", "check the folder")
    };
    if let Some(folder) = &man.folder {
        let scripts = folder.join("completions");
        std::fs::create_dir_all(&scripts).map_err(write)?;
        for shell in Shell::value_variants() {
            clap_complete::generate_to(*shell, &mut Args::command(), "qudi", &scripts)
                .map_err(write)?;
        }
        return clap_mangen::generate_to(Args::command(), folder).map_err(write);
    }
    let mut page = Vec::new();
    clap_mangen::Man::new(Args::command()).render(&mut page).map_err(write)?;
    print(&String::from_utf8_lossy(&page))
}
