//! Truncated Gaussian moments (paper E).
//!
//! Three passes, x, y, z, over a ring of planes. A pass renormalises its weights to the voxels inside `src`; since those
//! form a box, the product is the renormalised 3-D weight. Means are taken relative to the centre tap and variances pooled
//! (variances plus spread of means), so constants give exactly themselves and 0, and nothing cancels.
//!
//! Results that are not finite (a missing voxel, an infinity or an overflow in the window) are computed once more by passes
//! that carry each cell's weight, which is the normalised convolution over the voxels that are left. Which of the two a
//! voxel gets depends on its window alone.

mod rows;
pub mod shared;

use super::Context;
use super::simd::Level;
use super::values::load_any;
use crate::brick::scratch::{cut, padded};
use crate::grid::{Affine, AnyView, AnyViewMut, DType, Shape};
use crate::with_view;
use rows::{Pooled, Real, Taps, load_row, mean_row, pool_row, store_row, variance_row};

/// Separable Gaussian of `sigma` voxels per axis, truncated at `ceil(3 sigma)`, weights renormalised to the voxels that
/// exist (inside `src`, not NaN, not `missing`). `mean` and `variance` have `src.dtype().result()`; scaled by `affine`. A
/// missing centre gives NaN. Panics if extents or types disagree.
///
/// Means of types whose result is f32 are computed in f32 (within 4e-7 of the window's range), all else in f64.
#[allow(clippy::too_many_arguments)]
pub fn gaussian(
    src: AnyView,
    sigma: [f64; 3],
    affine: Affine,
    missing: Option<i64>,
    at: [usize; 3],
    mut mean: Option<AnyViewMut>,
    mut variance: Option<AnyViewMut>,
    cx: &mut Context,
) {
    let shapes = [&mean, &variance].map(|o| o.as_ref().map(AnyViewMut::shape));
    let Some(dst) = shapes[0].or(shapes[1]) else { return };
    assert!(shapes.iter().flatten().all(|s| *s == dst), "extents differ");
    let from = src.shape();
    assert!((0..3).all(|a| at[a] + dst[a] <= from[a]), "the output box sticks out of the source");
    if dst.contains(&0) {
        return;
    }
    let job = Job { src, missing, affine, at, dst, radius: radius(sigma, from), sigma, level: cx.level };
    let bytes = cx.scratch.take(scratch_bytes(src.dtype(), from, dst, sigma, true));
    let mut finite = true;
    if src.dtype().result() == DType::F32 {
        if let Some(mean) = &mut mean {
            finite &= job.run::<f32>(bytes, Pass::Mean, Some(mean), None);
        }
        if let Some(variance) = &mut variance {
            finite &= job.run::<f64>(bytes, Pass::Variance, None, Some(variance));
        }
    } else {
        let pass = if variance.is_some() { Pass::Variance } else { Pass::Mean };
        finite &= job.run::<f64>(bytes, pass, mean.as_mut(), variance.as_mut());
    }
    if !finite {
        job.run::<f64>(bytes, Pass::Gaps, mean.as_mut(), variance.as_mut());
    }
}

/// Half-width of the truncated kernel, voxels per axis.
pub fn reach(sigma: [f64; 3]) -> [usize; 3] {
    sigma.map(|s| (3.0 * s).ceil() as usize)
}

/// Bytes of scratch that [`gaussian`] takes at most.
pub fn scratch_bytes(_dtype: DType, src: Shape, dst: Shape, sigma: [f64; 3], _variance: bool) -> usize {
    let radius = radius(sigma, src);
    let rows = [src[2], src[1] * dst[2], ring(src, radius) * dst[1] * dst[2], dst[2]];
    let most = radius.into_iter().max().unwrap_or(0);
    let tables = padded::<f64>(2 * most + 1) + padded::<u32>(2 * most) + 3 * padded::<f64>(most + 1);
    // mean, variance and weight: where voxels are missing, all three are carried
    3 * rows.into_iter().map(padded::<f64>).sum::<usize>() + tables
}

/// Half-widths, no larger than the source.
fn radius(sigma: [f64; 3], src: Shape) -> [usize; 3] {
    let reach = reach(sigma);
    std::array::from_fn(|a| reach[a].min(src[a].saturating_sub(1)))
}

/// Planes that the z pass sees at once.
fn ring(src: Shape, radius: [usize; 3]) -> usize {
    (2 * radius[0] + 1).min(src[0])
}

/// exp(-k^2 / 2 sigma^2).
fn bell(sigma: f64, k: usize) -> f64 {
    let x = k as f64 / sigma;
    if k == 0 { 1.0 } else { (-0.5 * x * x).exp() }
}

/// Sum of the bell over the taps that exist, given how many voxels there are on both sides.
fn total(bell: impl Fn(usize) -> f64, radius: usize, before: usize, after: usize) -> f64 {
    (1..=radius).fold(bell(0), |sum, k| sum + bell(k) * (f64::from(k <= before) + f64::from(k <= after)))
}

/// What a run of the passes carries.
#[derive(Clone, Copy, PartialEq)]
enum Pass {
    Mean,
    /// Mean and variance.
    Variance,
    /// Mean, variance and weight; writes only voxels that an earlier run left NaN.
    Gaps,
}

struct Job<'a> {
    src: AnyView<'a>,
    missing: Option<i64>,
    affine: Affine,
    at: [usize; 3],
    dst: Shape,
    radius: [usize; 3],
    sigma: [f64; 3],
    level: Level,
}

/// Buffers of one quantity: a source row, a plane after the x pass, the ring after the y pass, a result row.
struct Field<'a, F> {
    row: &'a mut [F],
    plane: &'a mut [F],
    ring: &'a mut [F],
    out: &'a mut [F],
}

/// Weights and places of the taps, made anew for each row.
struct Table<'a> {
    /// exp(-k^2 / 2 sigma^2) of each axis.
    bells: [&'a mut [f64]; 3],
    weights: &'a mut [f64],
    places: &'a mut [u32],
}

impl Table<'_> {
    /// Taps about position `p` of an axis of `n`; `place` tells where a position's row stands.
    #[allow(clippy::needless_range_loop)] // k is a distance as well as an index
    fn taps(&mut self, axis: usize, p: usize, n: usize, place: impl Fn(usize) -> usize) -> Taps<'_> {
        let bell = &*self.bells[axis];
        let radius = bell.len() - 1;
        let (before, after) = (p, n - 1 - p);
        let total = total(|k| bell[k], radius, before, after);
        self.weights[0] = bell[0] / total;
        let centre = place(p);
        let gone = (centre as u32, 0.0);
        for k in 1..=radius {
            let (w, i) = (bell[k] / total, 2 * k);
            let tap = |exists: bool, q: usize| if exists { (place(q) as u32, w) } else { gone };
            (self.places[i - 2], self.weights[i - 1]) = tap(k <= before, p.wrapping_sub(k));
            (self.places[i - 1], self.weights[i]) = tap(k <= after, p + k);
        }
        Taps { centre, places: &self.places[..2 * radius], weights: &self.weights[..2 * radius + 1] }
    }
}

/// One pass of one row: `from` to `to`, each mean, variance, weight. `spread` tells whether the cells of `from` have a
/// variance yet.
fn apply<F: Real>(level: Level, pass: Pass, from: [&[F]; 3], spread: bool, taps: &Taps, to: [&mut [F]; 3]) {
    let [mean, variance, weight] = to;
    match pass {
        Pass::Mean => mean_row(level, from[0], taps, mean),
        Pass::Variance => {
            mean_row(level, from[0], taps, mean);
            variance_row(level, from[0], spread.then_some(from[1]), taps, mean, variance);
        }
        Pass::Gaps => {
            let from = Pooled { mean: from[0], variance: from[1], weight: from[2] };
            pool_row(level, &from, taps, mean, variance, weight);
        }
    }
}

impl Job<'_> {
    /// Runs the passes and writes what is asked for; returns whether every result is finite.
    fn run<F: Real>(
        &self,
        bytes: &mut [u8],
        pass: Pass,
        mut mean: Option<&mut AnyViewMut>,
        mut variance: Option<&mut AnyViewMut>,
    ) -> bool {
        let (src, radius) = (self.src.shape(), self.radius);
        let slots = ring(src, radius);
        let (mut table, mut fields) = self.carve::<F>(bytes, slots);
        let needed =
            |a: usize| self.at[a].saturating_sub(radius[a])..(self.at[a] + self.dst[a] + radius[a]).min(src[a]);
        let (mut next, mut finite) = (0, true);
        for sz in needed(0) {
            for sy in needed(1) {
                self.load(pass, sz, sy, &mut fields);
                self.along_x(pass, sy - needed(1).start, &mut table, &mut fields);
            }
            self.along_y(pass, sz % slots, needed(1).start, &mut table, &mut fields);
            while next < self.dst[0] && (self.at[0] + next + radius[0]).min(src[0] - 1) <= sz {
                for y in 0..self.dst[1] {
                    self.along_z(pass, next, y, slots, &mut table, &mut fields);
                    if let Some(dst) = &mut mean {
                        finite &= self.write(pass, [next, y], fields[0].out, fields[2].out, false, dst);
                    }
                    if let Some(dst) = &mut variance {
                        finite &= self.write(pass, [next, y], fields[1].out, fields[2].out, true, dst);
                    }
                }
                next += 1;
            }
        }
        finite
    }

    fn carve<'b, F: Real>(&self, bytes: &'b mut [u8], slots: usize) -> (Table<'b>, [Field<'b, F>; 3]) {
        let (src, dst) = (self.src.shape(), self.dst);
        let mut rest = bytes;
        let bells = std::array::from_fn(|a| {
            let (bell, tail) = cut::<f64>(std::mem::take(&mut rest), self.radius[a] + 1);
            rest = tail;
            bell.iter_mut().enumerate().for_each(|(k, b)| *b = self::bell(self.sigma[a], k));
            bell
        });
        let most = self.radius.into_iter().max().unwrap_or(0);
        let (weights, tail) = cut::<f64>(rest, 2 * most + 1);
        let (places, mut rest) = cut::<u32>(tail, 2 * most);
        let fields = std::array::from_fn(|_| {
            let mut take = |len: usize| {
                let (part, tail) = cut::<F>(std::mem::take(&mut rest), len);
                rest = tail;
                part
            };
            let plane = dst[1] * dst[2];
            Field { row: take(src[2]), plane: take(src[1] * dst[2]), ring: take(slots * plane), out: take(dst[2]) }
        });
        (Table { bells, weights, places }, fields)
    }

    /// Source row `[sz, sy]`; where gaps are counted, as mean, variance 0 and weight 1 or 0.
    fn load<F: Real>(&self, pass: Pass, sz: usize, sy: usize, fields: &mut [Field<F>; 3]) {
        let [mean, variance, weight] = fields;
        with_view!(AnyView, self.src, v => load_row(self.level, v.row_at(sz, sy), self.missing, mean.row));
        if pass == Pass::Gaps {
            variance.row.fill(F::narrow(0.0));
            for (m, w) in mean.row.iter_mut().zip(weight.row.iter_mut()) {
                let gone = m.to_f64().is_nan();
                *w = F::narrow(f64::from(!gone));
                *m = if gone { F::narrow(0.0) } else { *m };
            }
        }
    }

    fn along_x<F: Real>(&self, pass: Pass, y: usize, table: &mut Table, fields: &mut [Field<F>; 3]) {
        let (n, nx, r, first) = (self.src.shape()[2], self.dst[2], self.radius[2], self.at[2]);
        // output voxels whose window is whole are one run; the others are runs of one
        let low = r.saturating_sub(first).min(nx);
        let high = (n.saturating_sub(r)).saturating_sub(first).clamp(low, nx);
        let [a, b, c] = fields;
        let mut run = |from: usize, to: usize| {
            let taps = table.taps(2, first + from, n, |q| q);
            let rows = [&*a.row, &*b.row, &*c.row];
            let cut = y * nx + from..y * nx + to;
            let out = [&mut a.plane[cut.clone()], &mut b.plane[cut.clone()], &mut c.plane[cut]];
            apply(self.level, pass, rows, false, &taps, out);
        };
        (0..low).for_each(|x| run(x, x + 1));
        if low < high {
            run(low, high);
        }
        (high..nx).for_each(|x| run(x, x + 1));
    }

    fn along_y<F: Real>(&self, pass: Pass, slot: usize, y0: usize, table: &mut Table, fields: &mut [Field<F>; 3]) {
        let (n, [_, ny, nx]) = (self.src.shape()[1], self.dst);
        let [a, b, c] = fields;
        for y in 0..ny {
            let taps = table.taps(1, self.at[1] + y, n, |q| (q - y0) * nx);
            let cut = (slot * ny + y) * nx..(slot * ny + y + 1) * nx;
            let out = [&mut a.ring[cut.clone()], &mut b.ring[cut.clone()], &mut c.ring[cut]];
            apply(self.level, pass, [&*a.plane, &*b.plane, &*c.plane], true, &taps, out);
        }
    }

    fn along_z<F: Real>(
        &self,
        pass: Pass,
        z: usize,
        y: usize,
        slots: usize,
        table: &mut Table,
        fields: &mut [Field<F>; 3],
    ) {
        let (n, [_, ny, nx]) = (self.src.shape()[0], self.dst);
        let [a, b, c] = fields;
        let taps = table.taps(0, self.at[0] + z, n, |q| ((q % slots) * ny + y) * nx);
        apply(self.level, pass, [&*a.ring, &*b.ring, &*c.ring], true, &taps, [&mut *a.out, &mut *b.out, &mut *c.out]);
    }

    /// Scales and stores one row of means, or of variances (`squared`); returns whether it is finite. What is not becomes
    /// NaN, which is what [`Pass::Gaps`] then writes over.
    fn write<F: Real>(
        &self,
        pass: Pass,
        [z, y]: [usize; 2],
        row: &[F],
        weight: &[F],
        squared: bool,
        dst: &mut AnyViewMut,
    ) -> bool {
        let (a, b) = (self.affine.slope, self.affine.intercept);
        let (a, b) = if squared { (a * a, 0.0) } else { (a, b) };
        if pass == Pass::Gaps {
            let [cz, cy, cx] = self.at;
            for (x, v) in row.iter().enumerate() {
                let mut centre = [0.0];
                load_any(&self.src, [cz + z, cy + y, cx + x], self.missing, &mut centre);
                let keep = centre[0].is_nan() || weight[x].to_f64() == 0.0;
                fill_nan(dst, [z, y, x], if keep { f64::NAN } else { a * v.to_f64() + b });
            }
            return true;
        }
        match dst {
            AnyViewMut::F32(d) => store_row(self.level, row, a, b, d.row_at(z, y)),
            AnyViewMut::F64(d) => store_row(self.level, row, a, b, d.row_at(z, y)),
            other => panic!("a Gaussian moment is not {}", other.dtype()),
        }
    }
}

/// Stores a value where a NaN stands.
fn fill_nan(dst: &mut AnyViewMut, [z, y, x]: [usize; 3], value: f64) {
    fn put<T: Real>(dst: &mut T, value: f64) {
        if dst.to_f64().is_nan() {
            *dst = T::narrow(value);
        }
    }
    match dst {
        AnyViewMut::F32(d) => put(&mut d.row_at(z, y)[x], value),
        AnyViewMut::F64(d) => put(&mut d.row_at(z, y)[x], value),
        other => panic!("a Gaussian moment is not {}", other.dtype()),
    }
}

#[cfg(test)]
mod tests;
