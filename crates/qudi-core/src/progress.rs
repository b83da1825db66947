//! Progress of a method within a window.
//!
//! Methods report their progress to the observer of their thread, which may stop them.

use crate::{Error, Result};
use std::cell::RefCell;
use std::ops::ControlFlow;
use std::rc::Rc;

/// Progress of one stage of the work on a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Name of the stage.
    pub stage: &'static str,
    /// Frames or steps that are done.
    pub done: usize,
    /// Frames or steps in all.
    pub total: usize,
}

/// Function that receives progress and decides whether to continue.
pub type Observer = Rc<dyn Fn(Progress) -> ControlFlow<()>>;

thread_local! {
    static OBSERVER: RefCell<Option<Observer>> = const { RefCell::new(None) };
}

/// Guard that restores the previous observer, also after a panic.
struct Previous(Option<Observer>);

impl Drop for Previous {
    fn drop(&mut self) {
        OBSERVER.set(self.0.take());
    }
}

/// Runs `run`; `observer` receives the progress of methods that run on this thread.
pub fn observed<T>(observer: Observer, run: impl FnOnce() -> T) -> T {
    let _previous = Previous(OBSERVER.replace(Some(observer)));
    run()
}

/// Reports that `done` of `total` frames or steps of a stage are done.
///
/// # Errors
/// [`Error::Interrupted`] if the observer stops the method.
pub fn progress(stage: &'static str, done: usize, total: usize) -> Result<()> {
    let observer = OBSERVER.with_borrow(Clone::clone);
    match observer.map(|observer| observer(Progress { stage, done, total })) {
        Some(ControlFlow::Break(())) => Err(Error::Interrupted),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn observers_hear_stop_and_end() {
        let heard = Rc::new(RefCell::new(Vec::new()));
        let list = heard.clone();
        let observer: Observer = Rc::new(move |progress| {
            list.borrow_mut().push(progress);
            if progress.done < 2 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        });
        let run = || (0..5).try_for_each(|done| progress("counting", done, 5));
        assert!(matches!(observed(observer, run), Err(Error::Interrupted)));
        let expected = [0, 1, 2].map(|done| Progress { stage: "counting", done, total: 5 });
        assert_eq!(*heard.borrow(), expected);
        assert!(run().is_ok());
        assert_eq!(heard.borrow().len(), 3);
    }
}
