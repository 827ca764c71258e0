//! One row of cells at a time: the loops that [`super::Cells`] runs.

use crate::brick::scratch::cut;
use crate::grid::Voxel;
use crate::kernel::simd::Level;
use crate::stage::Reduce;

/// Rows of f64 that [`Children`] and [`merge`] take from the scratch.
pub const SCRATCH_ROWS: usize = 4 * 4 + 2;

/// The up to four rows that a row of cells is merged from, with room to change them.
pub struct Children<'a> {
    pub n: usize,
    rows: [[&'a mut [f64]; 4]; 4],
    line: &'a mut [f64],
    up: &'a mut [f64],
}

impl<'a> Children<'a> {
    pub fn new(scratch: &'a mut [u8], n: usize, width: usize) -> Children<'a> {
        let mut rest = scratch;
        let mut next = || {
            let (row, tail) = cut::<f64>(std::mem::take(&mut rest), width);
            rest = tail;
            row
        };
        let rows = std::array::from_fn(|_| std::array::from_fn(|_| next()));
        Children { n, rows, line: next(), up: next() }
    }

    /// Value, mark, inner and between of row `r`.
    pub fn row(&mut self, r: usize) -> [&mut [f64]; 4] {
        self.rows[r].each_mut().map(|f| &mut **f)
    }

    fn field(&self, f: usize) -> [&[f64]; 4] {
        self.rows.each_ref().map(|r| &*r[f])
    }
}

/// Element types whose sums of four rows and two voxels fit an integer are summed as such, which is exact either way.
pub trait Summed: Voxel {
    type Wide: Voxel + std::ops::Add<Output = Self::Wide>;
    fn wide(self) -> Self::Wide;
}

macro_rules! summed {
    ($($t:ty => $w:ty),*) => {$(
        impl Summed for $t {
            type Wide = $w;
            #[inline(always)]
            fn wide(self) -> $w { self as $w }
        }
    )*};
}
summed!(u8 => i32, i8 => i32, u16 => i32, i16 => i32, u32 => f64, i32 => f64, f32 => f64, f64 => f64);

/// Makes a row of cells straight from up to four rows of voxels or of cells that all count. False where that gave a NaN
/// that the general way may have to mend, and always for moments. `line` is scratch of one row.
pub fn direct<S: Summed>(
    level: Level,
    kind: Reduce,
    rows: &[&[S]],
    halve_x: bool,
    line: &mut [f64],
    out: &mut [f64],
) -> bool {
    match kind {
        Reduce::Mean => {
            // SAFETY: `Wide` is i32 or f64, both plain numbers no larger and no stricter aligned than f64.
            let line = unsafe { std::slice::from_raw_parts_mut(line.as_mut_ptr().cast::<S::Wide>(), line.len()) };
            sum(level, rows, halve_x, line, out)
        }
        Reduce::Min => extreme(level, false, rows, halve_x, out),
        Reduce::Max => extreme(level, true, rows, halve_x, out),
        Reduce::Stride => {
            out.iter_mut().enumerate().for_each(|(i, d)| *d = rows[0][i << usize::from(halve_x)].to_f64());
            !out.iter().any(|v| v.is_nan())
        }
        Reduce::Moments => false,
    }
}

/// Joins the rows in the fixed tree, `f(accumulated, other)`, voxel by voxel.
#[inline(always)]
fn vertical<S: Copy, W: Copy>(rows: &[&[S]], line: &mut [W], wide: impl Fn(S) -> W, f: impl Fn(W, W) -> W) {
    let n = line.len();
    match *rows {
        [a] => line.iter_mut().zip(a).for_each(|(d, a)| *d = wide(*a)),
        [a, b] => {
            let (a, b) = (&a[..n], &b[..n]);
            (0..n).for_each(|i| line[i] = f(wide(a[i]), wide(b[i])));
        }
        [a, b, c, e] => {
            let (a, b, c, e) = (&a[..n], &b[..n], &c[..n], &e[..n]);
            (0..n).for_each(|i| line[i] = f(f(wide(a[i]), wide(b[i])), f(wide(c[i]), wide(e[i]))));
        }
        _ => unreachable!("a cell covers one, two or four rows"),
    }
}

/// Joins neighbours along x; the last cell of an odd row has one voxel.
#[inline(always)]
fn pairs<W: Voxel>(line: &[W], halve_x: bool, out: &mut [f64], f: impl Fn(W, W) -> W) {
    if !halve_x {
        out.iter_mut().zip(line).for_each(|(d, v)| *d = v.to_f64());
        return;
    }
    let (two, one) = line.as_chunks::<2>();
    out.iter_mut().zip(two).for_each(|(d, [a, b])| *d = f(*a, *b).to_f64());
    if let Some(v) = one.first() {
        out[two.len()] = v.to_f64();
    }
}

#[inline(always)]
fn sum_inner<S: Summed>(rows: &[&[S]], halve_x: bool, line: &mut [S::Wide], out: &mut [f64]) -> bool {
    vertical(rows, line, S::wide, |a, b| a + b);
    pairs(line, halve_x, out, |a, b| a + b);
    !out.iter().fold(false, |nan, v| nan | v.is_nan())
}

crate::multiversion! {
    fn sum[S: Summed](rows: &[&[S]], halve_x: bool, line: &mut [S::Wide], out: &mut [f64]) -> bool = sum_inner;
}

/// The greater or lesser; NaN only if both are.
#[inline(always)]
fn pick<S: Voxel, const MAX: bool>(a: S, b: S) -> S {
    #[allow(clippy::eq_op)]
    let a_is_nan = a != a;
    let better = if MAX { b > a } else { b < a };
    if better | a_is_nan { b } else { a }
}

#[inline(always)]
fn extreme_of<S: Voxel, const MAX: bool>(rows: &[&[S]], halve_x: bool, out: &mut [f64]) -> bool {
    // A short stretch at a time, so that the joined rows stay in registers or L1 without scratch of type S.
    const STEP: usize = 128;
    let width = rows[0].len();
    let mut line = [S::default(); STEP];
    for x in (0..width).step_by(STEP) {
        let n = STEP.min(width - x);
        let mut cut = [rows[0]; 4];
        rows.iter().zip(&mut cut).for_each(|(r, c)| *c = &r[x..x + n]);
        vertical(&cut[..rows.len()], &mut line[..n], |v| v, pick::<S, MAX>);
        let first = x >> usize::from(halve_x);
        pairs(&line[..n], halve_x, &mut out[first..], pick::<S, MAX>);
    }
    true
}

#[inline(always)]
fn extreme_inner<S: Voxel>(max: bool, rows: &[&[S]], halve_x: bool, out: &mut [f64]) -> bool {
    if max { extreme_of::<S, true>(rows, halve_x, out) } else { extreme_of::<S, false>(rows, halve_x, out) }
}

crate::multiversion! {
    fn extreme[S: Voxel](max: bool, rows: &[&[S]], halve_x: bool, out: &mut [f64]) -> bool = extreme_inner;
}

/// Takes voxels that do not count out of the sums: value, variance and count become 0 (the sign of the mark stays). For
/// the other kinds the NaN itself says so.
pub fn drop_invalid(kind: Reduce, value: &mut [f64], mark: &mut [f64], inner: &mut [f64]) {
    let out = |v: &mut f64, m: &mut f64| {
        *v = 0.0;
        *m *= 0.0;
    };
    match kind {
        Reduce::Mean => {
            value.iter_mut().zip(mark).filter(|(v, _)| v.is_nan()).for_each(|(v, m)| out(v, m));
        }
        Reduce::Moments => {
            for ((v, m), i) in value.iter_mut().zip(mark).zip(inner) {
                if v.is_nan() | i.is_nan() {
                    out(v, m);
                    *i = 0.0;
                }
            }
        }
        Reduce::Min | Reduce::Max | Reduce::Stride => {}
    }
}

/// Takes excluded children out of every cell that covers others, and flags (-1 in `sign`, else 1) those that do not.
fn select(kind: Reduce, children: &mut Children, halve_x: bool, sign: &mut [f64]) {
    let width = children.line.len();
    let signs = children.rows[..children.n].iter().flat_map(|r| r[1].iter());
    let (any, all) =
        signs.fold((false, true), |(any, all), m| (any | m.is_sign_negative(), all & m.is_sign_negative()));
    if !any || all {
        return sign.fill(if all { -1.0 } else { 1.0 });
    }
    let dropped = if matches!(kind, Reduce::Mean | Reduce::Moments) { 0.0 } else { f64::NAN };
    for (c, sign) in sign.iter_mut().enumerate() {
        let lo = c << usize::from(halve_x);
        let span = lo..(lo + 1 + usize::from(halve_x)).min(width);
        let rows = &mut children.rows[..children.n];
        let needed = |m: &f64| m.is_sign_positive();
        let any = rows.iter().any(|r| r[1][span.clone()].iter().any(needed));
        *sign = if any { 1.0 } else { -1.0 };
        for row in rows.iter_mut().filter(|_| any) {
            for x in span.clone() {
                if row[1][x].is_sign_positive() {
                    continue;
                }
                row[0][x] = dropped;
                row[1][x] = 0.0;
                row[2][x] = 0.0;
                row[3][x] = 0.0;
            }
        }
    }
}

/// Makes a row of cells from any children, with NaN, masks and moments.
#[allow(clippy::too_many_arguments)]
pub fn merge(
    level: Level,
    kind: Reduce,
    children: &mut Children,
    halve_x: bool,
    value: &mut [f64],
    mark: &mut [f64],
    inner: &mut [f64],
    between: &mut [f64],
) {
    // `mark` holds the signs until the counts are known.
    select(kind, children, halve_x, mark);
    let n = children.n;
    for row in &mut children.rows[..n] {
        row[1].iter_mut().for_each(|m| *m = m.abs());
    }
    match kind {
        Reduce::Mean => general_sum(level, children, 0, halve_x, value),
        Reduce::Min => drop(extreme(level, false, &children.field(0)[..n], halve_x, value)),
        Reduce::Max => drop(extreme(level, true, &children.field(0)[..n], halve_x, value)),
        Reduce::Stride => first_valid(children, halve_x, value),
        Reduce::Moments => {
            general_sum(level, children, 0, halve_x, value);
            general_sum(level, children, 2, halve_x, inner);
        }
    }
    // The signs wait in `up` (cells are never more than their children).
    let mut signs = std::mem::take(&mut children.up);
    signs[..mark.len()].copy_from_slice(mark);
    general_sum(level, children, 1, halve_x, mark);
    if kind == Reduce::Moments {
        deviations(level, children, halve_x, value, mark, between);
    }
    mark.iter_mut().zip(signs.iter()).for_each(|(m, s)| *m = m.copysign(*s));
    children.up = std::mem::take(&mut signs);
}

fn general_sum(level: Level, children: &mut Children, field: usize, halve_x: bool, out: &mut [f64]) {
    let line = std::mem::take(&mut children.line);
    sum(level, &children.field(field)[..children.n], halve_x, line, out);
    children.line = line;
}

/// The first voxel in z, y, x order that is not NaN.
fn first_valid(children: &Children, halve_x: bool, out: &mut [f64]) {
    let width = children.line.len();
    for (c, d) in out.iter_mut().enumerate() {
        let lo = c << usize::from(halve_x);
        let span = lo..(lo + 1 + usize::from(halve_x)).min(width);
        let mut all = children.rows[..children.n].iter().flat_map(|r| &r[0][span.clone()]);
        *d = *all.find(|v| !v.is_nan()).unwrap_or(&f64::NAN);
    }
}

/// Sum over the children of their own deviations plus n (mean - the cell's mean)^2: positive terms only.
fn deviations(level: Level, children: &mut Children, halve_x: bool, sums: &[f64], counts: &[f64], out: &mut [f64]) {
    for r in 0..children.n {
        let [value, mark, _, between] = children.row(r);
        spread(level, value, mark, halve_x, sums, counts, between);
    }
    general_sum(level, children, 3, halve_x, out);
}

#[inline(always)]
fn mean_of(sum: f64, count: f64) -> f64 {
    if count > 0.0 { sum / count } else { 0.0 }
}

#[inline(always)]
fn spread_inner(value: &[f64], mark: &[f64], halve_x: bool, sums: &[f64], counts: &[f64], between: &mut [f64]) {
    let term = |v: f64, m: f64, mean: f64| {
        let d = mean_of(v, m) - mean;
        m * (d * d)
    };
    if !halve_x {
        for x in 0..between.len() {
            between[x] += term(value[x], mark[x], mean_of(sums[x], counts[x]));
        }
        return;
    }
    for (c, two) in between.chunks_mut(2).enumerate() {
        let mean = mean_of(sums[c], counts[c]);
        for (i, b) in two.iter_mut().enumerate() {
            *b += term(value[2 * c + i], mark[2 * c + i], mean);
        }
    }
}

crate::multiversion! {
    fn spread[](value: &[f64], mark: &[f64], halve_x: bool, sums: &[f64], counts: &[f64], between: &mut [f64]) -> () = spread_inner;
}

/// The cells' values: means, variances or their roots, extremes; NaN where no voxel counted.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn values_inner(
    kind: Reduce,
    std: bool,
    value: &[f64],
    count: &[f64],
    inner: &[f64],
    between: &[f64],
    out: &mut [f64],
) {
    match kind {
        Reduce::Mean => {
            for ((d, v), n) in out.iter_mut().zip(value).zip(count) {
                *d = v / n.abs();
            }
        }
        Reduce::Moments => {
            for (((d, i), b), n) in out.iter_mut().zip(inner).zip(between).zip(count) {
                let variance = i / n.abs() + b / n.abs();
                *d = if std { variance.sqrt() } else { variance };
            }
        }
        Reduce::Min | Reduce::Max | Reduce::Stride => out.copy_from_slice(value),
    }
    // One NaN, whatever sign and payload the sums left.
    out.iter_mut().for_each(|d| *d = if d.is_nan() { f64::NAN } else { *d });
}

crate::multiversion! {
    pub fn values[](kind: Reduce, std: bool, value: &[f64], count: &[f64], inner: &[f64], between: &[f64], out: &mut [f64]) -> () = values_inner;
}
