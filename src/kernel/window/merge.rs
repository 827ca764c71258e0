//! Sums of floats and merges of (n, sum, M2), where M2 is the sum of squared deviations from the mean.
//!
//! A multiway form of Chan, Golub and LeVeque's update: with S = sum S_k, n = sum n_k and mean S/n,
//! `M2 = sum M2_k + sum (S_k - n_k S/n)^2 / n_k`. Nothing large is subtracted but means of neighbours, so a step of
//! 1e6 elsewhere in the tile, or in the window, costs no accuracy. The tree is that of [`super::lines`].

use super::columns::Columns;
use super::lines::{self, Add, Op, level_len, tree_levels};
use super::plan::Plain;
use crate::kernel::simd::Level;

/// Sum of f32 (f64) or of f64 (an unevaluated pair of f64).
pub trait Sum: Plain + Default + std::fmt::Debug + Columns<Self> {
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

    /// Copies the elements of `from` to `to` on.
    pub fn copy_within(&mut self, from: std::ops::Range<usize>, to: usize) {
        fn of<T: Copy>(s: &mut [T], from: std::ops::Range<usize>, to: usize) {
            if !s.is_empty() {
                s.copy_within(from, to);
            }
        }
        of(self.s, from.clone(), to);
        of(self.m, from.clone(), to);
        of(self.n, from.clone(), to);
        of(self.i, from, to);
    }

    pub fn clear(&mut self) {
        self.s.fill(A::default());
        self.m.fill(0.0);
        self.n.fill(0.0);
        self.i.fill(0.0);
    }
}

/// Which moments a pass carries besides the sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted {
    pub variance: bool,
    /// Counts per voxel, because some are missing.
    pub counts: bool,
}

impl Wanted {
    /// Sums alone.
    pub const SUMS: Wanted = Wanted { variance: false, counts: false };
}

/// What [`Moments`] holds, for reading.
#[derive(Clone, Copy)]
pub struct Held<'a, A> {
    s: &'a [A],
    m: &'a [f64],
    n: &'a [f64],
    i: &'a [f64],
}

impl<'a, A: Sum> Moments<'a, A> {
    pub fn held(&self) -> Held<'_, A> {
        Held { s: self.s, m: self.m, n: self.n, i: self.i }
    }

    /// Splits in front of element `at`.
    fn split(&mut self, at: usize) -> (Held<'_, A>, Moments<'_, A>) {
        fn of<T>(s: &mut [T], at: usize) -> (&[T], &mut [T]) {
            let (a, b) = s.split_at_mut(at.min(s.len()));
            (a, b)
        }
        let ((s0, s1), (m0, m1)) = (of(self.s, at), of(self.m, at));
        let ((n0, n1), (i0, i1)) = (of(self.n, at), of(self.i, at));
        (Held { s: s0, m: m0, n: n0, i: i0 }, Moments { s: s1, m: m1, n: n1, i: i1 })
    }
}

impl<A> Held<'_, A> {
    /// The elements from `at` on.
    fn tail(&self, at: usize) -> Self {
        fn of<T>(s: &[T], at: usize) -> &[T] {
            &s[at.min(s.len())..]
        }
        Held { s: of(self.s, at), m: of(self.m, at), n: of(self.n, at), i: of(self.i, at) }
    }
}

/// Joins windows of `from` at `i + offset` for every offset, and what `out` holds if `onto`, into `out[i]`.
fn join<A: Sum>(level: Level, wanted: Wanted, from: Held<A>, offsets: &[usize], out: &mut Moments<A>, onto: bool)
where
    Add: Op<A>,
{
    if wanted.variance {
        merge_at(level, from.s, from.m, from.n, from.i, offsets, out.s, out.m, out.n, out.i, onto);
        return;
    }
    lines::join_at(level, Add, from.s, offsets, out.s, onto);
    if wanted.counts {
        lines::join_at::<f64, Add>(level, Add, from.n, offsets, out.n, onto);
    }
}

/// Levels `from..` of a tree over windows of `w` elements `step` apart for `len` outputs, `pitch` apart in `work`.
/// Level 1 is joined from `src`, which only it needs.
#[allow(clippy::too_many_arguments)]
pub fn grow<A: Sum>(
    level: Level,
    wanted: Wanted,
    first: usize,
    src: Option<Held<A>>,
    w: usize,
    step: usize,
    len: usize,
    work: &mut Moments<A>,
) where
    Add: Op<A>,
{
    let pitch = len + w * step;
    for k in first..=tree_levels(w) {
        let size = step << (2 * (k - 1));
        let (below, mut this) = work.split((k - 1) * pitch);
        let from = if k == 1 { src.expect("level 1 needs voxels") } else { below.tail((k - 2) * pitch) };
        let offsets = [0, size, 2 * size, 3 * size];
        join(level, wanted, from, &offsets, &mut this.part(0..level_len(w, step, len, k)), false);
    }
}

/// Windows for outputs `start..start + out.len()` from the levels of [`grow`], all but the last digit where `src` is
/// `None`; returns how many elements of each window are joined.
#[allow(clippy::too_many_arguments)]
pub fn gather<A: Sum>(
    level: Level,
    wanted: Wanted,
    src: Option<Held<A>>,
    w: usize,
    step: usize,
    pitch: usize,
    start: usize,
    out: &mut Moments<A>,
    work: &Moments<A>,
) -> usize
where
    Add: Op<A>,
{
    let levels = tree_levels(w);
    let mut at = 0;
    for k in (0..=levels).rev() {
        let size = 1 << (2 * k);
        let digit = (w - at) / size;
        let mut offsets = [0; 8];
        for (j, o) in offsets[..digit].iter_mut().enumerate() {
            *o = start + (at + j * size) * step;
        }
        let from = match (k, src) {
            (0, None) => break,
            (0, Some(src)) => src,
            _ => work.held().tail((k - 1) * pitch),
        };
        join(level, wanted, from, &offsets[..digit], out, k < levels);
        at += digit * size;
    }
    at
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
    let len = out.s.len();
    grow(level, wanted, 1, Some(src.held()), w, step, len, work);
    gather(level, wanted, Some(src.held()), w, step, len + w * step, 0, out, work);
}

crate::multiversion! {
    fn merge_at[A: Sum](
        s: &[A], m: &[f64], n: &[f64], i: &[f64], offsets: &[usize],
        os: &mut [A], om: &mut [f64], on: &mut [f64], oi: &mut [f64], onto: bool
    ) -> () = merge_at_inner;
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn merge_at_inner<A: Sum>(
    s: &[A],
    m: &[f64],
    n: &[f64],
    i: &[f64],
    offsets: &[usize],
    os: &mut [A],
    om: &mut [f64],
    on: &mut [f64],
    oi: &mut [f64],
    onto: bool,
) {
    let (mut onto, mut rest) = (onto, offsets);
    macro_rules! arms {
        ($k:expr, $($n:literal)*) => {
            match ($k, onto) {
                $(($n, false) => merge_k::<A, $n, false>(s, m, n, i, rest, os, om, on, oi),
                  ($n, true) => merge_k::<A, $n, true>(s, m, n, i, rest, os, om, on, oi),)*
                _ => unreachable!("one to six terms"),
            }
        };
    }
    while !rest.is_empty() {
        let k = rest.len().min(6);
        arms!(k, 1 2 3 4 5 6);
        onto = true;
        rest = &rest[k..];
    }
}

#[inline(always)]
#[allow(clippy::too_many_arguments, clippy::needless_range_loop)]
fn merge_k<A: Sum, const K: usize, const ONTO: bool>(
    s: &[A],
    m: &[f64],
    n: &[f64],
    inv: &[f64],
    offsets: &[usize],
    os: &mut [A],
    om: &mut [f64],
    on: &mut [f64],
    oi: &mut [f64],
) {
    let len = os.len();
    let (om, on, oi) = (&mut om[..len], &mut on[..len], &mut oi[..len]);
    let mut at = [0; K];
    at.copy_from_slice(&offsets[..K]);
    for o in at {
        assert!(o + len <= s.len() && o + len <= m.len() && o + len <= n.len() && o + len <= inv.len());
    }
    for x in 0..len {
        let (mut sum, mut total, mut square) = (A::default(), 0.0, 0.0);
        if ONTO {
            (sum, total, square) = (os[x], on[x], om[x]);
        }
        for k in 0..K {
            // SAFETY: `at[k] + len` was compared with every length.
            let (s, n, m) =
                unsafe { (*s.get_unchecked(at[k] + x), *n.get_unchecked(at[k] + x), *m.get_unchecked(at[k] + x)) };
            // A sum starts from its first term, not from 0, as sums alone do.
            if k == 0 && !ONTO {
                (sum, total, square) = (s, n, m);
            } else {
                (sum, total, square) = (sum.plus(s), total + n, square + m);
            }
        }
        if K == 4 && !ONTO {
            // SAFETY: as above.
            let e: [A; K] = std::array::from_fn(|k| unsafe { *s.get_unchecked(at[k] + x) });
            sum = e[0].plus(e[1]).plus(e[2 % K].plus(e[3 % K])); // the order of sums alone
        }
        let i = 1.0 / total;
        let i = if total > 0.0 { i } else { 0.0 };
        let mean = sum.mean(total, i);
        if ONTO {
            let d = os[x].deviation(on[x], mean);
            square = (d * d).mul_add(oi[x], square);
        }
        for k in 0..K {
            // SAFETY: as above.
            let (s, n, i) =
                unsafe { (*s.get_unchecked(at[k] + x), *n.get_unchecked(at[k] + x), *inv.get_unchecked(at[k] + x)) };
            let d = s.deviation(n, mean);
            square = (d * d).mul_add(i, square);
        }
        (os[x], om[x], on[x], oi[x]) = (sum, square, total, i);
    }
}
