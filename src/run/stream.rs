//! The pipeline: readers fill bricks in order, rayon workers compute them (one brick, one thread), writers store what
//! comes out; bounded channels between, one gate for bytes, the first error stops the rest.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use crossbeam_channel::RecvTimeoutError;

use super::budget::{Budget, Permit};
use super::cancel::Cancel;
use super::compute::{Finished, evaluate};
use super::metrics::Metrics;
use super::read::{Loaded, Reader};
use super::trace::Trace;
use crate::brick::Scratch;
use crate::grid::Region;
use crate::{Error, Result};

/// Between two looks at the memory that is held; each takes 10 us.
const SAMPLED_EVERY: Duration = Duration::from_millis(10);

/// One brick to do: its box and the caller's number for it (a task slot).
#[derive(Debug, Clone, Copy)]
pub struct Work {
    pub brick: Region,
    pub slot: usize,
}

/// What becomes of the bricks of a stream.
pub struct Stations<'a, W> {
    /// Turns a finished brick into what is to be written (called on workers).
    pub deliver: &'a (dyn Fn(&Finished, Work, &mut Scratch) -> Result<W> + Sync),
    /// Writes it (called on writers).
    pub write: &'a (dyn Fn(Work, W) -> Result<()> + Sync),
    /// Told after each brick.
    pub tick: &'a (dyn Fn() + Sync),
}

/// What a stream of bricks needs.
pub struct Stream<'a, W> {
    pub reader: &'a Reader<'a>,
    pub work: &'a [Work],
    /// Bytes of one whole brick, and of all that may be alive.
    pub brick_bytes: u64,
    pub budget: u64,
    pub brick_voxels: u64,
    pub threads: usize,
    pub pool: &'a rayon::ThreadPool,
    pub metrics: &'a Metrics,
    pub trace: &'a Trace,
    pub cancel: &'a Cancel,
    pub stations: &'a Stations<'a, W>,
}

/// The first error; later ones are consequences.
#[derive(Default)]
struct FirstError {
    stop: AtomicBool,
    error: Mutex<Option<Error>>,
}

impl FirstError {
    fn set(&self, error: Error) {
        self.error.lock().unwrap_or_else(|e| e.into_inner()).get_or_insert(error);
        self.stop.store(true, Ordering::Release);
    }

    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Acquire)
    }
}

/// The next brick, handed out in order.
struct Queue<'a> {
    next: Mutex<usize>,
    work: &'a [Work],
}

impl<W: Send> Stream<'_, W> {
    /// Runs every brick, or until the first error or a cancel; what was started is finished either way.
    pub fn run(&self) -> Result<()> {
        let readers = (self.threads / 2).max(1);
        let first = FirstError::default();
        let budget = Budget::new(self.budget);
        let queue = Queue { next: Mutex::new(0), work: self.work };
        // As many as the plan counts: scratch stays allocated between bricks.
        let at_once = (self.budget / self.brick_bytes.max(1)).clamp(1, self.threads as u64);
        let scratches = || (0..at_once).map(|_| Mutex::new(Scratch::new())).collect::<Vec<_>>();
        let (of_readers, of_workers) = (scratches(), scratches());
        let (to_compute, ready) = crossbeam_channel::bounded::<(Work, Loaded, Permit)>(self.threads);
        let (to_write, finished) = crossbeam_channel::bounded::<(Work, W, Permit)>(self.threads + 1);
        std::thread::scope(|scope| {
            for reader in 0..readers {
                let to_compute = to_compute.clone();
                let (queue, budget, first, scratches) = (&queue, &budget, &first, &of_readers);
                scope.spawn(move || self.read_loop(queue, budget, first, scratches, reader, to_compute));
            }
            for _ in 0..2 {
                let finished = finished.clone();
                scope.spawn(|| self.write_loop(&first, finished));
            }
            drop((to_compute, finished));
            // Until its channel closes, whatever ends the work: a large chunk is decoded between two bricks.
            let (working, done) = crossbeam_channel::bounded::<()>(0);
            scope.spawn(move || {
                while done.recv_timeout(SAMPLED_EVERY) == Err(RecvTimeoutError::Timeout) {
                    self.metrics.sample_memory();
                }
            });
            let (first, scratches, to_write) = (&first, &of_workers, to_write);
            self.pool.in_place_scope(|workers| {
                for (work, loaded, permit) in ready {
                    let to_write = to_write.clone();
                    workers.spawn(move |_| self.compute(work, loaded, permit, first, scratches, &to_write));
                }
            });
            drop(working);
        });
        match first.error.into_inner().unwrap_or_else(|e| e.into_inner()) {
            Some(error) => Err(error),
            None => self.cancel.check(),
        }
    }

    fn read_loop(
        &self,
        queue: &Queue,
        budget: &Arc<Budget>,
        first: &FirstError,
        scratches: &[Mutex<Scratch>],
        reader: usize,
        out: crossbeam_channel::Sender<(Work, Loaded, Permit)>,
    ) {
        loop {
            // Bytes are taken under the lock, so that bricks start in order.
            let mut next = queue.next.lock().unwrap_or_else(|e| e.into_inner());
            let Some(&work) = queue.work.get(*next) else { return };
            if first.stopped() || self.cancel.is_cancelled() {
                return;
            }
            let place = *next as u32;
            *next += 1;
            let share = work.brick.voxels() as u128 * self.brick_bytes as u128 / u128::from(self.brick_voxels.max(1));
            let bytes = u64::try_from(share).unwrap_or(u64::MAX).min(self.brick_bytes);
            // A brick cut by the volume's edge still has whole halos: count at least half.
            let (permit, waited) = budget.acquire(bytes.max(self.brick_bytes / 2));
            drop(next);
            self.metrics.waited("budget", waited);
            let start = Instant::now();
            let read = guarded(|| self.reader.read(work.brick, place, &mut free(scratches, reader)));
            self.trace.span("read", start, &[("brick", format!("{:?}", work.brick))]);
            match read {
                Ok(loaded) => {
                    let start = Instant::now();
                    if out.send((work, loaded, permit)).is_err() {
                        return;
                    }
                    self.metrics.waited("workers_busy", start.elapsed().as_secs_f64());
                }
                Err(error) => {
                    first.set(error);
                    return;
                }
            }
        }
    }

    fn compute(
        &self,
        work: Work,
        loaded: Loaded,
        permit: Permit,
        first: &FirstError,
        scratches: &[Mutex<Scratch>],
        out: &crossbeam_channel::Sender<(Work, W, Permit)>,
    ) {
        if first.stopped() {
            return;
        }
        let worker = rayon::current_thread_index().unwrap_or(0);
        let _span = tracing::debug_span!("brick", region = ?work.brick, worker).entered();
        let mut scratch = free(scratches, worker);
        let result = guarded(|| {
            let engine = self.reader.engine;
            let done = evaluate(self.reader, loaded, &mut scratch, self.trace)?;
            let start = Instant::now();
            let written = (self.stations.deliver)(&done, work, &mut scratch);
            self.metrics.encode_ns.fetch_add(start.elapsed().as_nanos() as u64, Ordering::Relaxed);
            // The brick and what became of it: the most that it holds.
            self.metrics.sample_memory();
            self.trace.span("levels+encode", start, &[("brick", format!("{:?}", work.brick))]);
            done.ready.into_iter().flat_map(|r| r.levels).for_each(|v| engine.pool.put(v));
            for value in done.values.into_iter().flatten() {
                value.recycle(engine.pool);
            }
            written
        });
        drop(scratch);
        match result {
            Ok(written) => {
                let start = Instant::now();
                // Writers outlive the workers, so this fails only while stopping.
                let _ = out.send((work, written, permit));
                self.metrics.waited("writers_busy", start.elapsed().as_secs_f64());
            }
            Err(error) => first.set(error),
        }
    }

    fn write_loop(&self, first: &FirstError, finished: crossbeam_channel::Receiver<(Work, W, Permit)>) {
        for (work, written, permit) in finished {
            if first.stopped() {
                continue;
            }
            let start = Instant::now();
            match guarded(|| (self.stations.write)(work, written)) {
                Ok(()) => self.metrics.brick_done(work.brick.voxels() as u64),
                Err(error) => first.set(error),
            }
            self.trace.span("write", start, &[("brick", format!("{:?}", work.brick))]);
            drop(permit);
            (self.stations.tick)();
        }
    }
}

/// A scratch that nobody uses, or a thread's own once it is free: of more threads than bricks may be alive some wait.
fn free(scratches: &[Mutex<Scratch>], thread: usize) -> MutexGuard<'_, Scratch> {
    let mine = || scratches[thread % scratches.len()].lock().unwrap_or_else(|e| e.into_inner());
    scratches.iter().find_map(|s| s.try_lock().ok()).unwrap_or_else(mine)
}

/// A bug in a kernel must end the run with an error, not take the process and its journal down.
fn guarded<T>(f: impl FnOnce() -> Result<T>) -> Result<T> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(f)).unwrap_or_else(|cause| {
        let text = cause.downcast_ref::<String>().cloned();
        let text = text.or_else(|| cause.downcast_ref::<&str>().map(|s| s.to_string())).unwrap_or_default();
        Err(Error::Failed(format!("internal error, please report it: {text}")))
    })
}
