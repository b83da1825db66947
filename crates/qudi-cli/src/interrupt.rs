//! Ctrl-C: the first asks the running command to stop and clean up, the second quits at once.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};

static STOP_REQUEST: AtomicBool = AtomicBool::new(false);

/// Exit code of an interrupted command.
pub(crate) const EXIT_CODE: u8 = 130;

pub(crate) fn install() {
    let installed = ctrlc::set_handler(|| {
        if STOP_REQUEST.swap(true, Ordering::Relaxed) {
            std::process::exit(i32::from(EXIT_CODE));
        }
    });
    if let Err(e) = installed {
        tracing::warn!("Ctrl-C will not clean up: {e}");
    }
}

/// Breaks once Ctrl-C has been pressed.
pub(crate) fn check() -> ControlFlow<()> {
    if STOP_REQUEST.load(Ordering::Relaxed) {
        ControlFlow::Break(())
    } else {
        ControlFlow::Continue(())
    }
}
