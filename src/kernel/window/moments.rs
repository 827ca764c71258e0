//! Moments of box windows along one axis, eight columns at a time, by the scheme of [`super::parts`].
//!
//! A pass reads lines of cells and writes the cells of windows. Counts are in lines: 1 for a line without missing voxels,
//! so that all weights come from one small table. M2 is kept times the voxels of a line; the pass multiplies it by the
//! lines of the window, which makes it right for the next axis.
//!
//! Along z a column is a voxel column of a row. Along y and x results are turned in registers: y leaves lines of x that
//! hold eight rows each, and x leaves rows, so that every axis is the same loop over contiguous eights.

use std::marker::PhantomData;

use super::merge::{self, Weight};
use super::parts::{BLOCK, OCTET, Parts, Weights, block, groups, octet};
use super::plan::cut;
use crate::brick::scratch::padded;
use crate::grid::Voxel;
use crate::kernel::lanes::{F64x8, LANES};
use crate::kernel::simd::Level;

/// Which moments a pass carries besides the sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted {
    /// Sums are pairs.
    pub pairs: bool,
    pub variance: bool,
    /// Counts per voxel, because some are missing.
    pub counts: bool,
}

/// Cells: sums, their low parts (for sums that are pairs), M2 and counts. Fields not wanted are empty.
pub struct Moments<'a> {
    pub s: &'a mut [f64],
    pub t: &'a mut [f64],
    pub m: &'a mut [f64],
    pub n: &'a mut [f64],
}

/// Applies `$of` to each field of a [`Moments`].
macro_rules! each {
    ($self:ident, |$field:ident| $of:expr) => {{
        let of = |$field: &mut [f64]| {
            if !$field.is_empty() {
                $of
            }
        };
        of(&mut *$self.s);
        of(&mut *$self.t);
        of(&mut *$self.m);
        of(&mut *$self.n);
    }};
}

impl<'a> Moments<'a> {
    pub fn cut(len: usize, wanted: Wanted, bytes: &mut &'a mut [u8]) -> Self {
        let mut of = |wanted: bool| cut(bytes, if wanted { len } else { 0 });
        Moments { s: of(true), t: of(wanted.pairs), m: of(wanted.variance), n: of(wanted.counts) }
    }

    pub fn bytes(len: usize, wanted: Wanted) -> usize {
        let fields = 1 + wanted.pairs as usize + wanted.variance as usize + wanted.counts as usize;
        fields * padded::<f64>(len)
    }

    pub fn held(&self) -> Held<'_> {
        Held { s: self.s, t: self.t, m: self.m, n: self.n }
    }

    /// The elements of `range`.
    pub fn part(&mut self, range: std::ops::Range<usize>) -> Moments<'_> {
        fn of(s: &mut [f64], range: std::ops::Range<usize>) -> &mut [f64] {
            if s.is_empty() { s } else { &mut s[range] }
        }
        Moments {
            s: of(self.s, range.clone()),
            t: of(self.t, range.clone()),
            m: of(self.m, range.clone()),
            n: of(self.n, range),
        }
    }

    /// Copies the elements of `from` to `to` on.
    pub fn copy_within(&mut self, from: std::ops::Range<usize>, to: usize) {
        each!(self, |field| field.copy_within(from.clone(), to));
    }

    pub fn clear(&mut self) {
        each!(self, |field| field.fill(0.0));
    }
}

/// What [`Moments`] holds, for reading.
#[derive(Clone, Copy, Default)]
pub struct Held<'a> {
    s: &'a [f64],
    t: &'a [f64],
    m: &'a [f64],
    n: &'a [f64],
}

impl Held<'_> {
    /// The elements from `at` on.
    pub fn tail(&self, at: usize) -> Self {
        use super::plan::tail;
        Held { s: tail(self.s, at), t: tail(self.t, at), m: tail(self.m, at), n: tail(self.n, at) }
    }
}

/// Where results of output `8 b + k` and column `x` go: `b * block + x * column + k * output`, or, where a pass turns its
/// results, `b * block + x * column + k`, and lane `i` of a column of eight at `i * output` more.
#[derive(Debug, Clone, Copy)]
pub struct Layout {
    pub block: usize,
    pub column: usize,
    pub output: usize,
}

/// One pass over the lines of an axis.
pub struct Pass<'a> {
    /// Line `i` of column `x` is at `i * pitch + x`.
    pub lines: Held<'a>,
    pub pitch: usize,
    pub window: usize,
    /// Blocks to make.
    pub blocks: std::ops::Range<usize>,
    /// A multiple of [`LANES`].
    pub columns: usize,
    pub weights: &'a Weights<'a>,
    /// Lines that exist in the window of each output: M2 is multiplied and the count divided by it.
    pub counts: &'a [f64],
    pub layout: Layout,
}

/// Elements of a pass's groups.
pub fn groups_len(w: usize, blocks: usize) -> usize {
    if groups(w) == 0 { 0 } else { LANES * (blocks + groups(w)) }
}

/// Voxels of which lines are made, f32 (sums are one f64) or f64 (sums are pairs).
pub trait First: Voxel {
    /// Over lines of `voxels`, not of `pass.lines`; NaN is a missing voxel where counts are wanted. Results stay in the
    /// order of the lines.
    fn pass(level: Level, wanted: Wanted, voxels: &[Self], pass: &Pass, work: &mut Moments, out: &mut Moments);
}

/// Calls `run_at` for the M2 and counts that are wanted.
macro_rules! run {
    ($t:ty, $first:literal, $pairs:literal, $wanted:ident, $($arg:expr),*) => {
        match ($wanted.variance, $wanted.counts) {
            (false, false) => run_at::<$t, $first, $pairs, false, false>($($arg),*),
            (true, false) => run_at::<$t, $first, $pairs, true, false>($($arg),*),
            (false, true) => run_at::<$t, $first, $pairs, false, true>($($arg),*),
            (true, true) => run_at::<$t, $first, $pairs, true, true>($($arg),*),
        }
    };
}

macro_rules! first {
    ($t:ty, $pairs:literal) => {
        impl First for $t {
            fn pass(level: Level, wanted: Wanted, voxels: &[$t], pass: &Pass, work: &mut Moments, out: &mut Moments) {
                assert_eq!(wanted.pairs, $pairs, "sums of {}", Self::DTYPE);
                run!($t, true, $pairs, wanted, level, voxels, pass, work, out)
            }
        }
    };
}
first!(f32, false);
first!(f64, true);

/// Over lines of cells; results are turned.
pub fn pass_turned(level: Level, wanted: Wanted, pass: &Pass, work: &mut Moments, out: &mut Moments) {
    match wanted.pairs {
        false => run!(f64, false, false, wanted, level, &[], pass, work, out),
        true => run!(f64, false, true, wanted, level, &[], pass, work, out),
    }
}

crate::on_lanes! {
    /// `P`, `V` and `N` say whether sums are pairs and whether M2 and counts are carried.
    fn run_at[T: Voxel, const FIRST: bool, const P: bool, const V: bool, const N: bool](
        voxels: &[T], pass: &Pass, work: &mut Moments, out: &mut Moments
    ) = run_inner[T, FIRST, P, V, N];
}

#[inline(always)]
fn run_inner<L: F64x8, T: Voxel, const FIRST: bool, const P: bool, const V: bool, const N: bool>(
    voxels: &[T],
    pass: &Pass,
    work: &mut Moments,
    out: &mut Moments,
) {
    let Pass { lines, pitch, window, weights, counts, layout, .. } = *pass;
    let (from, to) = (pass.blocks.start, pass.blocks.end);
    if from >= to || pass.columns == 0 {
        return;
    }
    let most = (BLOCK * to + window - 2) * pitch + pass.columns;
    let holds = |len: usize, wanted: bool, most: usize| !wanted || len >= most;
    assert!(pass.columns.is_multiple_of(LANES) && counts.len() >= BLOCK * to);
    let fits = |h: Held, most: usize| {
        h.s.len() >= most && holds(h.t.len(), P, most) && holds(h.m.len(), V, most) && holds(h.n.len(), N, most)
    };
    assert!(if FIRST { T::DTYPE.is_float() && voxels.len() >= most } else { fits(lines, most) });
    let room = groups_len(window, to);
    let last = (to - 1) * layout.block + (pass.columns - LANES) * layout.column + 7 * layout.output + LANES;
    assert!(fits(work.held(), room) && fits(out.held(), last));
    for x in (0..pass.columns).step_by(LANES) {
        if groups(window) > 0 {
            for q in from + 1..to + groups(window) {
                let weights = if N { &[][..] } else { weights.of_group(q) };
                assert!(N || weights.len() >= OCTET);
                let start = q * BLOCK * pitch + x;
                let (groups, group, at, lanes) = (lines, 0, 0, PhantomData);
                let mut parts =
                    Cells::<L, T, FIRST, P, V, N> { voxels, lines, groups, start, pitch, group, weights, at, lanes };
                let cell = octet(&mut parts);
                // SAFETY: `work` holds `room` elements.
                unsafe { cell.store::<P, V, N>(work, q * LANES) };
            }
        }
        for b in from..to {
            let weights = if N { &[][..] } else { weights.of_block(b) };
            assert!(N || weights.len() >= super::parts::merges(window));
            let (start, group) = (b * BLOCK * pitch + x, b * LANES);
            let (groups, at, lanes) = (work.held(), 0, PhantomData);
            let mut parts =
                Cells::<L, T, FIRST, P, V, N> { voxels, lines, groups, start, pitch, group, weights, at, lanes };
            let mut cells = block(&mut parts, window);
            for (k, cell) in cells.iter_mut().enumerate() {
                cell.settle::<V, N>(counts[b * BLOCK + k]);
            }
            let base = b * layout.block + x * layout.column;
            if !FIRST {
                Cell::turn::<P, V, N>(&mut cells);
            }
            for (k, cell) in cells.iter().enumerate() {
                // SAFETY: the last of these places was compared with the lengths above.
                unsafe { cell.store::<P, V, N>(out, base + k * layout.output) };
            }
        }
    }
}

/// Eight columns of one line, group or window.
#[derive(Clone, Copy)]
struct Cell<L> {
    s: L,
    t: L,
    m: L,
    n: L,
}

/// Turns one field of eight cells, if it is wanted. A macro, as what calls vectors must be inlined whatever the compiler
/// thinks of its size: a closure here was once left out of line, for 4 times the time of a variance.
macro_rules! turned {
    ($cells:ident, $field:ident, $wanted:expr) => {
        if $wanted {
            let [a, b, c, d, e, f, g, h] = $cells;
            let rows = L::turn([a.$field, b.$field, c.$field, d.$field, e.$field, f.$field, g.$field, h.$field]);
            let [i, j, k, l, m, n, o, p] = rows;
            (a.$field, b.$field, c.$field, d.$field) = (i, j, k, l);
            (e.$field, f.$field, g.$field, h.$field) = (m, n, o, p);
        }
    };
}

impl<L: F64x8> Cell<L> {
    /// # Safety
    /// Eight elements from `start` on lie in the fields that are read.
    #[inline(always)]
    unsafe fn load<const P: bool, const V: bool, const N: bool>(from: &Held, start: usize) -> Self {
        // SAFETY: the caller's promise.
        unsafe {
            Cell {
                s: load_if(true, from.s, start),
                t: load_if(P, from.t, start),
                m: load_if(V, from.m, start),
                n: load_if(N, from.n, start),
            }
        }
    }

    /// # Safety
    /// Eight elements from `start` on lie in the fields that are wanted.
    #[inline(always)]
    unsafe fn store<const P: bool, const V: bool, const N: bool>(&self, to: &mut Moments, start: usize) {
        // SAFETY: the caller's promise.
        unsafe {
            store_if(true, self.s, to.s, start);
            store_if(P, self.t, to.t, start);
            store_if(V, self.m, to.m, start);
            store_if(N, self.n, to.n, start);
        }
    }

    /// Units of the next axis, for a window of `count` lines.
    #[inline(always)]
    fn settle<const V: bool, const N: bool>(&mut self, count: f64) {
        if V {
            self.m = self.m.times(L::splat(count));
        }
        if N {
            self.n = self.n.over(L::splat(count));
        }
    }

    /// Columns become outputs and outputs columns.
    #[inline(always)]
    fn turn<const P: bool, const V: bool, const N: bool>(cells: &mut [Cell<L>; BLOCK]) {
        turned!(cells, s, true);
        turned!(cells, t, P);
        turned!(cells, m, V);
        turned!(cells, n, N);
    }
}

/// # Safety
/// Eight elements from `start` on lie in `field` if they are wanted.
#[inline(always)]
unsafe fn load_if<L: F64x8>(wanted: bool, field: &[f64], start: usize) -> L {
    // SAFETY: the caller's promise.
    if wanted { unsafe { L::load(field.as_ptr().add(start)) } } else { L::splat(0.0) }
}

/// # Safety
/// Eight elements from `start` on lie in `field` if they are wanted.
#[inline(always)]
unsafe fn store_if<L: F64x8>(wanted: bool, v: L, field: &mut [f64], start: usize) {
    if wanted {
        // SAFETY: the caller's promise.
        unsafe { v.store(field.as_mut_ptr().add(start)) }
    }
}

/// Lines and groups of one column of eight.
struct Cells<'a, L, T, const FIRST: bool, const P: bool, const V: bool, const N: bool> {
    voxels: &'a [T],
    lines: Held<'a>,
    groups: Held<'a>,
    /// Where line 0 and group 0 are.
    start: usize,
    pitch: usize,
    group: usize,
    weights: &'a [Weight],
    at: usize,
    lanes: PhantomData<L>,
}

impl<L: F64x8, T: Voxel, const FIRST: bool, const P: bool, const V: bool, const N: bool> Parts
    for Cells<'_, L, T, FIRST, P, V, N>
{
    type Part = Cell<L>;

    #[inline(always)]
    fn line(&self, i: usize) -> Cell<L> {
        let start = self.start + i * self.pitch;
        // SAFETY: `run_inner` compared the last line of the last block with the lengths.
        unsafe {
            if !FIRST {
                return Cell::load::<P, V, N>(&self.lines, start);
            }
            let from = self.voxels.as_ptr().add(start);
            // `T` is f32 or f64.
            let v = if size_of::<T>() == 4 { L::load_f32(from.cast()) } else { L::load(from.cast()) };
            let none = L::splat(0.0);
            let [s, n] = if N { v.present() } else { [v, none] };
            Cell { s, t: none, m: none, n }
        }
    }

    #[inline(always)]
    fn group(&self, q: usize) -> Cell<L> {
        // SAFETY: `run_inner` made all groups that its blocks ask for.
        unsafe { Cell::load::<P, V, N>(&self.groups, self.group + q * LANES) }
    }

    #[inline(always)]
    fn merge(&mut self, a: Cell<L>, b: Cell<L>) -> Cell<L> {
        // SAFETY: a block has as many merges as weights (checked where `self` is made); not read where `N`.
        let weight = match V && !N {
            true => merge::splat(unsafe { self.weights.get_unchecked(self.at) }),
            false => merge::weigh(a.n, b.n),
        };
        self.at += 1;
        let mut out = a;
        if V {
            let base = a.m.plus(b.m);
            out.m = match P {
                true => merge::spread_pairs([a.s, a.t], [b.s, b.t], &weight, base),
                false => merge::spread(a.s, b.s, &weight, base),
            };
        }
        if N {
            out.n = a.n.plus(b.n);
        }
        if P {
            [out.s, out.t] = merge::plus_pairs([a.s, a.t], [b.s, b.t]);
        } else {
            out.s = a.s.plus(b.s);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::window::parts::Axis;

    /// One axis against sums by the definition, voxel columns of `extent` lines, with and without missing ones.
    #[test]
    fn windows_hold_the_moments_of_their_lines() {
        for (window, extent) in [(1, 3), (3, 9), (7, 20), (9, 30), (21, 50), (21, 13), (41, 90)] {
            for missing in [false, true] {
                let blocks = usize::div_ceil(extent, BLOCK);
                let axis = Axis { first: -(window as isize / 2), extent, window, blocks };
                let wanted = Wanted { pairs: false, variance: true, counts: missing };
                let columns = 16;
                let there = |z: usize, x: usize| !missing || (z * 7 + x) % 5 > 1;
                let value = |z: usize, x: usize| 1e5 + ((z * 31 + x * 17) % 23) as f64; // exact in f32
                // Where counts are wanted, what does not exist is missing.
                let mut lines = vec![if missing { f32::NAN } else { 0.0 }; (BLOCK * blocks + window - 1) * columns];
                for (i, z) in (0..BLOCK * blocks + window - 1).map(|i| (i, i as isize + axis.first)) {
                    for x in 0..columns {
                        if (0..extent as isize).contains(&z) && there(z as usize, x) {
                            lines[i * columns + x] = value(z as usize, x) as f32;
                        }
                    }
                }
                let [g, b, k] = Weights::lens(window, blocks);
                let (mut g, mut b, mut k) = (vec![Weight::default(); g], vec![Weight::default(); b], vec![0; k]);
                let mut weights = Weights::new(window, &mut g, &mut b, &mut k);
                weights.fill(axis);
                let counts: Vec<f64> = (0..BLOCK * blocks).map(|k| axis.count(k)).collect();
                let mut first: Option<Vec<Vec<f64>>> = None;
                for level in Level::available() {
                    let make = |len: usize| vec![vec![7.0; len]; 3];
                    let (mut work, mut out) = (make(groups_len(window, blocks)), make(BLOCK * blocks * columns));
                    fn of(v: &mut [Vec<f64>]) -> Moments<'_> {
                        let [s, m, n] = v else { unreachable!() };
                        Moments { s, t: &mut [], m, n }
                    }
                    let pass = Pass {
                        lines: Held::default(),
                        pitch: columns,
                        window,
                        blocks: 0..blocks,
                        columns,
                        weights: &weights,
                        counts: &counts,
                        layout: Layout { block: BLOCK * columns, column: 1, output: columns },
                    };
                    f32::pass(level, wanted, &lines, &pass, &mut of(&mut work), &mut of(&mut out));
                    for (o, x) in (0..extent).flat_map(|o| (0..columns).map(move |x| (o, x))) {
                        let (lo, hi) = (o.saturating_sub(window / 2), (o + window / 2 + 1).min(extent));
                        let v: Vec<f64> = (lo..hi).filter(|z| there(*z, x)).map(|z| value(z, x)).collect();
                        let (count, sum) = (v.len() as f64, v.iter().sum::<f64>());
                        let m2: f64 = v.iter().map(|u| (u - sum / count.max(1.0)).powi(2)).sum();
                        let [s, m, n] = [0, 1, 2].map(|f| out[f][o * columns + x]);
                        assert_eq!(s, sum);
                        let m = m / (hi - lo) as f64;
                        assert!((m - m2).abs() <= 1e-8 * m2 + 1e-9, "{level:?} {window} {o}: {m} for {m2}");
                        assert!(!missing || (n * (hi - lo) as f64).round() == count);
                    }
                    match &first {
                        None => first = Some(out),
                        Some(first) => assert_eq!(first, &out, "{level:?}"),
                    }
                }
            }
        }
    }
}
