//! Working memory of one worker: grows to what the largest kernel asked for and is then reused.

/// A grow-only, 64-byte-aligned arena. A kernel takes all that it needs in one call.
#[derive(Default)]
pub struct Scratch {
    words: Vec<Line>,
}

#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

impl Scratch {
    pub fn new() -> Scratch {
        Scratch::default()
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.words.capacity() * size_of::<Line>()
    }

    /// At least `bytes` bytes, aligned to 64, contents undefined (left over from the last use).
    pub fn take(&mut self, bytes: usize) -> &mut [u8] {
        let lines = bytes.div_ceil(64);
        if self.words.len() < lines {
            self.words = Vec::new(); // freed first: the old contents are not wanted
            self.words.reserve_exact(lines);
            ask_for_huge_pages(self.words.spare_capacity_mut());
            self.words.resize(lines, Line([0; 64]));
        }
        bytemuck::cast_slice_mut(&mut self.words[..lines])
    }
}

/// Cuts `len` elements of `T` off the front of a scratch slice, aligned to 64 bytes, and returns them with the rest.
/// Panics if the slice is too short: ask [`Scratch::take`] for the sum of [`padded`] sizes.
pub fn cut<T: bytemuck::Pod>(bytes: &mut [u8], len: usize) -> (&mut [T], &mut [u8]) {
    let (head, tail) = bytes.split_at_mut(padded::<T>(len));
    assert_eq!(head.as_ptr() as usize % 64, 0, "scratch is aligned to 64 bytes");
    (bytemuck::cast_slice_mut(&mut head[..len * size_of::<T>()]), tail)
}

/// Bytes that [`cut`] takes for `len` elements.
pub const fn padded<T>(len: usize) -> usize {
    (len * size_of::<T>()).div_ceil(64) * 64
}

/// Asks for huge pages under memory that was not touched yet: lines of a volume cross a page per plane, and fewer pages
/// are also faster to get.
fn ask_for_huge_pages<T>(memory: &mut [T]) {
    #[cfg(target_os = "linux")]
    {
        const HUGE: usize = 2 << 20;
        let from = (memory.as_ptr() as usize).next_multiple_of(HUGE);
        let to = (memory.as_ptr() as usize + size_of_val(memory)) / HUGE * HUGE;
        if from < to {
            // SAFETY: whole pages inside of memory that is ours; advice changes no contents. A refusal does no harm.
            unsafe { libc::madvise(from as *mut libc::c_void, to - from, libc::MADV_HUGEPAGE) };
        }
    }
    let _ = memory;
}
