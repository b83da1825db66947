//! Requests to stop: Ctrl-C, the first of which asks the running command to stop and clean up and the second
//! quits at once; or a flag of the program that runs a command on one of its threads.

use std::cell::RefCell;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

static STOP_REQUEST: AtomicBool = AtomicBool::new(false);

thread_local! {
    static THREAD_REQUEST: RefCell<Option<Arc<AtomicBool>>> = const { RefCell::new(None) };
}

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

/// Runs `run`, which stops at its next check once `stop` is set.
pub(crate) fn stoppable<T>(stop: &Arc<AtomicBool>, run: impl FnOnce() -> T) -> T {
    let before = THREAD_REQUEST.replace(Some(stop.clone()));
    let result = run();
    THREAD_REQUEST.set(before);
    result
}

/// Breaks once Ctrl-C has been pressed, or this thread was asked to stop.
pub(crate) fn check() -> ControlFlow<()> {
    let asked = |flag: &AtomicBool| flag.load(Ordering::Relaxed);
    let thread = || THREAD_REQUEST.with_borrow(|flag| flag.as_deref().is_some_and(asked));
    if asked(&STOP_REQUEST) || thread() {
        ControlFlow::Break(())
    } else {
        ControlFlow::Continue(())
    }
}
