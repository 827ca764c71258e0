//! The one gate for bytes. A brick reserves what its whole life takes before it starts; one brick is always admitted, so
//! that nothing can wait for ever.

use std::sync::{Arc, Condvar, Mutex};
use std::time::Instant;

/// Bytes that bricks may hold together.
#[derive(Debug)]
pub struct Budget {
    limit: u64,
    used: Mutex<u64>,
    freed: Condvar,
}

/// Bytes held; given back on drop.
#[derive(Debug)]
pub struct Permit {
    budget: Arc<Budget>,
    bytes: u64,
}

impl Budget {
    pub fn new(limit: u64) -> Arc<Budget> {
        Arc::new(Budget { limit, used: Mutex::new(0), freed: Condvar::new() })
    }

    /// Waits until `bytes` fit (or nothing else is held). Returns the permit and the seconds waited.
    pub fn acquire(self: &Arc<Budget>, bytes: u64) -> (Permit, f64) {
        let start = Instant::now();
        let mut used = self.used.lock().unwrap_or_else(|e| e.into_inner());
        while *used > 0 && *used + bytes > self.limit {
            used = self.freed.wait(used).unwrap_or_else(|e| e.into_inner());
        }
        *used += bytes;
        (Permit { budget: self.clone(), bytes }, start.elapsed().as_secs_f64())
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        *self.budget.used.lock().unwrap_or_else(|e| e.into_inner()) -= self.bytes;
        self.budget.freed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_brick_is_always_admitted_and_the_next_waits_for_it() {
        let budget = Budget::new(10);
        let (large, _) = budget.acquire(100);
        let other = budget.clone();
        let waiter = std::thread::spawn(move || other.acquire(5).1);
        std::thread::sleep(std::time::Duration::from_millis(30));
        assert!(!waiter.is_finished());
        drop(large);
        assert!(waiter.join().unwrap() > 0.0);
        assert_eq!(*budget.used.lock().unwrap(), 0);
    }
}
