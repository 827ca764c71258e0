//! Recycled voxel buffers. Touching fresh pages costs several times the copy that fills them, so a buffer that is done
//! with goes back to the pool and the next brick takes it as it is.

use std::sync::Mutex;

use super::Voxels;
use crate::grid::DType;

/// Buffers waiting to be used again. Shared by the threads of one run.
#[derive(Default)]
pub struct Pool {
    free: Mutex<Vec<Voxels>>,
}

impl Pool {
    /// A buffer of `len` voxels with undefined contents (whatever it held before).
    pub fn take(&self, dtype: DType, len: usize) -> Voxels {
        let mut free = self.free.lock().unwrap_or_else(|e| e.into_inner());
        let fits = |v: &Voxels| v.dtype() == dtype && v.capacity_bytes() >= len * dtype.size();
        let best = (0..free.len()).filter(|&i| fits(&free[i])).min_by_key(|&i| free[i].capacity_bytes());
        let found =
            best.filter(|&i| free[i].capacity_bytes() <= 2 * len * dtype.size() + 4096).map(|i| free.swap_remove(i));
        drop(free);
        let mut buffer = found.unwrap_or_else(|| Voxels::zeroed(dtype, len));
        crate::with_voxels!(&mut buffer, v => v.resize(len, Default::default()));
        buffer
    }

    /// Takes a buffer back.
    pub fn put(&self, buffer: Voxels) {
        self.free.lock().unwrap_or_else(|e| e.into_inner()).push(buffer);
    }

    /// Frees buffers, largest first, until at most `bytes` wait.
    pub fn trim(&self, bytes: usize) {
        let mut free = self.free.lock().unwrap_or_else(|e| e.into_inner());
        free.sort_by_key(Voxels::capacity_bytes);
        while free.iter().map(Voxels::capacity_bytes).sum::<usize>() > bytes {
            free.pop();
        }
    }
}
