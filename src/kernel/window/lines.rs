//! Passes along one axis: minimum and maximum of lines, sums and extremes by a radix-4 tree, running sums.
//!
//! Every pass is a flat loop over contiguous elements. A window of `w` lines that lie `step` elements apart is the same
//! loop for any axis: `step` is 1 along x and the pitch of a row along y.

use super::along::RowExtremes;
use crate::grid::Voxel;

/// Zero-sized argument that carries a block length to a multiversioned function.
#[derive(Clone, Copy)]
pub struct Block<const B: usize>;

/// Zero-sized argument that says at compile time whether integer voxels may be missing.
#[derive(Clone, Copy)]
pub struct Masked<const M: bool>;

/// Zero-sized argument: `Sources<true>` takes maxima from a second buffer, `Sources<false>` from the same one.
#[derive(Clone, Copy)]
pub struct Sources<const TWO: bool>;

/// An element with an order: integer codes (signed types are mapped by their sign bit) and floats.
pub trait Elem: Voxel + RowExtremes {
    /// 64 bytes of elements.
    type Chunk: Copy + AsRef<[Self]> + AsMut<[Self]>;
    const CHUNK: Self::Chunk;
    const LEAST: Self;
    const GREATEST: Self;
    /// Code of a stored value: the sign bit inverted where `flip` says so.
    fn code(self, flip: Self) -> Self;
    /// The lesser; `self` where `other` is NaN.
    fn lo(self, other: Self) -> Self;
    /// The greater; `self` where `other` is NaN.
    fn hi(self, other: Self) -> Self;
}

macro_rules! elem {
    ($($t:ident, $n:literal, $least:expr, $greatest:expr, $zero:expr, |$s:ident, $f:ident| $code:expr;)*) => {$(
        impl Elem for $t {
            type Chunk = [$t; $n];
            const CHUNK: [$t; $n] = [$zero; $n];
            const LEAST: $t = $least;
            const GREATEST: $t = $greatest;
            #[inline(always)]
            fn code(self, $f: $t) -> $t { let $s = self; $code }
            #[inline(always)]
            fn lo(self, other: $t) -> $t { if other < self { other } else { self } }
            #[inline(always)]
            fn hi(self, other: $t) -> $t { if other > self { other } else { self } }
        }
    )*};
}
elem! {
    u8, 64, u8::MIN, u8::MAX, 0, |s, f| s ^ f;
    u16, 32, u16::MIN, u16::MAX, 0, |s, f| s ^ f;
    u32, 16, u32::MIN, u32::MAX, 0, |s, f| s ^ f;
    f32, 16, f32::NEG_INFINITY, f32::INFINITY, 0.0, |s, _f| s;
    f64, 8, f64::NEG_INFINITY, f64::INFINITY, 0.0, |s, _f| s;
}

/// An associative operation of a tree.
pub trait Op<E>: Copy {
    fn join(a: E, b: E) -> E;
}

#[derive(Clone, Copy)]
pub struct Add;
#[derive(Clone, Copy)]
pub struct Lo;
#[derive(Clone, Copy)]
pub struct Hi;

macro_rules! wrapping_add {
    ($($t:ident)*) => {$(
        impl Op<$t> for Add {
            #[inline(always)]
            fn join(a: $t, b: $t) -> $t { a.wrapping_add(b) }
        }
    )*};
}
wrapping_add!(u16 u32 u64 u128);
impl<E: Elem> Op<E> for Lo {
    #[inline(always)]
    fn join(a: E, b: E) -> E {
        a.lo(b)
    }
}
impl<E: Elem> Op<E> for Hi {
    #[inline(always)]
    fn join(a: E, b: E) -> E {
        a.hi(b)
    }
}

/// Lines of a buffer: line `i` starts at `base + clamp(first + i, clip) * pitch`.
#[derive(Clone, Copy)]
pub struct Lines {
    pub base: usize,
    pub pitch: usize,
    pub first: isize,
    /// Lines that exist, half-open; an index beyond stands for the nearest of them.
    pub clip: (isize, isize),
}

impl Lines {
    #[inline(always)]
    fn start(&self, i: usize) -> usize {
        self.base + (self.first + i as isize).clamp(self.clip.0, self.clip.1 - 1) as usize * self.pitch
    }
}

/// How stored voxels become codes.
#[derive(Clone, Copy)]
pub struct Coding<T> {
    /// XORed to each stored value.
    pub flip: T,
    /// Code of a missing voxel (used only under `Masked<true>`).
    pub missing: T,
}

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
        for x in 0..cols {
            for k in 0..B {
                let mut m = (T::GREATEST, T::LEAST);
                for j in k..k + w {
                    let [a, b] = src.map(|s| s[lines.start(j) + x].code(coding.flip));
                    if !(M && a == coding.missing) {
                        m = (m.0.lo(a), m.1.hi(b));
                    }
                }
                lo[out.0 + k * out.1 + x] = m.0;
                hi[out.0 + k * out.1 + x] = m.1;
            }
        }
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
    let join = |m, start: usize| {
        // SAFETY: the caller's promise.
        unsafe { join_line::<T, M, TWO>(m, src, start + x, coding) }
    };
    let mut put = |k: usize, left: &(T::Chunk, T::Chunk), right: &(T::Chunk, T::Chunk)| {
        let start = out.0 + k * out.1 + x;
        // SAFETY: the caller's promise.
        let (to_lo, to_hi) =
            unsafe { (lo.get_unchecked_mut(start..start + chunk), hi.get_unchecked_mut(start..start + chunk)) };
        for i in 0..chunk {
            to_lo[i] = left.0.as_ref()[i].lo(right.0.as_ref()[i]);
            to_hi[i] = left.1.as_ref()[i].hi(right.1.as_ref()[i]);
        }
    };
    let mut core = nothing;
    for i in 0..ends.core.1 {
        core = join(core, ends.core.0 + i * ends.pitch);
    }
    let mut left = [core; B];
    macro_rules! chain {
        ($($k:literal)*) => {$(
            if $k + 1 < B {
                left[$k] = join(left[$k + 1], ends.left[$k]);
            }
        )*};
    }
    chain!(6 5 4 3 2 1 0);
    put(0, &left[0], &nothing);
    let mut right = nothing;
    macro_rules! outputs {
        ($($k:literal)*) => {$(
            if $k < B {
                right = join(right, ends.right[$k]);
                put($k, &left[$k], &right);
            }
        )*};
    }
    outputs!(1 2 3 4 5 6 7);
}

/// Windows from which [`deep_extremes`] pays: below, a core of at most 25 lines is joined directly.
/// 2-core Zen 4 VM, AVX-512, 2026-11-23: cdf_power of u16, r=64, 11.9 ns/voxel against 23.1 with [`extremes`] alone.
pub const DEEP: usize = 33;

/// Elements of `work` that [`deep_extremes`] needs.
pub fn deep_len(w: usize, blocks: usize, cols: usize) -> usize {
    2 * cols * (w / 8 + blocks + 1)
}

crate::multiversion! {
    /// [`extremes`] for long windows (`w >= DEEP`) and `8 * blocks` outputs: the extremes of each group of 8 lines are
    /// made once, so a block reads its groups, and lines only at the window's ends. Whole lines are walked, since a
    /// column of far planes would defeat the prefetcher. `cols` is at least a chunk.
    pub fn deep_extremes[T: Elem, const M: bool, const TWO: bool](
        masked: Masked<M>, sources: Sources<TWO>, src: [&[T]; 2], lines: Lines, w: usize, cols: usize,
        coding: Coding<T>, blocks: usize, lo: &mut [T], hi: &mut [T], out: (usize, usize), work: &mut [T]
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
    blocks: usize,
    lo: &mut [T],
    hi: &mut [T],
    out: (usize, usize),
    work: &mut [T],
) {
    let chunk = T::CHUNK.as_ref().len();
    let mut nothing = (T::CHUNK, T::CHUNK);
    nothing.0.as_mut().fill(T::GREATEST);
    nothing.1.as_mut().fill(T::LEAST);
    let most = lines.start(8 * blocks + w - 2) + cols;
    assert!(cols >= chunk && most <= src[0].len() && most <= src[1].len());
    // SAFETY: starts grow with the line, and the last was checked with `cols >= x + chunk`.
    let join = |m, start: usize| unsafe { join_line::<T, M, TWO>(m, src, start, coding) };
    // Whole groups that all windows of a block hold: lines 8..8 + 8 groups of the block.
    let groups = (w - 8) / 8;
    let steps = cols.div_ceil(chunk);
    for g in 1..blocks + groups {
        for s in 0..steps {
            let x = (s * chunk).min(cols - chunk);
            let mut m = nothing;
            for i in 8 * g..8 * g + 8 {
                m = join(m, lines.start(i) + x);
            }
            work[2 * g * cols + x..][..chunk].copy_from_slice(m.0.as_ref());
            work[(2 * g + 1) * cols + x..][..chunk].copy_from_slice(m.1.as_ref());
        }
    }
    for q in 0..blocks {
        for s in 0..steps {
            let x = (s * chunk).min(cols - chunk);
            let mut core = nothing;
            for g in q + 1..q + 1 + groups {
                let (a, b) = (&work[2 * g * cols + x..][..chunk], &work[(2 * g + 1) * cols + x..][..chunk]);
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
                let start = out.0 + (8 * q + k) * out.1 + x;
                let (to_lo, to_hi) = (&mut lo[start..start + chunk], &mut hi[start..start + chunk]);
                for i in 0..chunk {
                    to_lo[i] = l.0.as_ref()[i].lo(right.0.as_ref()[i]);
                    to_hi[i] = l.1.as_ref()[i].hi(right.1.as_ref()[i]);
                }
            }
        }
    }
}

/// Levels of the radix-4 tree for windows of `w`: level `k` holds joins of `4^k` neighbours, the top one joins at most 8
/// (and lower digits) to a window. Depends on nothing but `w`.
pub fn tree_levels(w: usize) -> usize {
    let (mut levels, mut size) = (0, 1);
    while w / size > 8 {
        size *= 4;
        levels += 1;
    }
    levels
}

/// Elements that level `k >= 1` of a tree over windows of `w` needs for `len` outputs.
pub fn level_len(w: usize, step: usize, len: usize, k: usize) -> usize {
    len + (w - (1 << (2 * k))) * step
}

crate::multiversion! {
    /// `out[i] = join over offsets of src[i + offset]`, or joined to what `out` holds. At most 16 offsets.
    pub fn join_at[E: Copy, O: Op<E>](op: O, src: &[E], offsets: &[usize], out: &mut [E], onto: bool) -> () = join_at_inner;
}

#[inline(always)]
fn join_at_inner<E: Copy, O: Op<E>>(_: O, src: &[E], offsets: &[usize], out: &mut [E], onto: bool) {
    let mut onto = onto;
    let mut rest = offsets;
    while !rest.is_empty() {
        let k = rest.len().min(6);
        match k {
            1 => join_k::<E, O, 1>(src, rest, out, onto),
            2 => join_k::<E, O, 2>(src, rest, out, onto),
            3 => join_k::<E, O, 3>(src, rest, out, onto),
            4 => join_k::<E, O, 4>(src, rest, out, onto),
            5 => join_k::<E, O, 5>(src, rest, out, onto),
            _ => join_k::<E, O, 6>(src, rest, out, onto),
        }
        onto = true;
        rest = &rest[k..];
    }
}

#[inline(always)]
#[allow(clippy::needless_range_loop)] // one index for many slices is what vectorises
fn join_k<E: Copy, O: Op<E>, const K: usize>(src: &[E], offsets: &[usize], out: &mut [E], onto: bool) {
    let n = out.len();
    let t: [&[E]; K] = std::array::from_fn(|k| &src[offsets[k]..offsets[k] + n]);
    if onto {
        for i in 0..n {
            let mut s = out[i];
            for a in t {
                // SAFETY: every slice of `t` has `n` elements.
                s = O::join(s, unsafe { *a.get_unchecked(i) });
            }
            out[i] = s;
        }
    } else {
        for i in 0..n {
            // SAFETY: as above.
            let e: [E; K] = std::array::from_fn(|k| unsafe { *t[k].get_unchecked(i) });
            out[i] = if K == 4 {
                O::join(O::join(e[0], e[1]), O::join(e[2 % K], e[3 % K])) // the order of `columns`
            } else {
                e[1..].iter().fold(e[0], |s, v| O::join(s, *v))
            };
        }
    }
}

/// Window joins of an idempotent operation (minimum, maximum): `out[i]` over `src[i + j * step]`, `j < w`.
/// `work` holds two levels of [`level_len`] elements each, at most `src.len()`.
#[allow(clippy::too_many_arguments)]
pub fn tree_extreme<E: Elem, O: Op<E>>(
    level: crate::kernel::simd::Level,
    op: O,
    src: &[E],
    w: usize,
    step: usize,
    out: &mut [E],
    work: &mut [E],
) {
    let levels = tree_levels(w);
    let (mut a, mut b) = work.split_at_mut(work.len() / 2);
    let mut size = 1;
    for k in 1..=levels {
        let len = level_len(w, step, out.len(), k);
        let offsets = [0, size * step, 2 * size * step, 3 * size * step];
        join_at(level, op, if k == 1 { src } else { &*b }, &offsets, &mut a[..len], false);
        std::mem::swap(&mut a, &mut b);
        size *= 4;
    }
    let mut offsets = [0; 9];
    let terms = w.div_ceil(size);
    for (j, o) in offsets[..terms].iter_mut().enumerate() {
        *o = (j * size).min(w - size) * step;
    }
    join_at(level, op, if levels == 0 { src } else { &*b }, &offsets[..terms], out, false);
}

/// Extremes along x of a row, for `n` outputs of windows of `w`: in registers, or by the tree.
#[allow(clippy::too_many_arguments)]
pub fn row_extremes<E: Elem>(
    level: crate::kernel::simd::Level,
    lo: &[E],
    hi: &[E],
    w: usize,
    n: usize,
    out_lo: &mut [E],
    out_hi: &mut [E],
    work: &mut [E],
) {
    if !E::windows(level, lo, hi, w, n, out_lo, out_hi) {
        tree_extreme(level, Lo, &lo[..n + w - 1], w, 1, &mut out_lo[..n], work);
        tree_extreme(level, Hi, &hi[..n + w - 1], w, 1, &mut out_hi[..n], work);
    }
}

/// Window sums by the radix-4 tree: `out[i]` of `src[i + j * step]`, `j < w`, in an order that depends on `w` alone.
/// `work` holds [`tree_levels`] levels of `out.len() + w * step` elements.
pub fn tree_sum<E: Copy>(
    level: crate::kernel::simd::Level,
    src: &[E],
    w: usize,
    step: usize,
    out: &mut [E],
    work: &mut [E],
) where
    Add: Op<E>,
{
    let levels = tree_levels(w);
    let pitch = out.len() + w * step;
    let mut size = 1;
    for k in 1..=levels {
        let len = level_len(w, step, out.len(), k);
        let (below, this) = work.split_at_mut((k - 1) * pitch);
        let from = if k == 1 { src } else { &below[(k - 2) * pitch..] };
        join_at(level, Add, from, &[0, size * step, 2 * size * step, 3 * size * step], &mut this[..len], false);
        size *= 4;
    }
    let mut at = 0;
    for k in (0..=levels).rev() {
        let digit = (w - at) / size;
        let mut offsets = [0; 8];
        for (j, o) in offsets[..digit].iter_mut().enumerate() {
            *o = (at + j * size) * step;
        }
        let from = if k == 0 { src } else { &work[(k - 1) * pitch..k * pitch] };
        join_at(level, Add, from, &offsets[..digit], out, k < levels);
        at += digit * size;
        size /= 4;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::Level;

    #[test]
    fn trees_equal_direct_windows_for_many_widths_and_steps() {
        let src: Vec<u32> = (0..4000u32).map(|i| i.wrapping_mul(2_654_435_761) >> 7).collect();
        for level in Level::available() {
            for w in [1, 2, 3, 5, 7, 8, 9, 11, 21, 33, 63, 65, 129, 255, 399] {
                for step in [1, 5] {
                    let len = 70;
                    let mut work = vec![0u32; 8 * (len + w * step)];
                    let (mut s, mut m) = (vec![0u32; len], vec![0u32; len]);
                    tree_sum(level, &src, w, step, &mut s, &mut work);
                    tree_extreme(level, Lo, &src, w, step, &mut m, &mut work);
                    for i in 0..len {
                        let window = || (0..w).map(|j| src[i + j * step]);
                        assert_eq!(s[i], window().fold(0, u32::wrapping_add), "{level:?} sum {w} {step}");
                        assert_eq!(m[i], window().min().unwrap(), "{level:?} min {w} {step}");
                    }
                }
            }
        }
    }

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
                let mut work = vec![0u16; deep_len(w, 4, 90)];
                deep_extremes(level, m, s, [&src; 2], lines, w, 90, coding, 4, &mut lo, &mut hi, (0, pitch), &mut work);
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
