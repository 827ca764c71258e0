//! Minimum and maximum of windows of lines, along z and y: a few outputs at a time, written out in registers, or by groups
//! of lines where windows are long.

use super::lines::{Block, Coding, Elem, Lines, Masked, Sources};
use super::plan::{Job, Tile};
use crate::kernel::simd::Level;

crate::multiversion! {
    /// Minimum and maximum over windows of `w >= B` lines for `B` consecutive outputs. Line `k + j` for `j` in `0..w`
    /// belongs to output `k`, which goes to `out.0 + k * out.1` of `lo` and `hi`. One core of common lines, a chain of
    /// suffixes and one of prefixes: about `(w + 2B) / B` loads per output, shared by both results where `src` is the same
    /// slice twice and `Sources<false>` says so.
    pub fn extremes[T: Elem, const B: usize, const M: bool, const TWO: bool](
        block: Block<B>, masked: Masked<M>, sources: Sources<TWO>, src: [&[T]; 2], lines: Lines, w: usize, cols: usize, coding: Coding<T>,
        lo: &mut [T], hi: &mut [T], out: (usize, usize)
    ) -> () = extremes_inner;
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn extremes_inner<T: Elem, const B: usize, const M: bool, const TWO: bool>(
    _: Block<B>,
    _: Masked<M>,
    _: Sources<TWO>,
    src: [&[T]; 2],
    lines: Lines,
    w: usize,
    cols: usize,
    coding: Coding<T>,
    lo: &mut [T],
    hi: &mut [T],
    out: (usize, usize),
) {
    let chunk = T::CHUNK.as_ref().len();
    if cols < chunk {
        narrow::<T, B, M, TWO>(src, lines, w, cols, coding, lo, hi, out);
        return;
    }
    // Lines beyond the clip repeat the nearest, so the lines common to all windows are one run.
    let (left, right): ([usize; B], [usize; B]) =
        (std::array::from_fn(|k| lines.start(k)), std::array::from_fn(|k| lines.start(w - 1 + k)));
    let core = lines.start(B - 1);
    let ends = Ends::<B> { left, right, core: (core, 1 + (right[0] - core) / lines.pitch.max(1)), pitch: lines.pitch };
    let most = ends.right[B - 1] + cols; // starts grow with the line
    assert!(w >= B && most <= src[0].len() && most <= src[1].len());
    assert!(out.0 + (B - 1) * out.1 + cols <= lo.len().min(hi.len()));
    let mut x = 0;
    loop {
        // SAFETY: every start is at most the last, which was checked with `cols`, and `x + chunk <= cols`.
        unsafe { extremes_chunk::<T, B, M, TWO>(src, &ends, x, coding, lo, hi, out) };
        if x + chunk >= cols {
            break;
        }
        x = (x + chunk).min(cols - chunk); // the last chunk overlaps its neighbour and writes the same values again
    }
}

/// Fewer columns than a chunk: each line is copied to one and joined to the windows that hold it. 2-core Zen 4 VM, AVX-512,
/// 2026-11-26: the MRI head in bricks 128 wide, of which the last have 63 columns: 356 ms voxel by voxel, 66 so.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn narrow<T: Elem, const B: usize, const M: bool, const TWO: bool>(
    src: [&[T]; 2],
    lines: Lines,
    w: usize,
    cols: usize,
    coding: Coding<T>,
    lo: &mut [T],
    hi: &mut [T],
    out: (usize, usize),
) {
    let mut nothing = (T::CHUNK, T::CHUNK);
    nothing.0.as_mut().fill(T::GREATEST);
    nothing.1.as_mut().fill(T::LEAST);
    let mut windows = [nothing; B];
    let (mut one, mut two) = (T::CHUNK, T::CHUNK);
    for i in 0..w + B - 1 {
        let start = lines.start(i);
        one.as_mut()[..cols].copy_from_slice(&src[0][start..start + cols]);
        if TWO {
            two.as_mut()[..cols].copy_from_slice(&src[1][start..start + cols]);
        }
        for (k, window) in windows.iter_mut().enumerate() {
            if k <= i && i < k + w {
                let sources = [one.as_ref(), if TWO { two.as_ref() } else { one.as_ref() }];
                // SAFETY: both hold a chunk.
                *window = unsafe { join_line::<T, M, TWO>(*window, sources, 0, coding) };
            }
        }
    }
    for (k, (least, most)) in windows.iter().enumerate() {
        let to = out.0 + k * out.1;
        lo[to..to + cols].copy_from_slice(&least.as_ref()[..cols]);
        hi[to..to + cols].copy_from_slice(&most.as_ref()[..cols]);
    }
}

/// Where the lines of a block of windows start: those before the common ones, those after (`right[0]` is the last
/// common one), the first common one and how many there are.
struct Ends<const B: usize> {
    left: [usize; B],
    right: [usize; B],
    core: (usize, usize),
    pitch: usize,
}

/// Joins line `start` of `src` to running extremes.
///
/// # Safety
/// A chunk from `start` on lies in both sources.
#[inline(always)]
unsafe fn join_line<T: Elem, const M: bool, const TWO: bool>(
    (mut lo, mut hi): (T::Chunk, T::Chunk),
    src: [&[T]; 2],
    start: usize,
    coding: Coding<T>,
) -> (T::Chunk, T::Chunk) {
    let chunk = T::CHUNK.as_ref().len();
    // SAFETY: the caller's promise.
    let (one, two) =
        unsafe { (src[0].get_unchecked(start..start + chunk), src[1].get_unchecked(start..start + chunk)) };
    let two = if TWO { two } else { one };
    let (l, h) = (lo.as_mut(), hi.as_mut());
    for i in 0..chunk {
        let v = one[i].code(coding.flip);
        let u = if TWO { two[i].code(coding.flip) } else { v };
        let gone = M && v == coding.missing;
        l[i] = l[i].lo(if gone { T::GREATEST } else { v });
        h[i] = h[i].hi(if gone { T::LEAST } else { u });
    }
    (lo, hi)
}

/// One chunk of columns at `x`. The chains are written out: as loops they stay in memory, and each step waits for the
/// store before it (2-core Zen 4 VM, AVX-512, 2026-11-23, busy machine: cdf_power of u16, r=10, 4.5 ns/voxel as loops,
/// 3.8 written out).
///
/// # Safety
/// Every start of `ends` and `x` leave room for a chunk in both sources; so does every output line in `lo` and `hi`.
#[inline(always)]
unsafe fn extremes_chunk<T: Elem, const B: usize, const M: bool, const TWO: bool>(
    src: [&[T]; 2],
    ends: &Ends<B>,
    x: usize,
    coding: Coding<T>,
    lo: &mut [T],
    hi: &mut [T],
    out: (usize, usize),
) {
    let chunk = T::CHUNK.as_ref().len();
    let mut nothing = (T::CHUNK, T::CHUNK);
    nothing.0.as_mut().fill(T::GREATEST);
    nothing.1.as_mut().fill(T::LEAST);
    // Macros, not closures: what calls vectors must be inlined whatever the compiler thinks of its size. As closures both were
    // left out of line for u32 and f64 (2-core Zen 4 VM, AVX-512, 2026-11-27, minimum and maximum, r=10, ns per voxel as
    // closures and so: u32 9.5, 2.8; f64 12.3, 9.3).
    macro_rules! join {
        ($m:expr, $start:expr) => {
            // SAFETY: the caller's promise.
            unsafe { join_line::<T, M, TWO>($m, src, $start + x, coding) }
        };
    }
    macro_rules! put {
        ($k:expr, $left:expr, $right:expr) => {{
            let (left, right): (&(T::Chunk, T::Chunk), &(T::Chunk, T::Chunk)) = ($left, $right);
            let start = out.0 + $k * out.1 + x;
            // SAFETY: the caller's promise.
            let (to_lo, to_hi) =
                unsafe { (lo.get_unchecked_mut(start..start + chunk), hi.get_unchecked_mut(start..start + chunk)) };
            for i in 0..chunk {
                to_lo[i] = left.0.as_ref()[i].lo(right.0.as_ref()[i]);
                to_hi[i] = left.1.as_ref()[i].hi(right.1.as_ref()[i]);
            }
        }};
    }
    let mut core = nothing;
    for i in 0..ends.core.1 {
        core = join!(core, ends.core.0 + i * ends.pitch);
    }
    let mut left = [core; B];
    macro_rules! chain {
        ($($k:literal)*) => {$(
            if $k + 1 < B {
                left[$k] = join!(left[$k + 1], ends.left[$k]);
            }
        )*};
    }
    chain!(6 5 4 3 2 1 0);
    put!(0, &left[0], &nothing);
    let mut right = nothing;
    macro_rules! outputs {
        ($($k:literal)*) => {$(
            if $k < B {
                right = join!(right, ends.right[$k]);
                put!($k, &left[$k], &right);
            }
        )*};
    }
    outputs!(1 2 3 4 5 6 7);
}

/// Windows from which [`deep_extremes`] pays: below, a core of at most 25 lines is joined directly.
/// 2-core Zen 4 VM, AVX-512, 2026-11-23: cdf_power of u16, r=64, 11.9 ns/voxel against 23.1 with [`extremes`] alone.
pub const DEEP: usize = 33;

/// Where extremes of groups of lines are kept: of group `g` the least at `at + 2 (g % slots) stride`, the greatest `stride` on.
/// Groups in front of `from` are there already.
#[derive(Clone, Copy)]
pub struct Groups {
    pub at: usize,
    pub stride: usize,
    pub slots: usize,
    pub from: usize,
}

impl Groups {
    fn of(&self, g: usize) -> usize {
        self.at + 2 * (g % self.slots) * self.stride
    }
}

/// Whole groups that all windows of a block hold: lines 8..8 + 8 groups of the block.
fn common(w: usize) -> usize {
    (w - 8) / 8
}

/// Groups that the windows of `blocks` blocks ask for at a time.
pub fn slots(w: usize, blocks: usize) -> usize {
    if w < DEEP { 0 } else { common(w) + blocks }
}

crate::multiversion! {
    /// [`extremes`] for long windows (`w >= DEEP`) and the blocks of 8 outputs `blocks`: the extremes of each group of 8 lines
    /// are made once, so a block reads its groups, and lines only at the window's ends. Whole lines are walked, since a
    /// column of far planes would defeat the prefetcher. `cols` is at least a chunk; output 8 `blocks.0` goes to `out.0`.
    pub fn deep_extremes[T: Elem, const M: bool, const TWO: bool](
        masked: Masked<M>, sources: Sources<TWO>, src: [&[T]; 2], lines: Lines, w: usize, cols: usize,
        coding: Coding<T>, blocks: (usize, usize), lo: &mut [T], hi: &mut [T], out: (usize, usize), kept: Groups, work: &mut [T]
    ) -> () = deep_inner;
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn deep_inner<T: Elem, const M: bool, const TWO: bool>(
    _: Masked<M>,
    _: Sources<TWO>,
    src: [&[T]; 2],
    lines: Lines,
    w: usize,
    cols: usize,
    coding: Coding<T>,
    blocks: (usize, usize),
    lo: &mut [T],
    hi: &mut [T],
    out: (usize, usize),
    kept: Groups,
    work: &mut [T],
) {
    let chunk = T::CHUNK.as_ref().len();
    let mut nothing = (T::CHUNK, T::CHUNK);
    nothing.0.as_mut().fill(T::GREATEST);
    nothing.1.as_mut().fill(T::LEAST);
    let most = lines.start(8 * blocks.1 + w - 2) + cols;
    assert!(cols >= chunk && most <= src[0].len() && most <= src[1].len());
    // SAFETY: starts grow with the line, and the last was checked with `cols >= x + chunk`.
    let join = |m, start: usize| unsafe { join_line::<T, M, TWO>(m, src, start, coding) };
    let groups = common(w);
    let steps = cols.div_ceil(chunk);
    for g in kept.from.max(blocks.0 + 1)..blocks.1 + groups {
        let at = kept.of(g);
        for s in 0..steps {
            let x = (s * chunk).min(cols - chunk);
            let mut m = nothing;
            for i in 8 * g..8 * g + 8 {
                m = join(m, lines.start(i) + x);
            }
            work[at + x..][..chunk].copy_from_slice(m.0.as_ref());
            work[at + kept.stride + x..][..chunk].copy_from_slice(m.1.as_ref());
        }
    }
    for q in blocks.0..blocks.1 {
        for s in 0..steps {
            let x = (s * chunk).min(cols - chunk);
            let mut core = nothing;
            for g in q + 1..q + 1 + groups {
                let at = kept.of(g) + x;
                let (a, b) = (&work[at..][..chunk], &work[at + kept.stride..][..chunk]);
                for i in 0..chunk {
                    core.0.as_mut()[i] = core.0.as_ref()[i].lo(a[i]);
                    core.1.as_mut()[i] = core.1.as_ref()[i].hi(b[i]);
                }
            }
            let mut left = [core; 9];
            for k in (0..8).rev() {
                left[k] = join(left[k + 1], lines.start(8 * q + k) + x);
            }
            let mut right = nothing;
            for i in 8 + 8 * groups..w {
                right = join(right, lines.start(8 * q + i) + x);
            }
            for (k, l) in left[..8].iter().enumerate() {
                if k > 0 {
                    right = join(right, lines.start(8 * q + w + k - 1) + x);
                }
                let start = out.0 + (8 * (q - blocks.0) + k) * out.1 + x;
                let (to_lo, to_hi) = (&mut lo[start..start + chunk], &mut hi[start..start + chunk]);
                for i in 0..chunk {
                    to_lo[i] = l.0.as_ref()[i].lo(right.0.as_ref()[i]);
                    to_hi[i] = l.1.as_ref()[i].hi(right.1.as_ref()[i]);
                }
            }
        }
    }
}

/// Extremes over y of a block of output rows from planes of columns that exist; `lines` are those of their windows.
#[allow(clippy::too_many_arguments)]
pub fn rows_extremes<T: Elem>(
    level: Level,
    job: &Job,
    tile: &Tile,
    from: [&[T]; 2],
    lines: Lines,
    lo: &mut [T],
    hi: &mut [T],
    work: &mut [T],
) {
    let plain = Coding { flip: T::default(), missing: T::default() };
    // Where few columns exist, neutral ones behind them make a chunk; what sticks out of a row is neutral in the next too.
    let (cols, out) = (tile.columns().max(T::CHUNK.as_ref().len()), (tile.cols.0, job.pitch));
    let (outputs, w) = ((job.rows, job.row_block), job.window[1]);
    blocked(level, outputs, Masked::<false>, Sources::<true>, from, lines, w, cols, plain, lo, hi, out, work);
}

/// Extremes of `outputs` lines from `lines` on, by blocks of a length known at run time, or by [`deep_extremes`].
#[allow(clippy::too_many_arguments)]
pub fn blocked<T: Elem, const M: bool, const TWO: bool>(
    level: Level,
    (outputs, block): (usize, usize),
    masked: Masked<M>,
    sources: Sources<TWO>,
    src: [&[T]; 2],
    lines: Lines,
    w: usize,
    cols: usize,
    coding: Coding<T>,
    lo: &mut [T],
    hi: &mut [T],
    out: (usize, usize),
    work: &mut [T],
) {
    if deep(w, cols, block, T::CHUNK.as_ref().len()) {
        let blocks = (0, outputs / 8);
        let kept = Groups { at: 0, stride: cols, slots: slots(w, blocks.1), from: 1 };
        deep_extremes(level, masked, sources, src, lines, w, cols, coding, blocks, lo, hi, out, kept, work);
        return;
    }
    for k in (0..outputs).step_by(block) {
        let lines = Lines { first: lines.first + k as isize, ..lines };
        let out = (out.0 + k * out.1, out.1);
        match block {
            1 => extremes(level, Block::<1>, masked, sources, src, lines, w, cols, coding, lo, hi, out),
            4 => extremes(level, Block::<4>, masked, sources, src, lines, w, cols, coding, lo, hi, out),
            8 => extremes(level, Block::<8>, masked, sources, src, lines, w, cols, coding, lo, hi, out),
            _ => unreachable!("blocks are 1, 4 or 8 lines"),
        }
    }
}

/// Whether [`deep_extremes`] makes windows of `w` lines of `cols` columns.
pub fn deep(w: usize, cols: usize, block: usize, chunk: usize) -> bool {
    w >= DEEP && block == 8 && cols >= chunk
}

/// Elements of work that both axes of [`blocked`] need.
pub fn deep_len(job: &Job) -> usize {
    let of = |w: usize, outputs: usize| 2 * job.pitch * slots(w, outputs / 8);
    of(job.window[0], job.batch).max(of(job.window[1], job.rows))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::Level;
    fn check_extremes<const B: usize, const M: bool>(w: usize, cols: usize) {
        let pitch = cols + 3;
        let src: Vec<u8> = (0..40 * pitch).map(|i| (i * i * 31 / 7) as u8).collect();
        let lines = Lines { base: 1, pitch, first: -4, clip: (2, 37) };
        for level in Level::available() {
            let (mut lo, mut hi) = (vec![0u8; B * pitch], vec![0u8; B * pitch]);
            let coding = Coding { flip: 0x80, missing: 9 };
            extremes(
                level,
                Block::<B>,
                Masked::<M>,
                Sources::<false>,
                [&src; 2],
                lines,
                w,
                cols,
                coding,
                &mut lo,
                &mut hi,
                (0, pitch),
            );
            for k in 0..B {
                for x in 0..cols {
                    let window = || {
                        let line = |i: usize| 1 + (i as isize - 4).clamp(2, 36) as usize * pitch + x;
                        (k..k + w).map(line).map(|i| src[i] ^ 0x80).filter(|v| !M || *v != 9)
                    };
                    assert_eq!(lo[k * pitch + x], window().min().unwrap_or(255), "{level:?} {B} {w} {cols} {k} {x}");
                    assert_eq!(hi[k * pitch + x], window().max().unwrap_or(0));
                }
            }
        }
    }

    #[test]
    fn deep_extremes_equal_plain_ones() {
        let pitch = 96;
        let src: Vec<u16> = (0..400 * pitch).map(|i: usize| (i.wrapping_mul(2_654_435_761) >> 9) as u16).collect();
        let lines = Lines { base: 0, pitch, first: -9, clip: (0, 190) };
        let coding = Coding { flip: 0x8000, missing: 1234 };
        let (m, s, plain) =
            (Masked::<true>, Sources::<false>, |k: usize| Lines { first: -9 + 8 * k as isize, ..lines });
        for level in Level::available() {
            for w in [33, 35, 40, 64, 129, 301] {
                let [mut lo, mut hi, mut a, mut b] = [(); 4].map(|()| vec![0u16; 32 * pitch]);
                let mut work = vec![0u16; 7 + 2 * slots(w, 2) * 93];
                // Two blocks at a time, which keep their groups.
                for q in [0, 2] {
                    let from = if q == 0 { 1 } else { q + common(w) };
                    let kept = Groups { at: 7, stride: 93, slots: slots(w, 2), from };
                    let (blocks, out) = ((q, q + 2), (8 * q * pitch, pitch));
                    let (to, work) = ([&mut lo, &mut hi], &mut work);
                    let [lo, hi] = to;
                    deep_extremes(level, m, s, [&src; 2], lines, w, 90, coding, blocks, lo, hi, out, kept, work);
                }
                for k in 0..4 {
                    let out = (8 * k * pitch, pitch);
                    extremes(level, Block::<8>, m, s, [&src; 2], plain(k), w, 90, coding, &mut a, &mut b, out);
                }
                assert!(lo == a && hi == b, "{level:?} {w}");
            }
        }
    }

    #[test]
    fn extremes_equal_direct_windows() {
        for cols in [1, 63, 64, 130] {
            check_extremes::<1, false>(1, cols);
            check_extremes::<1, true>(3, cols);
            check_extremes::<4, false>(5, cols);
            check_extremes::<8, false>(21, cols);
            check_extremes::<8, true>(9, cols);
        }
    }
}
