//! One row of cells at a time: the loops that [`super::Cells`] runs.

use crate::brick::scratch::cut;
use crate::grid::Voxel;
use crate::kernel::simd::Level;
use crate::stage::Reduce;

/// Rows of f64 that [`Children`] and [`merge`] take from the scratch.
pub const SCRATCH_ROWS: usize = 4 * 4 + 3;

/// The up to four rows that a row of cells is merged from, with room to change them.
pub struct Children<'a> {
    pub n: usize,
    rows: [[&'a mut [f64]; 4]; 4],
    /// Working rows: joined rows, a value per cell spread over its voxels, signs of the cells.
    line: &'a mut [f64],
    up: &'a mut [f64],
    signs: &'a mut [f64],
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
        Children { n, rows, line: next(), up: next(), signs: next() }
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
            let n = line.len();
            sum(level, rows, halve_x, &mut bytemuck::cast_slice_mut::<_, S::Wide>(line)[..n], out)
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

/// The square with the sign of `v`: a standard deviation has none, but the fill of excluded voxels may, and comes back by
/// [`signed_root`].
#[inline(always)]
pub(super) fn signed_square(v: f64) -> f64 {
    v * v.abs()
}

#[inline(always)]
pub(super) fn signed_root(v: f64) -> f64 {
    v.abs().sqrt().copysign(v)
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn moments_inner<S: Voxel, M: Voxel>(
    variance: &[&[S]],
    mean: &[&[M]],
    std: bool,
    halve_x: bool,
    counts: &[f64],
    [line, up]: [&mut [f64]; 2],
    [value, inner, between]: [&mut [f64]; 3],
) -> bool {
    let add = |a: f64, b: f64| a + b;
    match std {
        true => vertical(variance, line, |v| signed_square(v.to_f64()), add),
        false => vertical(variance, line, S::to_f64, add),
    }
    pairs(line, halve_x, inner, add);
    vertical(mean, line, M::to_f64, add);
    pairs(line, halve_x, value, add);
    // The cells' means, for as long as it takes to spread them, where the deviations go.
    means_inner(value, counts, halve_x, between, up);
    let n = line.len();
    let up = &up[..n];
    let square = |v: M, x: usize| (v.to_f64() - up[x]) * (v.to_f64() - up[x]);
    match *mean {
        [a] => (0..n).for_each(|x| line[x] = square(a[x], x)),
        [a, b] => {
            let (a, b) = (&a[..n], &b[..n]);
            (0..n).for_each(|x| line[x] = square(a[x], x) + square(b[x], x));
        }
        [a, b, c, d] => {
            let (a, b, c, d) = (&a[..n], &b[..n], &c[..n], &d[..n]);
            let four = |x: usize| (square(a[x], x) + square(b[x], x)) + (square(c[x], x) + square(d[x], x));
            (0..n).for_each(|x| line[x] = four(x));
        }
        _ => unreachable!("a cell covers one, two or four rows"),
    }
    pairs(line, halve_x, between, add);
    !inner.iter().zip(between).fold(false, |nan, (i, b)| nan | i.is_nan() | b.is_nan())
}

crate::multiversion! {
    /// Moments straight from up to four rows of voxels that all count; false where that gave a NaN. The arrays are rows
    /// of scratch (voxels), then value, inner and between (cells).
    pub fn moments[S: Voxel, M: Voxel](
        variance: &[&[S]], mean: &[&[M]], std: bool, halve_x: bool, counts: &[f64],
        scratch: [&mut [f64]; 2], out: [&mut [f64]; 3],
    ) -> bool = moments_inner;
}

#[inline(always)]
fn widen_inner<T: Voxel>(from: &[T], to: &mut [f64]) {
    to.iter_mut().zip(from).for_each(|(d, s)| *d = s.to_f64());
}

crate::multiversion! {
    /// Voxels as f64.
    pub fn widen[T: Voxel](from: &[T], to: &mut [f64]) -> () = widen_inner;
}

#[inline(always)]
fn marks_inner(needed: &[u8], mark: &mut [f64]) {
    mark.iter_mut().zip(needed).for_each(|(m, n)| *m = if *n != 0 { 1.0 } else { -1.0 });
}

crate::multiversion! {
    /// One voxel each, negative where `needed` is 0.
    pub fn marks[](needed: &[u8], mark: &mut [f64]) -> () = marks_inner;
}

#[inline(always)]
fn drop_inner(value: &mut [f64], mark: &mut [f64], inner: Option<&mut [f64]>) {
    let n = value.len();
    let (value, mark) = (&mut value[..n], &mut mark[..n]);
    match inner {
        None => {
            for (v, m) in value.iter_mut().zip(mark) {
                let bad = v.is_nan();
                *v = if bad { 0.0 } else { *v };
                *m = if bad { *m * 0.0 } else { *m };
            }
        }
        Some(inner) => {
            for ((v, m), i) in value.iter_mut().zip(mark).zip(&mut inner[..n]) {
                let bad = v.is_nan() | i.is_nan();
                *v = if bad { 0.0 } else { *v };
                *i = if bad { 0.0 } else { *i };
                *m = if bad { *m * 0.0 } else { *m };
            }
        }
    }
}

crate::multiversion! {
    /// Takes voxels that do not count out of the sums: value, variance and count become 0 (the sign of the mark stays).
    fn drop_nan[](value: &mut [f64], mark: &mut [f64], inner: Option<&mut [f64]>) -> () = drop_inner;
}

/// Makes voxels that are NaN not count. For kinds other than Mean and Moments the NaN itself says so.
pub fn drop_invalid(level: Level, kind: Reduce, value: &mut [f64], mark: &mut [f64], inner: &mut [f64]) {
    match kind {
        Reduce::Mean => drop_nan(level, value, mark, None),
        Reduce::Moments => drop_nan(level, value, mark, Some(inner)),
        Reduce::Min | Reduce::Max | Reduce::Stride => {}
    }
}

/// A value per cell to each of its voxels.
#[inline(always)]
fn spread(cells: &[f64], halve_x: bool, up: &mut [f64]) {
    if !halve_x {
        return up.copy_from_slice(cells);
    }
    let (two, one) = up.as_chunks_mut::<2>();
    two.iter_mut().zip(cells).for_each(|(u, c)| *u = [*c; 2]);
    if let Some(u) = one.first_mut() {
        *u = cells[cells.len() - 1];
    }
}

/// 1 for every cell that covers a voxel that is needed, else -1; per voxel in `up`.
#[inline(always)]
fn signs_inner(marks: &[&[f64]], halve_x: bool, line: &mut [f64], signs: &mut [f64], up: &mut [f64]) {
    let greater = |a: f64, b: f64| if b > a { b } else { a };
    vertical(marks, line, |m| 1f64.copysign(m), greater);
    pairs(line, halve_x, signs, greater);
    spread(signs, halve_x, up);
}

crate::multiversion! {
    fn signs_of[](marks: &[&[f64]], halve_x: bool, line: &mut [f64], signs: &mut [f64], up: &mut [f64]) -> () = signs_inner;
}

/// Voxels that are excluded from a cell that has others leave it; marks become counts.
#[inline(always)]
fn exclude_inner(up: &[f64], dropped: f64, [value, mark, inner, between]: [&mut [f64]; 4]) {
    let n = up.len();
    let (value, mark, inner, between) = (&mut value[..n], &mut mark[..n], &mut inner[..n], &mut between[..n]);
    for x in 0..n {
        let out = (up[x] > 0.0) & mark[x].is_sign_negative();
        value[x] = if out { dropped } else { value[x] };
        mark[x] = if out { 0.0 } else { mark[x].abs() };
        inner[x] = if out { 0.0 } else { inner[x] };
        between[x] = if out { 0.0 } else { between[x] };
    }
}

crate::multiversion! {
    fn exclude[](up: &[f64], dropped: f64, row: [&mut [f64]; 4]) -> () = exclude_inner;
}

#[inline(always)]
fn negative_inner(marks: &[f64]) -> bool {
    marks.iter().fold(0, |any, m| any | m.to_bits()) >> 63 != 0
}

crate::multiversion! {
    fn negative[](marks: &[f64]) -> bool = negative_inner;
}

#[inline(always)]
fn sign_inner(signs: &[f64], marks: &mut [f64]) {
    marks.iter_mut().zip(signs).for_each(|(m, s)| *m = m.copysign(*s));
}

crate::multiversion! {
    fn sign[](signs: &[f64], marks: &mut [f64]) -> () = sign_inner;
}

/// Takes excluded children out of every cell that covers others; the cells' signs stay in `children.signs`.
fn select(level: Level, kind: Reduce, children: &mut Children, halve_x: bool, cells: usize) {
    let n = children.n;
    if !children.rows[..n].iter().any(|r| negative(level, r[1])) {
        return children.signs[..cells].fill(1.0);
    }
    let [line, up, signs] = [&mut children.line, &mut children.up, &mut children.signs].map(std::mem::take);
    signs_of(level, &children.field(1)[..n], halve_x, line, &mut signs[..cells], up);
    let dropped = if matches!(kind, Reduce::Mean | Reduce::Moments) { 0.0 } else { f64::NAN };
    (0..n).for_each(|r| exclude(level, up, dropped, children.row(r)));
    (children.line, children.up, children.signs) = (line, up, signs);
}

/// Makes a row of cells from any children, with NaN, masks and moments. `single`: the children are voxels.
#[allow(clippy::too_many_arguments)]
pub fn merge(
    level: Level,
    kind: Reduce,
    children: &mut Children,
    halve_x: bool,
    single: bool,
    value: &mut [f64],
    mark: &mut [f64],
    inner: &mut [f64],
    between: &mut [f64],
) {
    select(level, kind, children, halve_x, mark.len());
    let n = children.n;
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
    general_sum(level, children, 1, halve_x, mark);
    if kind == Reduce::Moments {
        let [line, up] = [&mut children.line, &mut children.up].map(std::mem::take);
        means(level, value, mark, halve_x, &mut line[..mark.len()], up);
        for r in 0..n {
            let [value, mark, _, between] = children.row(r);
            deviations(level, single, value, mark, up, between);
        }
        (children.line, children.up) = (line, up);
        general_sum(level, children, 3, halve_x, between);
    }
    sign(level, children.signs, mark);
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

#[inline(always)]
fn mean_of(sum: f64, count: f64) -> f64 {
    // A division by 1 where nothing counts, so that no branch is needed.
    sum / if count > 0.0 { count } else { 1.0 }
}

#[inline(always)]
fn means_inner(sums: &[f64], counts: &[f64], halve_x: bool, means: &mut [f64], up: &mut [f64]) {
    means.iter_mut().zip(sums).zip(counts).for_each(|((d, s), n)| *d = mean_of(*s, *n));
    spread(means, halve_x, up);
}

crate::multiversion! {
    /// The cells' means, per voxel in `up`.
    fn means[](sums: &[f64], counts: &[f64], halve_x: bool, means: &mut [f64], up: &mut [f64]) -> () = means_inner;
}

#[inline(always)]
fn deviations_inner(single: bool, value: &[f64], mark: &[f64], up: &[f64], between: &mut [f64]) {
    let n = between.len();
    let (value, mark, up) = (&value[..n], &mark[..n], &up[..n]);
    if single {
        for x in 0..n {
            let d = value[x] - up[x];
            between[x] += mark[x] * (d * d);
        }
    } else {
        for x in 0..n {
            let d = mean_of(value[x], mark[x]) - up[x];
            between[x] += mark[x] * (d * d);
        }
    }
}

crate::multiversion! {
    /// Adds n (mean - the cell's mean)^2 to the children's own deviations: positive terms only, nothing cancels.
    fn deviations[](single: bool, value: &[f64], mark: &[f64], up: &[f64], between: &mut [f64]) -> () = deviations_inner;
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
                *d = if std { signed_root(variance) } else { variance };
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
