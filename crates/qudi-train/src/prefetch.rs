//! Batches drawn ahead on threads of their own.

use super::burst_cache::BurstSampler;
use super::learner::Learner;
use super::recipe::Recipe;
use qudi_core::{Error, Result};
use std::sync::mpsc::{Receiver, sync_channel};

/// The number of batches that a thread keeps ready.
const READY_BATCHES: usize = 2;

/// Gives the batches of a network in order; they do not depend on the number of threads.
#[derive(Debug)]
pub struct Prefetcher<L: Learner> {
    workers: Vec<Receiver<Result<L::Batch>>>,
    next: u64,
}

impl<L: Learner> Prefetcher<L> {
    /// Starts `workers` threads that draw batches from number `first` on.
    ///
    /// # Errors
    /// [`Error`] if a thread cannot be started.
    pub fn new(recipe: &Recipe, bursts: &BurstSampler, first: u64, workers: usize) -> Result<Self> {
        let count = workers.max(1) as u64;
        let start = |worker: u64| {
            let (sender, receiver) = sync_channel(READY_BATCHES);
            let (recipe, mut bursts) = (recipe.clone(), bursts.clone());
            let work = move || {
                // Every thread draws each `count`-th batch, until nobody listens.
                let mut number = first + worker;
                while sender.send(L::draw(&recipe, &mut bursts, number)).is_ok() {
                    number += count;
                }
            };
            std::thread::Builder::new().name(format!("prefetch-{worker}")).spawn(work).map_err(
                |e| Error::request(format!("no thread for the data: {e}"), "workers", "use fewer"),
            )?;
            Ok(receiver)
        };
        let workers = (0..count).map(start).collect::<Result<_>>()?;
        Ok(Self { workers, next: 0 })
    }

    /// Waits for the next batch.
    ///
    /// # Errors
    /// [`Error`] if it could not be drawn.
    pub fn next_batch(&mut self) -> Result<L::Batch> {
        let at = (self.next % self.workers.len() as u64) as usize;
        self.next += 1;
        self.workers[at].recv().unwrap_or_else(|_| {
            Err(Error::request("a data thread has stopped", "the data", "report this"))
        })
    }
}
