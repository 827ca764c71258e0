//! Sums of floats and merges of (n, sum, M2), where M2 is the sum of squared deviations from the mean.
//!
//! A multiway form of Chan, Golub and LeVeque's update: with S = sum S_k, n = sum n_k and mean S/n,
//! `M2 = sum M2_k + sum (S_k - n_k S/n)^2 / n_k`. Nothing large is subtracted but means of neighbours, so a step of
//! 1e6 elsewhere in the tile, or in the window, costs no accuracy. The tree is that of [`super::lines`].

use super::lines::{self, Add, Op, level_len, tree_levels};
use super::plan::Plain;
use crate::kernel::simd::Level;

/// Sum of f32 (f64) or of f64 (an unevaluated pair of f64).
pub trait Sum: Plain + Default + std::fmt::Debug {
    fn of(v: f64) -> Self;
    fn plus(self, o: Self) -> Self;
    /// Mean for merging, with `inv` = 1/n (0 for n = 0).
    fn mean(self, n: f64, inv: f64) -> Self;
    /// `self - n * mean`.
    fn deviation(self, n: f64, mean: Self) -> f64;
    /// `self - n * v`.
    fn less(self, n: f64, v: f64) -> f64;
    /// `self / n`, rounded once.
    fn over(self, n: f64) -> f64;
    fn is_finite(self) -> bool;
}

impl Sum for f64 {
    #[inline(always)]
    fn of(v: f64) -> f64 {
        v
    }
    #[inline(always)]
    fn plus(self, o: f64) -> f64 {
        self + o
    }
    #[inline(always)]
    fn mean(self, n: f64, inv: f64) -> f64 {
        // One Newton step: a representable mean comes out exactly, so equal values have M2 = 0.
        let q = self * inv;
        (-q).mul_add(n, self).mul_add(inv, q)
    }
    #[inline(always)]
    fn deviation(self, n: f64, mean: f64) -> f64 {
        (-n).mul_add(mean, self)
    }
    #[inline(always)]
    fn less(self, n: f64, v: f64) -> f64 {
        (-n).mul_add(v, self)
    }
    #[inline(always)]
    fn over(self, n: f64) -> f64 {
        self / n
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        f64::is_finite(self)
    }
}

/// `hi + lo`, about 106 bits.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
#[repr(C)]
pub struct Pair {
    hi: f64,
    lo: f64,
}

// SAFETY: two plain f64.
unsafe impl Plain for Pair {}

impl Op<Pair> for Add {
    /// Knuth's two-sum of the high parts; its error joins the low parts.
    #[inline(always)]
    fn join(a: Pair, b: Pair) -> Pair {
        let s = a.hi + b.hi;
        let t = s - a.hi;
        let e = (a.hi - (s - t)) + (b.hi - t);
        Pair { hi: s, lo: e + (a.lo + b.lo) }
    }
}

impl Sum for Pair {
    #[inline(always)]
    fn of(v: f64) -> Pair {
        Pair { hi: v, lo: 0.0 }
    }
    #[inline(always)]
    fn plus(self, o: Pair) -> Pair {
        Add::join(self, o)
    }
    #[inline(always)]
    fn mean(self, n: f64, inv: f64) -> Pair {
        let q = self.hi * inv;
        let q = ((-q).mul_add(n, self.hi) + self.lo).mul_add(inv, q);
        Pair { hi: q, lo: ((-q).mul_add(n, self.hi) + self.lo) * inv }
    }
    #[inline(always)]
    fn deviation(self, n: f64, mean: Pair) -> f64 {
        self.less(n, mean.hi) - n * mean.lo
    }
    #[inline(always)]
    fn less(self, n: f64, v: f64) -> f64 {
        let p = n * v;
        let e = n.mul_add(v, -p);
        ((self.hi - p) - e) + self.lo
    }
    #[inline(always)]
    fn over(self, n: f64) -> f64 {
        let q = self.hi / n;
        let r = ((-q).mul_add(n, self.hi) + self.lo) / n;
        if r.is_finite() { q + r } else { q }
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        self.hi.is_finite()
    }
}

/// Moments of windows: sums, M2, counts and their reciprocals (0 for 0). Fields not wanted are empty.
pub struct Moments<'a, A> {
    pub s: &'a mut [A],
    pub m: &'a mut [f64],
    pub n: &'a mut [f64],
    pub i: &'a mut [f64],
}

impl<'a, A: Sum> Moments<'a, A> {
    pub fn cut(len: usize, wanted: Wanted, bytes: &mut &'a mut [u8]) -> Self {
        let v = if wanted.variance { len } else { 0 };
        let n = if wanted.counts || wanted.variance { len } else { 0 };
        Moments {
            s: super::plan::cut(bytes, len),
            m: super::plan::cut(bytes, v),
            n: super::plan::cut(bytes, n),
            i: super::plan::cut(bytes, v),
        }
    }

    pub fn bytes(len: usize) -> usize {
        super::plan::padded::<A>(len) + 3 * super::plan::padded::<f64>(len)
    }

    /// The elements of `range`.
    pub fn part(&mut self, range: std::ops::Range<usize>) -> Moments<'_, A> {
        fn of<T>(s: &mut [T], range: std::ops::Range<usize>) -> &mut [T] {
            if s.is_empty() { s } else { &mut s[range] }
        }
        Moments {
            s: of(self.s, range.clone()),
            m: of(self.m, range.clone()),
            n: of(self.n, range.clone()),
            i: of(self.i, range),
        }
    }

    pub fn clear(&mut self) {
        self.s.fill(A::default());
        self.m.fill(0.0);
        self.n.fill(0.0);
        self.i.fill(0.0);
    }

    /// Copies what `from` holds.
    pub fn copy_from(&mut self, from: &Moments<A>) {
        self.s.copy_from_slice(from.s);
        self.m.copy_from_slice(from.m);
        self.n.copy_from_slice(from.n);
        self.i.copy_from_slice(from.i);
    }
}

/// Which moments a pass carries besides the sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted {
    pub variance: bool,
    /// Counts per voxel, because some are missing.
    pub counts: bool,
}

/// Moments of windows of `w` elements `step` apart, in an order that depends on `w` alone. `work` holds
/// [`tree_levels`] levels of `out.s.len() + w * step` elements.
pub fn tree_merge<A: Sum>(
    level: Level,
    wanted: Wanted,
    src: &Moments<A>,
    w: usize,
    step: usize,
    out: &mut Moments<A>,
    work: &mut Moments<A>,
) where
    Add: Op<A>,
{
    if !wanted.variance {
        lines::tree_sum(level, src.s, w, step, out.s, work.s);
        if wanted.counts {
            lines::tree_sum::<f64>(level, src.n, w, step, out.n, work.n);
        }
        return;
    }
    let (levels, len) = (tree_levels(w), out.s.len());
    let pitch = len + w * step;
    let mut size = 1;
    for k in 1..=levels {
        let Moments { s, m, n, i } = work;
        let cut = (k - 1) * pitch;
        let ((s0, s1), (m0, m1)) = (s.split_at_mut(cut), m.split_at_mut(cut));
        let ((n0, n1), (i0, i1)) = (n.split_at_mut(cut), i.split_at_mut(cut));
        let below = cut.saturating_sub(pitch);
        let from: From<A> = if k == 1 {
            (src.s, src.m, src.n, src.i)
        } else {
            (&s0[below..], &m0[below..], &n0[below..], &i0[below..])
        };
        let l = level_len(w, step, len, k);
        let offsets = [0, size * step, 2 * size * step, 3 * size * step];
        merge_at(level, from, &offsets, (&mut s1[..l], &mut m1[..l], &mut n1[..l], &mut i1[..l]), false);
        size *= 4;
    }
    let mut at = 0;
    for k in (0..=levels).rev() {
        let digit = (w - at) / size;
        let mut offsets = [0; 8];
        for (j, o) in offsets[..digit].iter_mut().enumerate() {
            *o = (at + j * size) * step;
        }
        let r = k.saturating_sub(1) * pitch..k * pitch;
        let from: From<A> = if k == 0 {
            (src.s, src.m, src.n, src.i)
        } else {
            (&work.s[r.clone()], &work.m[r.clone()], &work.n[r.clone()], &work.i[r])
        };
        let to = (&mut *out.s, &mut *out.m, &mut *out.n, &mut *out.i);
        merge_at(level, from, &offsets[..digit], to, k < levels);
        at += digit * size;
        size /= 4;
    }
}

type From<'a, A> = (&'a [A], &'a [f64], &'a [f64], &'a [f64]);
type Into<'a, A> = (&'a mut [A], &'a mut [f64], &'a mut [f64], &'a mut [f64]);

crate::multiversion! {
    /// Merges the windows of `from` at `i + offset` for every offset, and what `out` holds if `onto`, into `out[i]`.
    fn merge_at[A: Sum](from: From<A>, offsets: &[usize], out: Into<A>, onto: bool) -> () = merge_at_inner;
}

#[inline(always)]
fn merge_at_inner<A: Sum>(from: From<A>, offsets: &[usize], out: Into<A>, onto: bool) {
    let (mut onto, mut rest) = (onto, offsets);
    while !rest.is_empty() {
        let k = rest.len().min(6);
        let out = (&mut *out.0, &mut *out.1, &mut *out.2, &mut *out.3);
        match k {
            1 => merge_k::<A, 1>(from, rest, out, onto),
            2 => merge_k::<A, 2>(from, rest, out, onto),
            3 => merge_k::<A, 3>(from, rest, out, onto),
            4 => merge_k::<A, 4>(from, rest, out, onto),
            5 => merge_k::<A, 5>(from, rest, out, onto),
            _ => merge_k::<A, 6>(from, rest, out, onto),
        }
        onto = true;
        rest = &rest[k..];
    }
}

#[inline(always)]
fn merge_k<A: Sum, const K: usize>(from: From<A>, offsets: &[usize], out: Into<A>, onto: bool) {
    let len = out.0.len();
    let (os, om, on, oi) = (out.0, &mut out.1[..len], &mut out.2[..len], &mut out.3[..len]);
    let at = |k: usize| offsets[k]..offsets[k] + len;
    let s: [&[A]; K] = std::array::from_fn(|k| &from.0[at(k)]);
    let m: [&[f64]; K] = std::array::from_fn(|k| &from.1[at(k)]);
    let n: [&[f64]; K] = std::array::from_fn(|k| &from.2[at(k)]);
    let inv: [&[f64]; K] = std::array::from_fn(|k| &from.3[at(k)]);
    for x in 0..len {
        let (ps, pm, pn, pi) = if onto { (os[x], om[x], on[x], oi[x]) } else { (A::default(), 0.0, 0.0, 0.0) };
        let first = if onto { 0 } else { 1 };
        // A sum starts from its first term (not from 0), as sums alone do.
        let (mut sum, mut total, mut square) = if onto { (ps, pn, pm) } else { (s[0][x], n[0][x], m[0][x]) };
        for k in first..K {
            // SAFETY: every slice has `len` elements.
            unsafe {
                sum = sum.plus(*s[k].get_unchecked(x));
                total += *n[k].get_unchecked(x);
                square += *m[k].get_unchecked(x);
            }
        }
        let i = if total > 0.0 { 1.0 / total } else { 0.0 };
        let mean = sum.mean(total, i);
        if onto {
            let d = ps.deviation(pn, mean);
            square = (d * d).mul_add(pi, square);
        }
        for k in 0..K {
            // SAFETY: as above.
            let (s, n, i) = unsafe { (*s[k].get_unchecked(x), *n[k].get_unchecked(x), *inv[k].get_unchecked(x)) };
            let d = s.deviation(n, mean);
            square = (d * d).mul_add(i, square);
        }
        (os[x], om[x], on[x], oi[x]) = (sum, square, total, i);
    }
}
