//! Batches drawn ahead on threads of their own.

use super::burst_cache::BurstSampler;
use super::learner::Learner;
use super::recipe::Recipe;
use burn::tensor::Device;
use qudi_core::{Error, Result};
use rayon::ThreadPoolBuilder;
use std::sync::mpsc::{Receiver, sync_channel};

/// The number of batches that a thread keeps ready.
const READY_BATCHES: usize = 2;

/// The largest number of threads that draw by default, with the thread that learns.
const DEFAULT_THREADS: usize = 16;

/// Returns the default number of threads that draw: one less than there are cores, at most 15.
pub fn default_workers() -> usize {
    std::thread::available_parallelism().map_or(2, usize::from).clamp(2, DEFAULT_THREADS) - 1
}

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
            let mut draw = move || {
                // Every thread draws each `count`-th batch, until nobody listens.
                let mut number = first + worker;
                while sender.send(L::draw(&recipe, &mut bursts, number)).is_ok() {
                    number += count;
                }
            };
            // Shares no work with the threads that learn, which are busy: frames are small.
            let pool = || ThreadPoolBuilder::new().num_threads(1).use_current_thread().build();
            let work = move || match pool() {
                Ok(pool) => pool.install(draw),
                Err(_) => draw(),
            };
            std::thread::Builder::new().name(format!("prefetch-{worker}")).spawn(work).map_err(
                |e| Error::request(format!("no thread for the data: {e}"), "workers", "use fewer"),
            )?;
            Ok(receiver)
        };
        let workers = (0..count).map(start).collect::<Result<_>>()?;
        Ok(Self { workers, next: 0 })
    }

    /// Copies the batches to `device` ahead of their use, on a thread of its own: a graphics card computes on
    /// meanwhile.
    ///
    /// # Errors
    /// [`Error`] if there is no thread for it.
    pub fn uploading(self, device: Device) -> Result<Self> {
        let (sender, receiver) = sync_channel(READY_BATCHES);
        let Self { workers, mut next } = self;
        let work = move || {
            loop {
                let batch = received(&workers, &mut next).map(|mut batch| {
                    L::upload(&mut batch, &device);
                    batch
                });
                if sender.send(batch).is_err() {
                    return;
                }
            }
        };
        std::thread::Builder::new().name("upload".to_owned()).spawn(work).map_err(|e| {
            Error::request(format!("no thread for the copies: {e}"), "workers", "use fewer")
        })?;
        Ok(Self { workers: vec![receiver], next: 0 })
    }

    /// Waits for the next batch.
    ///
    /// # Errors
    /// [`Error`] if it could not be drawn.
    pub fn next_batch(&mut self) -> Result<L::Batch> {
        received(&self.workers, &mut self.next)
    }
}

/// Waits for batch `next`, which the workers draw in turn.
fn received<B>(workers: &[Receiver<Result<B>>], next: &mut u64) -> Result<B> {
    let at = (*next % workers.len() as u64) as usize;
    *next += 1;
    workers[at].recv().unwrap_or_else(|_| {
        Err(Error::request("a data thread has stopped", "the data", "report this"))
    })
}
