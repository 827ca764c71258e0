//! Penner's filterable occlusion map: a pyramid of pooled moments (paper E).
//!
//! Blurring and halving an axis are one pass here: a cell pools the two blurred cells that it covers, which is a pool of six
//! finer cells with weights (1 5 10 10 5 1)/32 away from the ends. Variances are pooled as mean of variances plus variance
//! of means, which is what pooling twice gives too. Axes follow each other (z, y, x). Where a window holds a NaN cell, axes do
//! not part: such cells are made anew from their windows, the 125 taps of each blurred cell renormalised to what is valid.

mod gaps;

use super::Context;
use super::values::{blocks, load_any};
use crate::brick::scratch::{cut, padded};
use crate::grid::{Affine, AnyView, Region, Shape};
use crate::multiversion;
use gaps::Fine;

/// Unrounded pooled moments of one level, dense over a box: `variance` is the population variance of the pooled values.
/// A cell without valid voxels has NaN in both.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Moments {
    pub mean: Vec<f64>,
    pub variance: Vec<f64>,
}

impl Moments {
    fn resize(&mut self, len: usize) {
        self.mean.resize(len, 0.0);
        self.variance.resize(len, 0.0);
    }
}

/// Level 0: the data, scaled, variance 0; missing voxels NaN in both.
pub fn base(src: AnyView, affine: Affine, missing: Option<i64>, dst: &mut Moments) {
    let [nz, ny, nx] = src.shape();
    dst.resize(nz * ny * nx);
    for ([z, y, x], n) in blocks(src.shape()) {
        let start = (z * ny + y) * nx + x;
        let mean = &mut dst.mean[start..start + n];
        load_any(&src, [z, y, x], missing, mean);
        if !affine.is_identity() {
            mean.iter_mut().for_each(|m| *m = affine.apply(*m));
        }
        let variance = &mut dst.variance[start..start + n];
        variance.iter_mut().zip(mean).for_each(|(v, m)| *v = if m.is_nan() { f64::NAN } else { 0.0 });
    }
}

/// The box of the finer level (shape `fine_volume`) that [`coarsen`] needs for the box `coarse` of the next level, where
/// `halve[a]` says whether axis a is blurred and halved.
pub fn needed(coarse: Region, halve: [bool; 3], fine_volume: [usize; 3]) -> Region {
    let one = |a: usize, lo: i64, hi: i64| if halve[a] { (2 * lo - 2, 2 * hi + 2) } else { (lo, hi) };
    let ends: [(i64, i64); 3] = std::array::from_fn(|a| one(a, coarse.lo[a], coarse.hi[a]));
    Region::new(ends.map(|e| e.0), ends.map(|e| e.1)).clip(&Region::whole(fine_volume))
}

/// One step of the chain: on each halved axis the 5 taps (1 4 6 4 1)/16, renormalised to the voxels that exist, then
/// cell-centred halving (cell i pools blurred 2i and 2i + 1, where they exist). `fine` covers `fine_box` of a level of shape
/// `fine_volume`, `dst` gets `coarse_box` of the next. Panics if `fine_box` lacks cells that [`needed`] names.
#[allow(clippy::too_many_arguments)]
pub fn coarsen(
    fine: &Moments,
    fine_box: Region,
    fine_volume: [usize; 3],
    halve: [bool; 3],
    coarse_box: Region,
    dst: &mut Moments,
    cx: &mut Context,
) {
    let want = needed(coarse_box, halve, fine_volume);
    assert!(fine_box.contains(&want), "cells {want:?} are needed, {fine_box:?} are given");
    dst.resize(coarse_box.voxels());
    if coarse_box.is_empty() {
        return;
    }
    let (n, c) = (want.shape(), coarse_box.shape());
    let source = Grid { shape: fine_box.shape(), at: fine_box.offset_of(&want) };
    let steps = Steps { halve, volume: fine_volume, fine: want.lo, coarse: coarse_box.lo };
    let (wide, middle) = (n[1] * n[2], c[1] * n[2]);
    let bytes = cx.scratch.take(2 * (padded::<f64>(wide) + padded::<f64>(middle) + padded::<f64>(2 * n[2] + 8)));
    let (zm, bytes) = cut::<f64>(bytes, wide);
    let (zv, bytes) = cut::<f64>(bytes, wide);
    let (ym, bytes) = cut::<f64>(bytes, middle);
    let (yv, bytes) = cut::<f64>(bytes, middle);
    let (split_m, bytes) = cut::<f64>(bytes, 2 * n[2] + 8);
    let (split_v, _) = cut::<f64>(bytes, 2 * n[2] + 8);
    for z in 0..c[0] {
        for y in 0..n[1] {
            let row = |z: usize| source.row(z, y);
            let out = [&mut zm[y * n[2]..][..n[2]], &mut zv[y * n[2]..][..n[2]]];
            steps.rows(cx.level, 0, z, [&fine.mean, &fine.variance], row, out);
        }
        for y in 0..c[1] {
            let out = [&mut ym[y * n[2]..][..n[2]], &mut yv[y * n[2]..][..n[2]]];
            steps.rows(cx.level, 1, y, [zm, zv], |y| y * n[2], out);
        }
        for y in 0..c[1] {
            let from = [&ym[y * n[2]..][..n[2]], &yv[y * n[2]..][..n[2]]];
            let start = (z * c[1] + y) * c[2];
            let out = [&mut dst.mean[start..start + c[2]], &mut dst.variance[start..start + c[2]]];
            steps.along_x(cx.level, from, [&mut *split_m, &mut *split_v], out);
        }
    }
    if dst.variance.iter().all(|v| v.is_finite()) {
        return;
    }
    Fine { cells: fine, region: fine_box, volume: fine_volume, halve }.mend(cx.level, coarse_box, dst);
}

/// Where the needed box lies in the buffer of the finer level.
struct Grid {
    shape: Shape,
    at: [usize; 3],
}

impl Grid {
    fn row(&self, z: usize, y: usize) -> usize {
        ((self.at[0] + z) * self.shape[1] + self.at[1] + y) * self.shape[2] + self.at[2]
    }
}

/// The passes of one step of the chain.
struct Steps {
    halve: [bool; 3],
    volume: Shape,
    /// First cells of the needed and of the coarse box.
    fine: [i64; 3],
    coarse: [i64; 3],
}

const TAPS: [f64; 5] = [1.0, 4.0, 6.0, 4.0, 1.0];

/// Weights of the fine cells 2i - 2 .. 2i + 3 in coarse cell `i` of an axis of `n` fine cells: each of the blurred cells 2i and
/// 2i + 1 pools those of its five taps that exist, and the cell pools those of the two that exist.
pub fn full_weights(i: i64, n: i64) -> [f64; 6] {
    let mut blurred = [[0.0; 6]; 2];
    let mut found = 0.0;
    for (j, blurred) in blurred.iter_mut().enumerate().filter(|(j, _)| 2 * i + (*j as i64) < n) {
        let exists = |k: &usize| (0..n).contains(&(2 * i - 2 + (j + k) as i64));
        let total: f64 = (0..5).filter(exists).map(|k| TAPS[k]).sum();
        (0..5).filter(exists).for_each(|k| blurred[j + k] = TAPS[k] / total);
        found += 1.0;
    }
    std::array::from_fn(|k| (blurred[0][k] + blurred[1][k]) / found)
}

impl Steps {
    /// Cell `i` of the coarse box along `axis`, as a global index.
    fn global(&self, axis: usize, i: usize) -> i64 {
        self.coarse[axis] + i as i64
    }

    /// Fine cell `k` (0 to 5) of coarse cell `i`, as an index into the needed box; the nearest one that exists where it
    /// does not (its weight is 0).
    fn tap(&self, axis: usize, i: i64, k: usize) -> usize {
        let n = self.volume[axis] as i64;
        ((2 * i - 2 + k as i64).clamp(0, n - 1) - self.fine[axis]) as usize
    }

    /// Pass along z or y: pools the six rows of coarse cell `i`; `row` gives the place of a row of the needed box.
    fn rows(
        &self,
        level: super::simd::Level,
        axis: usize,
        i: usize,
        from: [&[f64]; 2],
        row: impl Fn(usize) -> usize,
        out: [&mut [f64]; 2],
    ) {
        let n = out[0].len();
        let i = self.global(axis, i);
        let [means, variances] = from;
        let [out_m, out_v] = out;
        if !self.halve[axis] {
            let place = row((i - self.fine[axis]) as usize);
            out_m.copy_from_slice(&means[place..place + n]);
            out_v.copy_from_slice(&variances[place..place + n]);
            return;
        }
        let places: [usize; 6] = std::array::from_fn(|k| row(self.tap(axis, i, k)));
        let cells = Six {
            mean: places.map(|p| &means[p..p + n]),
            variance: places.map(|p| &variances[p..p + n]),
            weight: full_weights(i, self.volume[axis] as i64),
        };
        pool_six(level, &cells, out_m, out_v);
    }

    /// Pass along x: the row's even and odd cells are set apart, so that taps are whole rows again; a missing cell at an
    /// end is a copy of the nearest, as in [`Steps::tap`], and ends are pooled one by one.
    fn along_x(&self, level: super::simd::Level, from: [&[f64]; 2], split: [&mut [f64]; 2], out: [&mut [f64]; 2]) {
        let [out_m, out_v] = out;
        let n = out_m.len();
        if !self.halve[2] {
            out_m.copy_from_slice(from[0]);
            out_v.copy_from_slice(from[1]);
            return;
        }
        let first = self.global(2, 0);
        let halves = n + 2; // even or odd cells from 2 (first - 1) on
        let [split_m, split_v] = split;
        for (split, from) in [(&mut *split_m, from[0]), (&mut *split_v, from[1])] {
            let (even, odd) = split[..2 * halves].split_at_mut(halves);
            let last = from.len() as i64 - 1;
            let start = 2 * (first - 1) - self.fine[2];
            for (h, (even, odd)) in even.iter_mut().zip(odd).enumerate() {
                let cell = start + 2 * h as i64;
                *even = from[cell.clamp(0, last) as usize];
                *odd = from[(cell + 1).clamp(0, last) as usize];
            }
        }
        let taps: [usize; 6] = std::array::from_fn(|k| (k % 2) * halves + k / 2);
        let (split_m, split_v) = (&*split_m, &*split_v);
        let volume = self.volume[2] as i64;
        let inside = |i: i64| 2 * i - 2 >= 0 && 2 * i + 3 < volume;
        let low = (0..n).take_while(|&x| !inside(first + x as i64)).count();
        let high = n - (low..n).rev().take_while(|&x| !inside(first + x as i64)).count();
        let mut run = |from: usize, to: usize| {
            let cells = Six {
                mean: taps.map(|t| &split_m[t + from..t + to]),
                variance: taps.map(|t| &split_v[t + from..t + to]),
                weight: full_weights(first + from as i64, volume),
            };
            pool_six(level, &cells, &mut out_m[from..to], &mut out_v[from..to]);
        };
        (0..low).for_each(|x| run(x, x + 1));
        if low < high {
            run(low, high);
        }
        (high..n).for_each(|x| run(x, x + 1));
    }
}

/// Six rows of cells and their weights.
struct Six<'a> {
    mean: [&'a [f64]; 6],
    variance: [&'a [f64]; 6],
    weight: [f64; 6],
}

multiversion! {
    /// Pools six rows. Relative to the third tap (cell 2i, which always exists), so that constants stay what they are.
    fn pool_six[](cells: &Six, mean: &mut [f64], variance: &mut [f64]) -> () = pool_six_inner;
}

#[inline(always)]
fn pool_six_inner(cells: &Six, mean: &mut [f64], variance: &mut [f64]) {
    let n = mean.len();
    let variance = &mut variance[..n];
    let [m0, m1, m2, m3, m4, m5] = cells.mean.map(|m| &m[..n]);
    let [v0, v1, v2, v3, v4, v5] = cells.variance.map(|v| &v[..n]);
    let [w0, w1, w2, w3, w4, w5] = cells.weight;
    for i in 0..n {
        let p = m2[i];
        let shift = (w0 * (m0[i] - p) + w1 * (m1[i] - p)) + w3 * (m3[i] - p) + (w4 * (m4[i] - p) + w5 * (m5[i] - p));
        let m = p + shift;
        let one = |w: f64, v: f64, x: f64| w * (v + (x - m) * (x - m));
        mean[i] = m;
        variance[i] = (one(w0, v0[i], m0[i]) + one(w1, v1[i], m1[i]))
            + (one(w2, v2[i], p) + one(w3, v3[i], m3[i]))
            + (one(w4, v4[i], m4[i]) + one(w5, v5[i], m5[i]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::Scratch;
    use crate::grid::DType;
    use crate::kernel::hostile::{SHAPES, calm, constant, volume};
    use crate::kernel::simd::Level;

    /// One step as section 4 has it: every cell blurred over what is valid, then pairs pooled.
    fn step_whole(level: &Moments, shape: Shape, halve: [bool; 3]) -> (Moments, Shape) {
        let pool = |cells: &[(f64, f64, f64)]| {
            let valid: Vec<_> = cells.iter().filter(|c| !c.1.is_nan()).collect();
            if valid.is_empty() {
                return (f64::NAN, f64::NAN);
            }
            let total: f64 = valid.iter().map(|c| c.0).sum();
            let mean = valid.iter().map(|c| c.0 * c.1).sum::<f64>() / total;
            (mean, valid.iter().map(|c| c.0 * (c.2 + (c.1 - mean).powi(2))).sum::<f64>() / total)
        };
        let index = |p: [i64; 3]| ((p[0] * shape[1] as i64 + p[1]) * shape[2] as i64 + p[2]) as usize;
        let whole = Region::whole(shape);
        let reach = halve.map(|h| 2 * usize::from(h));
        let blur = |c: [i64; 3]| {
            let taps: Vec<_> = Region::new(c, c.map(|i| i + 1))
                .grow(reach)
                .clip(&whole)
                .iter()
                .map(|p| {
                    let weight = |a: usize| [1.0, 4.0, 6.0, 4.0, 1.0][(p[a] - c[a] + 2) as usize];
                    ((0..3).map(weight).product(), level.mean[index(p)], level.variance[index(p)])
                })
                .collect();
            let (m, v) = pool(&taps);
            (1.0, m, v)
        };
        let coarse: Shape = std::array::from_fn(|a| if halve[a] { shape[a].div_ceil(2) } else { shape[a] });
        let factor = halve.map(|h| 1 + i64::from(h));
        let mut out = Moments::default();
        for p in Region::whole(coarse).iter() {
            let covered =
                Region::new(std::array::from_fn(|a| p[a] * factor[a]), std::array::from_fn(|a| (p[a] + 1) * factor[a]));
            let (m, v) = pool(&covered.clip(&whole).iter().map(blur).collect::<Vec<_>>());
            out.mean.push(m);
            out.variance.push(v);
        }
        (out, coarse)
    }

    fn step(
        fine: &Moments,
        fine_box: Region,
        volume: Shape,
        halve: [bool; 3],
        coarse: Region,
        level: Level,
    ) -> Moments {
        let (mut dst, mut scratch) = (Moments::default(), Scratch::new());
        coarsen(fine, fine_box, volume, halve, coarse, &mut dst, &mut Context { level, scratch: &mut scratch });
        dst
    }

    /// The cells of `part`, cut out of a level.
    fn part_of(level: &Moments, shape: Shape, part: Region) -> Moments {
        let index = |p: [i64; 3]| (p[0] as usize * shape[1] + p[1] as usize) * shape[2] + p[2] as usize;
        let pick = |v: &[f64]| part.iter().map(|p| v[index(p)]).collect();
        Moments { mean: pick(&level.mean), variance: pick(&level.variance) }
    }

    #[test]
    fn the_chain_equals_blurring_and_halving_for_every_box_and_level() {
        let halvings = [[true; 3], [true, false, true], [false, true, false], [false, false, true]];
        for (case, dtype) in [DType::U8, DType::F32, DType::F64].into_iter().enumerate() {
            for (s, shape) in SHAPES.into_iter().enumerate() {
                for halve in halvings {
                    let v = if case == 1 { volume(dtype, shape, s as u64) } else { calm(dtype, shape, s as u64) };
                    let mut fine = Moments::default();
                    base(v.view(shape), Affine::new(-1.0, 3.0), Some(30), &mut fine);
                    // infinities have a test of their own: pooling twice and at once differ in which NaN they leave
                    fine.mean.iter_mut().for_each(|m| *m = if m.abs() > 1e20 { 7.0 } else { *m });
                    let mut size = shape;
                    for _ in 0..3 {
                        let (expect, coarse) = step_whole(&fine, size, halve);
                        let whole = Region::whole(coarse);
                        let got = step(&fine, Region::whole(size), size, halve, whole, Level::Baseline);
                        for (i, (e, g)) in expect.mean.iter().zip(&got.mean).enumerate() {
                            let (ev, gv) = (expect.variance[i], got.variance[i]);
                            assert!((e - g).abs() <= 1e-12 * e.abs().max(100.0) || e.is_nan() && g.is_nan());
                            assert!((ev - gv).abs() <= 1e-10 * ev.max(1.0) || ev.is_nan() && gv.is_nan(), "{ev} {gv}");
                        }
                        for level in Level::available() {
                            for edge in [3, 1000] {
                                for cell in whole.cells([0; 3], [edge; 3]).iter() {
                                    let part = Region::of_cell(cell, [0; 3], [edge; 3]).clip(&whole);
                                    let from = needed(part, halve, size).grow([1, 0, 1]).clip(&Region::whole(size));
                                    let brick = part_of(&fine, size, from);
                                    let cells = step(&brick, from, size, halve, part, level);
                                    let bits = |m: &Moments| {
                                        m.mean.iter().chain(&m.variance).map(|v| v.to_bits()).collect::<Vec<_>>()
                                    };
                                    assert_eq!(bits(&cells), bits(&part_of(&got, coarse, part)), "{shape:?} {level:?}");
                                }
                            }
                        }
                        (fine, size) = (got, coarse);
                    }
                }
            }
        }
    }

    /// With missing cells, too, no axis comes before another.
    #[test]
    fn axes_may_be_exchanged() {
        let shape = [6, 6, 6];
        let at = |[z, y, x]: [usize; 3]| (z * 6 + y) * 6 + x;
        let v: Vec<f64> = (0..216).map(|i| if i % 5 < 3 { f64::NAN } else { (i * i % 17) as f64 }).collect();
        let cells = |turn: fn([usize; 3]) -> [usize; 3]| {
            let mean: Vec<f64> = (0..216).map(|i| v[at(turn([i / 36, i / 6 % 6, i % 6]))]).collect();
            let variance = mean.iter().map(|m| m * 0.0).collect();
            let fine = Moments { mean, variance };
            step(&fine, Region::whole(shape), shape, [true; 3], Region::whole([3; 3]), Level::detect())
        };
        let (plain, turned) = (cells(|p| p), cells(|[z, y, x]| [x, z, y]));
        for i in 0..27 {
            let [z, y, x] = [i / 9, i / 3 % 3, i % 3];
            let other = (x * 3 + z) * 3 + y;
            assert!((turned.mean[i] - plain.mean[other]).abs() < 1e-12, "cell {i}");
            assert!((turned.variance[i] - plain.variance[other]).abs() < 1e-10, "cell {i}");
        }
    }

    #[test]
    fn constants_stay_and_infinities_stay_near() {
        let shape = [5, 6, 40];
        for (dtype, value) in
            [(DType::F32, 0.1), (DType::F64, f64::MAX), (DType::U16, 65535.0), (DType::F64, 1.0 / 3.0)]
        {
            let v = constant(dtype, shape, value);
            let mut fine = Moments::default();
            base(v.view(shape), Affine::IDENTITY, None, &mut fine);
            fine.mean[77] = f64::NAN;
            fine.variance[77] = f64::NAN;
            let got = step(&fine, Region::whole(shape), shape, [true; 3], Region::whole([3, 3, 20]), Level::detect());
            assert!(
                got.mean.iter().all(|m| *m == v.at(0)) && got.variance.iter().all(|v| *v == 0.0),
                "{dtype} {value}"
            );
        }
        let mut fine = Moments { mean: vec![1.0; 40], variance: vec![0.0; 40] };
        fine.mean[20] = f64::INFINITY;
        let got =
            step(&fine, Region::whole([1, 1, 40]), [1, 1, 40], [true; 3], Region::whole([1, 1, 20]), Level::detect());
        for i in 0..20 {
            let reached = (9..=11).contains(&i); // cell i sees 2i - 2 ..= 2i + 3
            let expect = if reached { f64::INFINITY } else { 1.0 };
            assert_eq!(got.mean[i], expect, "cell {i}");
            assert_eq!(got.variance[i].is_nan(), reached, "cell {i}");
        }
    }
}
