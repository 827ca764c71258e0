//! Gradients by 4-D linear regression (paper N, as used in B 4).
//!
//! Over a full window the regression's normal equations are diagonal, so each component is
//! `sum_k w_k f_k x_k / sum_k w_k x_k^2`. The weights depend on `|x_k|` only: voxels that mirror each other share one, and
//! are subtracted or added before they are weighed. Along y and z that happens on whole rows (in i32 for types of up to 16
//! bits, which is exact), along x in registers. No fused operations: on a CPU that has them they save little here, and one
//! that has not would pay fifty times over.

mod regression;

use std::marker::PhantomData;

use super::Context;
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
            let job = Job::<$half, $sum> { shape, at, slope: affine.slope, table, sums: PhantomData };
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

/// Row sums at most: 9 symmetric, 6 antisymmetric along y, 6 along z.
const SUMS: usize = 21;

/// What to do everywhere: `H` is the window's half-width, `S` what row sums are kept in.
struct Job<'a, const H: usize, S> {
    shape: Shape,
    at: [usize; 3],
    slope: f64,
    table: &'a Table,
    sums: PhantomData<S>,
}

/// Weights of one spacing, `H` = half-width.
struct Table {
    half: usize,
    /// `along[a][dz][dy][dx]`: weight of component a at offsets >= 0, divided by its denominator.
    along: [[[[f64; 3]; 3]; 3]; 3],
    /// Weight of a voxel by its offsets' magnitudes, for the full regression.
    weight: [[[f64; 3]; 3]; 3],
    spacing: [f64; 3],
}

impl Table {
    fn new(half: usize, weight: GradientWeight, spacing: [f64; 3]) -> Table {
        let mut table = Table { half, along: Default::default(), weight: Default::default(), spacing };
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
    fn of(v: T, missing: Option<T>) -> Self;
    fn plus(self, other: Self) -> Self;
    fn minus(self, other: Self) -> Self;
}

macro_rules! exact_in_i32 {
    ($($t:ty),*) => {$(
        /// Sums and differences of four such voxels are exact.
        impl Sum<$t> for i32 {
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
    let (sums, rest) = cut::<S>(scratch, SUMS * STRIDE);
    let (parts, _) = cut::<f64>(rest, 3 * RUN);
    let gaps = T::DTYPE.is_float() || missing.is_some();
    for z in 0..job.shape[0] {
        for y in 0..job.shape[1] {
            for x in (0..job.shape[2]).step_by(RUN) {
                let n = RUN.min(job.shape[2] - x);
                let centre = [job.at[0] + z, job.at[1] + y, job.at[2] + x];
                sum_rows::<H, T, S>(&src, missing, centre, n, sums);
                weigh_rows::<H, T, S>(job.table, sums, n, parts);
                if gaps {
                    regress_gaps(&src, missing, centre, n, job.table, parts);
                }
                store([z, y, x], n, job.slope, parts, out);
            }
        }
    }
}

/// Elements from one row of sums to the next.
const STRIDE: usize = RUN + 8;

/// Where the sums stand: symmetric in y and z by (|dz|, |dy|); antisymmetric along y by (|dz|, dy); along z by (|dy|, dz).
const fn symmetric(dz: usize, dy: usize) -> usize {
    dz * 3 + dy
}
const fn along_y(dz: usize, dy: usize) -> usize {
    9 + dz * 2 + dy - 1
}
const fn along_z(dy: usize, dz: usize) -> usize {
    15 + dy * 2 + dz - 1
}

/// Sums and differences of the rows that mirror each other about the centre's row, from x - H to x + n + H.
#[inline(always)]
fn sum_rows<const H: usize, T: Voxel, S: Sum<T>>(
    src: &View<T>,
    missing: Option<T>,
    [z, y, x]: [usize; 3],
    n: usize,
    sums: &mut [S],
) {
    let m = n + 2 * H;
    let row = |dz: isize, dy: isize| &src.row_at(z.wrapping_add_signed(dz), y.wrapping_add_signed(dy))[x - H..][..m];
    let of = |v: &T| S::of(*v, missing);
    sums[..m].iter_mut().zip(row(0, 0)).for_each(|(s, v)| *s = of(v));
    for d in 1..=H {
        let (high, low) = (row(0, d as isize), row(0, -(d as isize)));
        let [sym, anti] = sums.get_disjoint_mut([at(symmetric(0, d), m), at(along_y(0, d), m)]).unwrap();
        for i in 0..m {
            let (a, b) = (of(&high[i]), of(&low[i]));
            sym[i] = a.plus(b);
            anti[i] = a.minus(b);
        }
        let (high, low) = (row(d as isize, 0), row(-(d as isize), 0));
        let [sym, anti] = sums.get_disjoint_mut([at(symmetric(d, 0), m), at(along_z(0, d), m)]).unwrap();
        for i in 0..m {
            let (a, b) = (of(&high[i]), of(&low[i]));
            sym[i] = a.plus(b);
            anti[i] = a.minus(b);
        }
    }
    for (dz, dy) in (1..=H).flat_map(|dz| (1..=H).map(move |dy| (dz, dy))) {
        let (iz, iy) = (dz as isize, dy as isize);
        let (pp, pm, mp, mm) = (row(iz, iy), row(iz, -iy), row(-iz, iy), row(-iz, -iy));
        let places = [at(symmetric(dz, dy), m), at(along_y(dz, dy), m), at(along_z(dy, dz), m)];
        let [sym, in_y, in_z] = sums.get_disjoint_mut(places).unwrap();
        for i in 0..m {
            let (pp, pm, mp, mm) = (of(&pp[i]), of(&pm[i]), of(&mp[i]), of(&mm[i]));
            sym[i] = pp.plus(pm).plus(mp.plus(mm));
            in_y[i] = pp.minus(pm).plus(mp.minus(mm));
            in_z[i] = pp.minus(mp).plus(pm.minus(mm));
        }
    }
}

/// Row of sums `index`, its first `n` elements.
const fn at(index: usize, n: usize) -> std::ops::Range<usize> {
    index * STRIDE..index * STRIDE + n
}

/// Output voxels whose sums stay in registers.
const LANES: usize = 16;

/// The three components (z, y, x in turn, [`RUN`] apart) of `n` voxels from their row sums. The last lanes may hold rubbish.
#[inline(always)]
fn weigh_rows<const H: usize, T: Voxel, S: Sum<T>>(table: &Table, sums: &[S], n: usize, parts: &mut [f64]) {
    for i in (0..n).step_by(LANES) {
        let lanes = |index: usize, shift: isize| -> &[S; LANES] {
            let start = (index * STRIDE + i + H).wrapping_add_signed(shift);
            sums[start..start + LANES].try_into().unwrap()
        };
        let mut g = [[0.0; LANES]; 3];
        for dz in 0..=H {
            for dy in 0..=H {
                for dx in 1..=H {
                    let w = table.along[2][dz][dy][dx];
                    let (a, b) = (lanes(symmetric(dz, dy), dx as isize), lanes(symmetric(dz, dy), -(dx as isize)));
                    for l in 0..LANES {
                        g[2][l] += w * a[l].minus(b[l]).to_f64();
                    }
                }
            }
        }
        for (far, near) in (0..=H).flat_map(|near| (1..=H).map(move |far| (far, near))) {
            for (axis, index, w) in [
                (0, along_z(near, far), &table.along[0][far][near]),
                (1, along_y(near, far), &table.along[1][near][far]),
            ] {
                let middle = lanes(index, 0);
                for l in 0..LANES {
                    g[axis][l] += w[0] * middle[l].to_f64();
                }
                for dx in 1..=H {
                    let (a, b) = (lanes(index, dx as isize), lanes(index, -(dx as isize)));
                    for l in 0..LANES {
                        g[axis][l] += w[dx] * a[l].plus(b[l]).to_f64();
                    }
                }
            }
        }
        for (axis, g) in g.iter().enumerate() {
            parts[axis * RUN + i..][..LANES].copy_from_slice(g);
        }
    }
}

/// Puts the full regression where a voxel of the window is missing. A missing voxel makes a component NaN, since each but
/// the centre has a weight in one at least.
#[inline(never)]
fn regress_gaps<T: Voxel>(
    src: &View<T>,
    missing: Option<T>,
    [z, y, x]: [usize; 3],
    n: usize,
    table: &Table,
    parts: &mut [f64],
) {
    let value = |z: usize, y: usize, x: usize| <f64 as Sum<T>>::of(src.at([z, y, x]), missing);
    for i in 0..n {
        let gone = value(z, y, x + i).is_nan();
        if !gone && !(0..3).any(|a| parts[a * RUN + i].is_nan()) {
            continue;
        }
        let fitted = if gone { Some([f64::NAN; 3]) } else { regression::fit(table, [z, y, x + i], value) };
        if let Some(g) = fitted {
            (0..3).for_each(|a| parts[a * RUN + i] = g[a]);
        }
    }
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
        put(dst, [z, y, x], n, |i| (gz[i] * gz[i] + gy[i] * gy[i] + gx[i] * gx[i]).sqrt());
    }
    if let Some(vector) = &mut out.vector {
        for (dst, g) in vector.iter_mut().zip([gz, gy, gx]) {
            put(dst, [z, y, x], n, |i| g[i]);
        }
    }
}

#[cfg(test)]
mod tests;
