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
    /// Where line `i` starts.
    #[inline(always)]
    pub fn start(&self, i: usize) -> usize {
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

/// Rows of a buffer and of their results: elements from one to the next, and how many there are.
#[derive(Clone, Copy)]
pub struct Pitches {
    pub from: usize,
    pub to: usize,
    pub rows: usize,
}

/// Extremes along x of rows, for `n` outputs of windows of `w`: in registers, or by the tree.
#[allow(clippy::too_many_arguments)]
pub fn row_extremes<E: Elem>(
    level: crate::kernel::simd::Level,
    lo: &[E],
    hi: &[E],
    w: usize,
    n: usize,
    out_lo: &mut [E],
    out_hi: &mut [E],
    pitches: Pitches,
    work: &mut [E],
) {
    if !E::windows(level, lo, hi, w, n, out_lo, out_hi, pitches, work) {
        for k in 0..pitches.rows {
            let (from, to) = (k * pitches.from, k * pitches.to);
            tree_extreme(level, Lo, &lo[from..][..n + w - 1], w, 1, &mut out_lo[to..][..n], work);
            tree_extreme(level, Hi, &hi[from..][..n + w - 1], w, 1, &mut out_hi[to..][..n], work);
        }
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
}
