//! The program `qudi`, see [`qudi_cli::main`].

use std::ffi::OsString;
use std::process::ExitCode;

/// See [`qudi_cli::keep_freed_pages`].
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    qudi_cli::keep_freed_pages();
    qudi_cli::main(&std::env::args_os().collect::<Vec<OsString>>())
}
