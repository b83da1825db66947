//! The program that reads and writes videos.

use std::process::Command;

/// The command `ffmpeg`. Ctrl-C at the terminal does not reach it: it is for this program, which ends ffmpeg itself.
pub fn ffmpeg() -> Command {
    #[allow(unused_mut)] // process groups are Unix's
    let mut command = Command::new("ffmpeg");
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    command
}
