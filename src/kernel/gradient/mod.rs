//! Gradients by 4-D linear regression (paper N, as used in B 4).
//!
//! Over a full window the regression's normal equations are diagonal, so each component is
//! `sum_k w_k f_k x_k / sum_k w_k x_k^2`. The weights depend on `|x_k|` only: voxels that mirror each other share one, and
//! are subtracted or added before they are weighed. Along y and z that happens on whole rows (in i32 for types of up to 16
//! bits, which is exact). Along x weighed columns are subtracted, which loses less than an f32 result shows for types whose values
//! an f32 or an i16 holds; of wider types mirrored voxels are subtracted first, so that an offset of all values cancels there, too.
//! No fused operations: on a CPU that has them they save little here, and one that has not would pay fifty times over.

mod gaps;
pub mod shared;

use std::marker::PhantomData;

use super::Context;
use super::simd::Level;
use super::values::missing_as;
use crate::brick::scratch::{cut, padded};
use crate::grid::{Affine, AnyView, AnyViewMut, DType, Shape, View, Voxel};
use crate::stage::GradientWeight;
use crate::{multiversion, with_view};

/// What to compute. Element types are `src.dtype().result()`.
#[derive(Default)]
pub struct GradientOut<'a> {
    pub magnitude: Option<AnyViewMut<'a>>,
    /// Components along z, y, x.
    pub vector: Option<[AnyViewMut<'a>; 3]>,
}

impl GradientOut<'_> {
    fn shape(&self) -> Option<Shape> {
        let magnitude = self.magnitude.iter().map(AnyViewMut::shape);
        let mut shapes = magnitude.chain(self.vector.iter().flatten().map(AnyViewMut::shape));
        let first = shapes.next()?;
        assert!(shapes.all(|s| s == first), "extents differ");
        Some(first)
    }
}

/// Regression over `size`^3 voxels (3 or 5) around each voxel of the output box, which starts at `at` of `src`. `src` holds
/// the full window of every output voxel (the caller extended it by border `nearest`). `spacing` is physical; components
/// are scaled by the slope of `affine`. A NaN or `missing` voxel in a window: the full regression over the others; a missing
/// centre: NaN. Panics if a window sticks out of `src`, or for another size.
#[allow(clippy::too_many_arguments)]
pub fn gradient(
    src: AnyView,
    size: usize,
    weight: GradientWeight,
    spacing: [f64; 3],
    affine: Affine,
    missing: Option<i64>,
    at: [usize; 3],
    mut out: GradientOut,
    cx: &mut Context,
) {
    assert!(size == 3 || size == 5, "a gradient window has 3 or 5 voxels per axis");
    let half = size / 2;
    let Some(shape) = out.shape() else { return };
    let from = src.shape();
    assert!((0..3).all(|a| at[a] >= half && at[a] + shape[a] + half <= from[a]), "a window sticks out of the source");
    let table = &Table::new(half, weight, spacing);
    let scratch = cx.scratch.take(scratch_bytes(src.dtype(), from, shape, size));
    let level = cx.level;
    macro_rules! run {
        ($half:literal, $sum:ty, $v:ident, $missing:expr) => {{
            let job = Job::<$half, $sum> { level, shape, at, slope: affine.slope, table, sums: PhantomData };
            planes(level, $v, $missing, &job, &mut out, scratch)
        }};
    }
    macro_rules! choose {
        ($half:literal, $($small:ident),*) => {
            match src {
                $(AnyView::$small(v) if missing.is_none() => run!($half, i32, v, None),)*
                src => with_view!(AnyView, src, v => run!($half, f64, v, missing_as(missing))),
            }
        };
    }
    if size == 3 { choose!(1, U8, I8, U16, I16) } else { choose!(2, U8, I8, U16, I16) }
}

/// Bytes of scratch that [`gradient`] takes at most, whatever the extents.
pub fn scratch_bytes(_dtype: DType, _src: Shape, _dst: Shape, _size: usize) -> usize {
    padded::<f64>(SUMS * STRIDE) + padded::<f64>(3 * RUN)
}

/// Output voxels of a row that are worked on together: their sums stay in the L1 cache.
const RUN: usize = 128;

/// Weighted columns: 2 for component x, 3 each for y and z.
const SUMS: usize = 8;

/// What to do everywhere: `H` is the window's half-width, `S` what row sums are kept in.
struct Job<'a, const H: usize, S> {
    level: Level,
    shape: Shape,
    at: [usize; 3],
    slope: f64,
    table: &'a Table,
    sums: PhantomData<S>,
}

/// Weights of one spacing, `H` = half-width.
struct Table {
    /// `along[a][dz][dy][dx]`: weight of component a at offsets >= 0, divided by its denominator.
    along: [[[[f64; 3]; 3]; 3]; 3],
    /// Weight of a voxel by its offsets' magnitudes, for the full regression.
    weight: [[[f64; 3]; 3]; 3],
    spacing: [f64; 3],
}

impl Table {
    fn new(half: usize, weight: GradientWeight, spacing: [f64; 3]) -> Table {
        let mut table = Table { along: Default::default(), weight: Default::default(), spacing };
        let mut below = [0.0; 3];
        let range = 0..=half;
        for [z, y, x] in range.clone().flat_map(|z| range.clone().flat_map(move |y| (0..=half).map(move |x| [z, y, x])))
        {
            let offset = [z as f64 * spacing[0], y as f64 * spacing[1], x as f64 * spacing[2]];
            let distance = (offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]).sqrt();
            let w = match weight {
                _ if [z, y, x] == [0; 3] => 0.0,
                GradientWeight::Distance => distance,
                GradientWeight::Inverse => 1.0 / distance,
            };
            table.weight[z][y][x] = w;
            let copies = [z, y, x].iter().map(|&d| if d == 0 { 1.0 } else { 2.0 }).product::<f64>();
            for a in 0..3 {
                table.along[a][z][y][x] = w * offset[a];
                below[a] += copies * w * offset[a] * offset[a];
            }
        }
        for (rows, below) in table.along.iter_mut().zip(below) {
            rows.iter_mut().flatten().flatten().for_each(|w| *w /= below);
        }
        table
    }
}

/// What row sums are kept in, made from voxels of type `T`.
trait Sum<T>: Voxel {
    /// Such voxels go through i16, a run at once: summed from bytes, eight at a time, they take 1.6 (u8) to 2 (i8) times as long
    /// as voxels of 16 bits (2-core Intel Xeon VM, AVX-512, 2026-11-27), and in f64 longer still.
    const SHORT: bool;
    fn of(v: T, missing: Option<T>) -> Self;
    /// The voxel, where `SHORT` says so.
    fn short(v: T) -> i16;
    fn plus(self, other: Self) -> Self;
    fn minus(self, other: Self) -> Self;
}

macro_rules! exact_in_i32 {
    ($($t:ty),*) => {$(
        /// Sums and differences of four such voxels are exact.
        impl Sum<$t> for i32 {
            const SHORT: bool = size_of::<$t>() == 1;
            #[inline(always)]
            fn short(v: $t) -> i16 { v as i16 }
            #[inline(always)]
            fn of(v: $t, _: Option<$t>) -> i32 { v as i32 }
            #[inline(always)]
            fn plus(self, other: i32) -> i32 { self.wrapping_add(other) }
            #[inline(always)]
            fn minus(self, other: i32) -> i32 { self.wrapping_sub(other) }
        }
    )*};
}
exact_in_i32!(u8, i8, u16, i16);

impl<T: Voxel> Sum<T> for f64 {
    const SHORT: bool = false;
    #[inline(always)]
    fn short(_: T) -> i16 {
        0
    }
    #[inline(always)]
    fn of(v: T, missing: Option<T>) -> f64 {
        if missing == Some(v) { f64::NAN } else { v.to_f64() }
    }
    #[inline(always)]
    fn plus(self, other: f64) -> f64 {
        self + other
    }
    #[inline(always)]
    fn minus(self, other: f64) -> f64 {
        self - other
    }
}

multiversion! {
    fn planes[const H: usize, T: Voxel, S: Sum<T>](
        src: View<T>, missing: Option<T>, job: &Job<H, S>, out: &mut GradientOut, scratch: &mut [u8],
    ) -> () = planes_inner::<H, T, S>;
}

/// Every output voxel, in runs along x.
#[inline(always)]
fn planes_inner<const H: usize, T: Voxel, S: Sum<T>>(
    src: View<T>,
    missing: Option<T>,
    job: &Job<H, S>,
    out: &mut GradientOut,
    scratch: &mut [u8],
) {
    let (sums, rest) = cut::<f64>(scratch, SUMS * STRIDE);
    let (parts, _) = cut::<f64>(rest, 3 * RUN);
    let gaps = T::DTYPE.is_float() || missing.is_some();
    let mut wide = [[[0i16; STRIDE]; 5]; 5];
    for z in 0..job.shape[0] {
        for y in 0..job.shape[1] {
            for x in (0..job.shape[2]).step_by(RUN) {
                let n = RUN.min(job.shape[2] - x);
                let m = n + 2 * H;
                let centre = [job.at[0] + z, job.at[1] + y, job.at[2] + x];
                if gaps && all_missing(&src.row_at(centre[0], centre[1])[centre[2]..][..n], missing) {
                    parts.fill(f64::NAN);
                    store([z, y, x], n, job.slope, parts, out);
                    continue;
                }
                let rows: [[&[T]; 5]; 5] = std::array::from_fn(|dz| {
                    std::array::from_fn(|dy| {
                        let (dz, dy) = (dz.min(2 * H), dy.min(2 * H));
                        &src.row_at(centre[0] + dz - H, centre[1] + dy - H)[centre[2] - H..][..m]
                    })
                });
                if S::SHORT {
                    for (wide, row) in wide.iter_mut().flatten().zip(rows.as_flattened()) {
                        wide.iter_mut().zip(*row).for_each(|(w, v)| *w = S::short(*v));
                    }
                    let rows = wide.each_ref().map(|rows| rows.each_ref().map(|row| &row[..m]));
                    weigh::<H, i16, i32>(&rows, None, job.table, m, sums);
                } else {
                    weigh::<H, T, S>(&rows, missing, job.table, m, sums);
                }
                join_columns::<H>(sums, parts);
                if goes_across(T::DTYPE) {
                    across::<H, T>(&rows, missing, job.table, n, &mut parts[2 * RUN..]);
                }
                if gaps && any_nan(&rows[H][H][H..H + n], missing, n, parts) {
                    gaps::regress_gaps::<H, T>(job.level, &rows, missing, n, job.table, parts);
                }
                store([z, y, x], n, job.slope, parts, out);
            }
        }
    }
}

/// Elements from one row of sums to the next.
const STRIDE: usize = RUN + 8;

/// Columns worked on at once: their eight sums stay in registers.
const LANES: usize = 8;

/// [`weigh_columns`] of all `m` columns of a run.
#[inline(always)]
fn weigh<const H: usize, T: Voxel, S: Sum<T>>(
    rows: &[[&[T]; 5]; 5],
    missing: Option<T>,
    table: &Table,
    m: usize,
    sums: &mut [f64],
) {
    let full = m / LANES * LANES;
    for i in (0..full).step_by(LANES) {
        weigh_columns::<H, T, S, true>(rows, missing, table, i, sums);
    }
    if full < m {
        weigh_columns::<H, T, S, false>(rows, missing, table, full, sums);
    }
}

/// Weighted sums over y and z of [`LANES`] columns from `i` on: for component x one row per |dx| = 1, 2, for y and z one
/// per |dx| = 0, 1, 2. Without `FULL` the rows may end inside the lanes.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // offsets index weights and rows alike
fn weigh_columns<const H: usize, T: Voxel, S: Sum<T>, const FULL: bool>(
    rows: &[[&[T]; 5]; 5],
    missing: Option<T>,
    table: &Table,
    i: usize,
    sums: &mut [f64],
) {
    let row = |dz: usize, dy: usize| -> [S; LANES] {
        let row = rows[dz][dy];
        if FULL {
            let row: &[T; LANES] = row[i..i + LANES].try_into().unwrap();
            row.map(|v| S::of(v, missing))
        } else {
            std::array::from_fn(|l| S::of(row[(i + l).min(row.len() - 1)], missing))
        }
    };
    let mut acc = [[0.0f64; LANES]; SUMS];
    let mut add = |index: usize, w: f64, sum: &[S; LANES]| {
        for l in 0..LANES {
            acc[index][l] += w * sum[l].to_f64();
        }
    };
    let [in_z, in_y, in_x] = &table.along;
    let c = row(H, H);
    // Component x takes none of its weights where it comes from differences.
    let own = if goes_across(T::DTYPE) { 0 } else { H };
    for dx in 1..=own {
        add(dx - 1, in_x[0][0][dx], &c);
    }
    for d in 1..=H {
        let (a, b) = (row(H, H + d), row(H, H - d));
        let (even, odd) = (plus(&a, &b), minus(&a, &b));
        (1..=own).for_each(|dx| add(dx - 1, in_x[0][d][dx], &even));
        (0..=H).for_each(|dx| add(2 + dx, in_y[0][d][dx], &odd));
        let (a, b) = (row(H + d, H), row(H - d, H));
        let (even, odd) = (plus(&a, &b), minus(&a, &b));
        (1..=own).for_each(|dx| add(dx - 1, in_x[d][0][dx], &even));
        (0..=H).for_each(|dx| add(5 + dx, in_z[d][0][dx], &odd));
    }
    for dz in 1..=H {
        for dy in 1..=H {
            let (pp, pm, mp, mm) = (row(H + dz, H + dy), row(H + dz, H - dy), row(H - dz, H + dy), row(H - dz, H - dy));
            let even = plus(&plus(&pp, &pm), &plus(&mp, &mm));
            let odd_y = plus(&minus(&pp, &pm), &minus(&mp, &mm));
            let odd_z = plus(&minus(&pp, &mp), &minus(&pm, &mm));
            (1..=own).for_each(|dx| add(dx - 1, in_x[dz][dy][dx], &even));
            (0..=H).for_each(|dx| add(2 + dx, in_y[dz][dy][dx], &odd_y));
            (0..=H).for_each(|dx| add(5 + dx, in_z[dz][dy][dx], &odd_z));
        }
    }
    for (index, acc) in acc.iter().enumerate() {
        sums[index * STRIDE + i..][..LANES].copy_from_slice(acc);
    }
}

#[inline(always)]
fn plus<T, S: Sum<T>>(a: &[S; LANES], b: &[S; LANES]) -> [S; LANES] {
    std::array::from_fn(|l| a[l].plus(b[l]))
}

#[inline(always)]
fn minus<T, S: Sum<T>>(a: &[S; LANES], b: &[S; LANES]) -> [S; LANES] {
    std::array::from_fn(|l| a[l].minus(b[l]))
}

/// Whether component x of voxels of this type comes from [`across`].
const fn goes_across(dtype: DType) -> bool {
    matches!(dtype, DType::U32 | DType::I32 | DType::F64)
}

/// Component x of `n` voxels from differences of mirrored voxels.
#[inline(always)]
fn across<const H: usize, T: Voxel>(
    rows: &[[&[T]; 5]; 5],
    missing: Option<T>,
    table: &Table,
    n: usize,
    gx: &mut [f64],
) {
    let full = n / LANES * LANES;
    for i in (0..full).step_by(LANES) {
        let lanes: &mut [f64; LANES] = (&mut gx[i..i + LANES]).try_into().unwrap();
        across_columns::<H, LANES, T>(rows, missing, table, i, lanes);
    }
    for (i, g) in gx[..n].iter_mut().enumerate().skip(full) {
        across_columns::<H, 1, T>(rows, missing, table, i, std::array::from_mut(g));
    }
}

/// The same of `L` voxels from `i` on.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // offsets index weights and rows alike
fn across_columns<const H: usize, const L: usize, T: Voxel>(
    rows: &[[&[T]; 5]; 5],
    missing: Option<T>,
    table: &Table,
    i: usize,
    gx: &mut [f64; L],
) {
    let mut sums = [0.0; L];
    for dz in 0..=H {
        for dy in 0..=H {
            for dx in 1..=H {
                // Voxels of one weight come together before they are weighed, in mirrored pairs: where they cancel, nothing is left.
                let mut of_weight = [0.0; L];
                for z in [H + dz, H - dz].into_iter().take(1 + usize::from(dz > 0)) {
                    let mut of_plane = [0.0; L];
                    for y in [H + dy, H - dy].into_iter().take(1 + usize::from(dy > 0)) {
                        let before: &[T; L] = rows[z][y][i + H - dx..][..L].try_into().unwrap();
                        let behind: &[T; L] = rows[z][y][i + H + dx..][..L].try_into().unwrap();
                        for l in 0..L {
                            of_plane[l] +=
                                <f64 as Sum<T>>::of(behind[l], missing) - <f64 as Sum<T>>::of(before[l], missing);
                        }
                    }
                    for l in 0..L {
                        of_weight[l] += of_plane[l];
                    }
                }
                let w = table.along[2][dz][dy][dx];
                for l in 0..L {
                    sums[l] += w * of_weight[l];
                }
            }
        }
    }
    *gx = sums;
}

/// The three components (z, y, x in turn, [`RUN`] apart) from the weighted columns; past the run's end they are rubbish.
#[inline(always)]
fn join_columns<const H: usize>(sums: &[f64], parts: &mut [f64]) {
    let column =
        |index: usize, from: usize| -> &[f64; RUN] { sums[index * STRIDE + from..][..RUN].try_into().unwrap() };
    let (parts_zy, gx) = parts.split_at_mut(2 * RUN);
    let (a, b) = (column(0, H + 1), column(0, H - 1));
    (0..RUN).for_each(|i| gx[i] = a[i] - b[i]);
    if H == 2 {
        let (a, b) = (column(1, 4), column(1, 0));
        (0..RUN).for_each(|i| gx[i] += a[i] - b[i]);
    }
    for (g, first) in parts_zy.chunks_exact_mut(RUN).zip([5, 2]) {
        let (c, a, b) = (column(first, H), column(first + 1, H + 1), column(first + 1, H - 1));
        (0..RUN).for_each(|i| g[i] = c[i] + (a[i] + b[i]));
        if H == 2 {
            let (a, b) = (column(first + 2, 4), column(first + 2, 0));
            (0..RUN).for_each(|i| g[i] += a[i] + b[i]);
        }
    }
}

/// Whether there is nothing here.
#[inline(always)]
fn all_missing<T: Voxel>(centres: &[T], missing: Option<T>) -> bool {
    centres.iter().all(|v| <f64 as Sum<T>>::of(*v, missing).is_nan())
}

/// Whether a centre is missing or a component NaN.
#[inline(always)]
fn any_nan<T: Voxel>(centres: &[T], missing: Option<T>, n: usize, parts: &[f64]) -> bool {
    let mut any = false;
    for v in centres {
        let v = <f64 as Sum<T>>::of(*v, missing);
        any |= v.is_nan();
    }
    for g in parts.chunks_exact(RUN) {
        for g in &g[..n] {
            any |= g.is_nan();
        }
    }
    any
}

/// Whether a component's square may overflow or lose digits.
#[inline(always)]
fn is_far(g: f64) -> bool {
    (g.abs() > 1e150) | ((g.abs() < 1e-140) & (g != 0.0))
}

/// Length of a vector whose squares may be no f64: scaled by a power of two, so that others keep their bits.
fn far_length(g: [f64; 3]) -> f64 {
    let largest = g.iter().fold(0.0, |m: f64, g| m.max(g.abs()));
    let by = match largest {
        m if !m.is_finite() || !is_far(m) => 1.0,
        m if m > 1.0 => 2f64.powi(-600),
        _ => 2f64.powi(600),
    };
    let [z, y, x] = g.map(|g| g * by);
    (z * z + y * y + x * x).sqrt() / by
}

/// Scales, rounds once and stores `n` voxels from voxel `[z, y, x]` of the outputs on.
#[inline(always)]
fn store([z, y, x]: [usize; 3], n: usize, slope: f64, parts: &mut [f64], out: &mut GradientOut) {
    #[inline(always)]
    fn put(dst: &mut AnyViewMut, [z, y, x]: [usize; 3], n: usize, value: impl Fn(usize) -> f64) {
        match dst {
            AnyViewMut::F32(d) => {
                d.row_at(z, y)[x..x + n].iter_mut().enumerate().for_each(|(i, d)| *d = value(i) as f32);
            }
            AnyViewMut::F64(d) => {
                d.row_at(z, y)[x..x + n].iter_mut().enumerate().for_each(|(i, d)| *d = value(i));
            }
            other => panic!("a gradient is not {}", other.dtype()),
        }
    }
    // + 0.0 makes a zero positive whatever the slope
    parts.iter_mut().for_each(|p| *p = *p * slope + 0.0);
    let (gz, rest) = parts.split_at(RUN);
    let (gy, gx) = rest.split_at(RUN);
    if let Some(dst) = &mut out.magnitude {
        let mut far = false;
        for g in [gz, gy, gx] {
            for g in &g[..n] {
                far |= is_far(*g);
            }
        }
        if far {
            put(dst, [z, y, x], n, |i| far_length([gz[i], gy[i], gx[i]]));
        } else {
            put(dst, [z, y, x], n, |i| (gz[i] * gz[i] + gy[i] * gy[i] + gx[i] * gx[i]).sqrt());
        }
    }
    if let Some(vector) = &mut out.vector {
        for (dst, g) in vector.iter_mut().zip([gz, gy, gx]) {
            put(dst, [z, y, x], n, |i| g[i]);
        }
    }
}

#[cfg(test)]
mod tests;
