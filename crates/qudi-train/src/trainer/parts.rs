//! Parts of batches on threads of their own: most operations on a part are too small for several threads.

use super::{Pass, Trainer};
use crate::learner::Learner;
use crate::parameters::{parameters, with_parameters};
use qudi_core::{Error, Result};
use qudi_kernels::{add_operations, count_operations};
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

/// Parts of a batch, if it can be split into as many. The gradients depend on it in their last bits.
pub(super) const PARTS: usize = 4;

/// Pools of threads, each of which computes one part at a time.
#[derive(Debug, Default)]
pub(super) struct Workers(OnceLock<Vec<ThreadPool>>);

impl Workers {
    /// Returns the pools, which have all threads of the global one together.
    ///
    /// # Errors
    /// [`Error`] if a thread cannot be started.
    fn pools(&self) -> Result<&[ThreadPool]> {
        if let Some(pools) = self.0.get() {
            return Ok(pools);
        }
        let threads = rayon::current_num_threads();
        let count = threads.min(PARTS);
        let pool = |_| ThreadPoolBuilder::new().num_threads(threads.div_ceil(count)).build();
        let pools =
            (0..count).map(pool).collect::<std::result::Result<Vec<_>, _>>().map_err(|e| {
                Error::request(format!("no threads to learn: {e}"), "threads", "use fewer")
            })?;
        Ok(self.0.get_or_init(|| pools))
    }
}

impl<L: Learner> Trainer<L> {
    /// Computes the gradients of parts of batches, in their order, several at a time.
    pub(super) fn parallel_passes(&self, parts: &[L::Batch]) -> Result<Vec<Pass>> {
        let start = Instant::now();
        let weights = parameters(&self.network);
        let next = AtomicUsize::new(0);
        let pools = self.workers.pools()?;
        let pass = |part: &L::Batch| {
            // A graph of its own: threads that share one wait for each other.
            let network = with_parameters(self.network.clone(), weights.clone());
            self.pass(&network, part, 0)
        };
        let work = || -> Result<Vec<(usize, u64, Pass)>> {
            let mut passes = Vec::new();
            loop {
                let number = next.fetch_add(1, Ordering::Relaxed);
                let Some(part) = parts.get(number) else { return Ok(passes) };
                let (pass, operations) = count_operations(|| pass(part));
                passes.push((number, operations, pass?));
            }
        };
        let lists = std::thread::scope(|scope| {
            let handles = pools.iter().map(|pool| scope.spawn(move || pool.install(work)));
            let handles: Vec<_> = handles.collect();
            let failed = || Err(Error::request("a thread failed", "threads", "report this"));
            let lists =
                handles.into_iter().map(|handle| handle.join().unwrap_or_else(|_| failed()));
            lists.collect::<Result<Vec<_>>>()
        })?;
        let mut passes: Vec<_> = lists.into_iter().flatten().collect();
        passes.sort_by_key(|(number, ..)| *number);
        add_operations(passes.iter().map(|(_, operations, _)| operations).sum());
        let busy: f64 = passes.iter().map(|(.., pass)| pass.forward_s + pass.backward_s).sum();
        // Seconds on the clock, not of all threads.
        let share = start.elapsed().as_secs_f64() / busy;
        let passes = passes.into_iter().map(|(.., mut pass)| {
            pass.forward_s *= share;
            pass.backward_s *= share;
            pass
        });
        Ok(passes.collect())
    }
}
