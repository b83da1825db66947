//! What a method is doing while it restores a window, for those who wait for it.
//!
//! Methods tell how far they have come; whoever called them on this thread hears it and may stop them.

use crate::{Error, Result};
use std::cell::RefCell;
use std::ops::ControlFlow;
use std::rc::Rc;

/// How far a part of the work on a window has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// What is done now.
    pub stage: &'static str,
    /// Frames or steps of it that are done.
    pub done: usize,
    /// All of them.
    pub total: usize,
}

/// Hears of progress and says whether to go on.
pub type Observer = Rc<dyn Fn(Progress) -> ControlFlow<()>>;

thread_local! {
    static OBSERVER: RefCell<Option<Observer>> = const { RefCell::new(None) };
}

/// Puts the observer before back, also after a panic.
struct Before(Option<Observer>);

impl Drop for Before {
    fn drop(&mut self) {
        OBSERVER.set(self.0.take());
    }
}

/// Runs `run`; `observer` hears of the progress of methods that run on this thread.
pub fn observed<T>(observer: Observer, run: impl FnOnce() -> T) -> T {
    let _before = Before(OBSERVER.replace(Some(observer)));
    run()
}

/// Tells that `done` of `total` frames or steps of a stage are done.
///
/// # Errors
/// [`Error::Interrupted`] if whoever hears it wants the method to stop.
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
