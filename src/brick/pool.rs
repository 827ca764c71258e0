//! Recycled voxel buffers. Touching fresh pages costs several times the copy that fills them, so a buffer that is done
//! with goes back to the pool and the next brick takes it as it is.

use std::sync::{Mutex, MutexGuard};

use super::Voxels;
use crate::grid::DType;

/// Buffers waiting to be used again. Shared by the threads of one run.
#[derive(Default)]
pub struct Pool {
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// The longest waiting first.
    free: Vec<Voxels>,
    /// Bytes of `free`.
    waiting: usize,
    /// Bytes that were taken and did not come back.
    lent: usize,
    /// Bytes that may be lent and wait together; `None` before anyone said.
    bound: Option<usize>,
}

impl State {
    /// Frees buffers, the longest waiting first, until those that wait leave room for `more` bytes or none is left.
    fn make_room(&mut self, more: usize) {
        let Some(bound) = self.bound else { return };
        self.keep_waiting(bound.saturating_sub(self.lent + more));
    }

    fn keep_waiting(&mut self, bytes: usize) {
        let mut gone = 0;
        while self.waiting > bytes {
            self.waiting -= self.free[gone].capacity_bytes();
            gone += 1;
        }
        self.free.drain(..gone);
    }
}

impl Pool {
    /// From now on, what is lent and what waits take at most `bytes` together, so far as that is up to what waits: bricks of
    /// several stages use buffers of many sizes, and kept for the next brick they would come on top of what the bricks that
    /// are alive may hold.
    pub fn bound(&self, bytes: usize) {
        let mut state = self.lock();
        state.bound = Some(bytes);
        state.make_room(0);
    }

    /// A buffer of `len` voxels with undefined contents (whatever it held before).
    pub fn take(&self, dtype: DType, len: usize) -> Voxels {
        let bytes = len * dtype.size();
        let mut state = self.lock();
        let fits = |v: &Voxels| v.dtype() == dtype && (bytes..=2 * bytes + 4096).contains(&v.capacity_bytes());
        let free = &state.free;
        let best = (0..free.len()).filter(|&i| fits(&free[i])).min_by_key(|&i| free[i].capacity_bytes());
        let found = best.map(|i| state.free.remove(i));
        match &found {
            Some(buffer) => {
                state.waiting -= buffer.capacity_bytes();
                state.lent += buffer.capacity_bytes();
            }
            None => {
                state.make_room(bytes);
                state.lent += bytes;
            }
        }
        drop(state);
        let mut buffer = found.unwrap_or_else(|| Voxels::zeroed(dtype, len));
        crate::with_voxels!(&mut buffer, v => v.resize(len, Default::default()));
        buffer
    }

    /// `len` numbers with undefined contents, for levels of a pyramid.
    pub fn take_numbers(&self, len: usize) -> Vec<f64> {
        match self.take(DType::F64, len) {
            Voxels::F64(numbers) => numbers,
            other => unreachable!("asked for f64, got {}", other.dtype()),
        }
    }

    /// Takes back what [`Pool::take_numbers`] gave.
    pub fn put_numbers(&self, numbers: Vec<f64>) {
        self.put(Voxels::F64(numbers));
    }

    /// Takes a buffer back.
    pub fn put(&self, buffer: Voxels) {
        let mut state = self.lock();
        let bytes = buffer.capacity_bytes();
        state.lent = state.lent.saturating_sub(bytes);
        state.waiting += bytes;
        state.free.push(buffer);
        state.make_room(0);
    }

    /// Whoever holds this buffer counts it from now on: it will not come back.
    pub fn part_with(&self, buffer: &Voxels) {
        let mut state = self.lock();
        state.lent = state.lent.saturating_sub(buffer.capacity_bytes());
    }

    /// Takes in a buffer that somebody else counted until now.
    pub fn adopt(&self, buffer: Voxels) {
        let mut state = self.lock();
        state.waiting += buffer.capacity_bytes();
        state.free.push(buffer);
        state.make_room(0);
    }

    /// Frees buffers, the longest waiting first, until at most `bytes` wait.
    pub fn trim(&self, bytes: usize) {
        self.lock().keep_waiting(bytes);
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(|e| e.into_inner())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes that wait and bytes that are lent.
    fn held(pool: &Pool) -> (usize, usize) {
        let state = pool.lock();
        assert_eq!(state.waiting, state.free.iter().map(Voxels::capacity_bytes).sum::<usize>());
        (state.waiting, state.lent)
    }

    #[test]
    fn buffers_are_used_again_unless_they_are_too_large() {
        let pool = Pool::default();
        let mut large = pool.take(DType::F32, 9000);
        large.fill(3.0);
        pool.put(large);
        assert!(pool.take(DType::U8, 30000).at(0) == 0.0, "another type");
        assert!(pool.take(DType::F32, 1000).at(0) == 0.0, "nine times too large");
        assert!(pool.take(DType::F32, 8000).at(0) == 3.0);
        pool.put_numbers(vec![5.0; 100]);
        assert_eq!(pool.take_numbers(60), vec![5.0; 60]);
    }

    #[test]
    fn what_waits_makes_room_for_what_is_taken() {
        let pool = Pool::default();
        pool.bound(100_000);
        let sizes = [40_000, 10_000, 30_000];
        let taken = sizes.map(|n| pool.take(DType::U8, n));
        taken.into_iter().for_each(|v| pool.put(v));
        assert_eq!(held(&pool), (80_000, 0));
        // None of them fits: the first that came back goes.
        let other = pool.take(DType::U16, 25_000);
        assert_eq!(held(&pool), (40_000, 50_000));
        // More than the bound is not refused, but then nothing waits.
        let more = pool.take(DType::U16, 30_000);
        assert_eq!(held(&pool), (0, 110_000));
        pool.put(more);
        assert_eq!(held(&pool), (0, 50_000), "what would break the bound is freed");
        pool.part_with(&other);
        assert_eq!(held(&pool), (0, 0));
        pool.adopt(other);
        assert_eq!(held(&pool), (50_000, 0), "lent to nobody");
        let other = pool.take(DType::U16, 25_000);
        pool.bound(10);
        pool.put(other);
        assert_eq!(held(&pool), (0, 0));
    }
}
