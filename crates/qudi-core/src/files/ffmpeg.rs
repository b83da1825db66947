//! The program that reads and writes videos.

use std::process::Command;

/// Returns the command `ffmpeg`, shielded from Ctrl-C at the terminal: this program ends it.
pub fn ffmpeg() -> Command {
    #[allow(unused_mut)] // process groups are Unix's
    let mut command = Command::new("ffmpeg");
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    command
}
