//! Which voxels a scene needs (`where`).

use super::values::{BLOCK, blocks, load_any};
use crate::grid::{Affine, AnyView, Region, ViewMut};

/// Farther than any volume reaches: bounds indices made from a band that has no bound itself.
const FAR: f64 = 1e15;

/// 1 where `min <= v <= max` (scaled, either bound optional), else 0; NaN and `missing` are not needed. Panics if the
/// extents differ.
pub fn range(
    src: AnyView,
    affine: Affine,
    missing: Option<i64>,
    min: Option<f64>,
    max: Option<f64>,
    mut dst: ViewMut<u8>,
) {
    assert_eq!(src.shape(), dst.shape, "extents differ");
    let (min, max) = (min.unwrap_or(f64::NEG_INFINITY), max.unwrap_or(f64::INFINITY));
    let mut values = [0.0; BLOCK];
    for (at, n) in blocks(dst.shape) {
        load_scaled(&src, at, affine, missing, &mut values[..n]);
        let row = &mut dst.row_at(at[0], at[1])[at[2]..at[2] + n];
        row.iter_mut().zip(&values).for_each(|(d, v)| *d = (*v >= min && *v <= max) as u8);
    }
}

/// 1 within `band` of an isosurface crossing, else 0: a crossing lies between 6-neighbours a < iso <= b (scaled values) at
/// the linear point; distances are Euclidean, in voxels of the finest axis of `spacing`, and `band` has a slack of 1e-9.
/// NaN and `missing` voxels have no crossings and are not needed. `src` covers `src_box`: the output box `dst_box` grown by
/// [`iso_reach`], clipped to the volume.
#[allow(clippy::too_many_arguments)]
pub fn iso_band(
    src: AnyView,
    src_box: Region,
    affine: Affine,
    missing: Option<i64>,
    iso: &[f64],
    band: f64,
    spacing: [f64; 3],
    mut dst: ViewMut<u8>,
    dst_box: Region,
) {
    assert!(src.shape() == src_box.shape() && dst.shape == dst_box.shape(), "extents differ");
    for (at, n) in blocks(dst.shape) {
        dst.row_at(at[0], at[1])[at[2]..at[2] + n].fill(0);
    }
    let finest = spacing[0].min(spacing[1]).min(spacing[2]);
    let ball = Ball { unit: spacing.map(|s| s / finest), limit: (band + 1e-9) * (band + 1e-9) };
    let offset: [i64; 3] = std::array::from_fn(|a| src_box.lo[a] - dst_box.lo[a]);
    let (mut here, mut next) = ([0.0; BLOCK], [0.0; BLOCK]);
    let shape = src.shape();
    for (at, n) in blocks(shape) {
        load_scaled(&src, at, affine, missing, &mut here[..n]);
        for axis in 0..3 {
            let mut to = at;
            to[axis] += 1;
            let m = if axis == 2 { n.min(shape[2] - to[2].min(shape[2])) } else { n };
            if to[axis] >= shape[axis] {
                continue;
            }
            load_scaled(&src, to, affine, missing, &mut next[..m]);
            for &level in iso {
                if !any_crossing(&here[..m], &next[..m], level) {
                    continue;
                }
                for i in 0..m {
                    if let Some(t) = crossing(here[i], next[i], level) {
                        let p = [at[0] as i64, at[1] as i64, (at[2] + i) as i64];
                        ball.mark(&mut dst, std::array::from_fn(|a| p[a] + offset[a]), axis, t);
                    }
                }
            }
        }
    }
    clear_missing(src, missing, offset, dst);
}

/// Halo that [`iso_band`] needs, voxels per axis: the band and the edge that holds the crossing.
pub fn iso_reach(band: f64, spacing: [f64; 3]) -> [usize; 3] {
    let finest = spacing[0].min(spacing[1]).min(spacing[2]);
    spacing.map(|s| ((band + 1e-9) * finest / s).ceil().min(FAR) as usize + 1)
}

fn load_scaled(src: &AnyView, at: [usize; 3], affine: Affine, missing: Option<i64>, dst: &mut [f64]) {
    load_any(src, at, missing, dst);
    if !affine.is_identity() {
        dst.iter_mut().for_each(|v| *v = affine.apply(*v));
    }
}

/// Whether some pair lies on different sides of `level` (NaN counts as below; the caller looks closer).
fn any_crossing(a: &[f64], b: &[f64], level: f64) -> bool {
    a.iter().zip(b).fold(false, |any, (a, b)| any | ((*a >= level) != (*b >= level)))
}

/// Where between two neighbours the surface lies, from 0 (at `a`) to 1 (at `b`): the lower value is below `level`, the
/// higher one at or above it.
fn crossing(a: f64, b: f64, level: f64) -> Option<f64> {
    if a.is_nan() || b.is_nan() || (a >= level) == (b >= level) {
        return None;
    }
    let t = match (a.is_finite(), b.is_finite()) {
        (true, true) => (level * 0.5 - a * 0.5) / (b * 0.5 - a * 0.5), // halved, so that extremes do not overflow
        (true, false) => 0.0,
        (false, true) => 1.0,
        (false, false) => 0.5,
    };
    Some(t.clamp(0.0, 1.0))
}

/// What lies within the band of a point.
struct Ball {
    /// Length of a voxel per axis, in voxels of the finest.
    unit: [f64; 3],
    /// Largest squared distance.
    limit: f64,
}

impl Ball {
    /// Squared distance along `axis` of the voxel `d` steps away, where the point lies `t` steps along `along`. All terms
    /// come from differences of indices, so that the box never matters.
    fn square(&self, axis: usize, d: i64, along: usize, t: f64) -> f64 {
        let steps = if axis == along { d as f64 - t } else { d as f64 };
        let length = steps * self.unit[axis];
        length * length
    }

    /// Marks every voxel of `dst` within the band of the point `t` steps along `along` from voxel `p` (in indices of `dst`).
    fn mark(&self, dst: &mut ViewMut<u8>, p: [i64; 3], along: usize, t: f64) {
        let reach: [i64; 3] = self.unit.map(|u| (self.limit.sqrt() / u).ceil().min(FAR) as i64 + 1);
        let range = |a: usize, n: usize| (p[a] - reach[a]).max(0)..(p[a] + reach[a] + 1).min(n as i64);
        let [nz, ny, nx] = dst.shape;
        for z in range(0, nz) {
            let dz2 = self.square(0, z - p[0], along, t);
            if dz2 > self.limit {
                continue;
            }
            for y in range(1, ny) {
                let dyz2 = dz2 + self.square(1, y - p[1], along, t);
                let inside = |d: i64| dyz2 + self.square(2, d, along, t) <= self.limit;
                if dyz2 > self.limit {
                    continue;
                }
                // the reach along x: an estimate, then moved until it is what `inside` says
                let shift = if along == 2 { t } else { 0.0 };
                let half = ((self.limit - dyz2).sqrt() / self.unit[2]).min(FAR);
                let (mut lo, mut hi) = ((shift - half).floor() as i64 - 1, (shift + half).ceil() as i64 + 1);
                while lo <= hi && !inside(lo) {
                    lo += 1;
                }
                while hi >= lo && !inside(hi) {
                    hi -= 1;
                }
                let (from, to) = ((p[2] + lo).max(0), (p[2] + hi + 1).min(nx as i64));
                if from < to {
                    dst.row_at(z as usize, y as usize)[from as usize..to as usize].fill(1);
                }
            }
        }
    }
}

/// Voxels that are NaN or `missing` are not needed, however near a surface is. `offset` is the place of `src` in `dst`.
fn clear_missing(src: AnyView, missing: Option<i64>, offset: [i64; 3], mut dst: ViewMut<u8>) {
    if missing.is_none() && !src.dtype().is_float() {
        return;
    }
    let mut values = [0.0; BLOCK];
    for (at, n) in blocks(dst.shape) {
        let from = std::array::from_fn(|a| (at[a] as i64 - offset[a]) as usize);
        load_any(&src, from, missing, &mut values[..n]);
        let row = &mut dst.row_at(at[0], at[1])[at[2]..at[2] + n];
        row.iter_mut().zip(&values).for_each(|(d, v)| *d &= !v.is_nan() as u8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::Voxels;
    use crate::grid::DType;
    use crate::kernel::hostile::{SHAPES, volume};

    #[test]
    fn range_is_inclusive_in_scaled_units_and_leaves_out_the_missing() {
        let v = Voxels::I16(vec![-3, 0, 1, 2, 3, 99]);
        let mut got = [9u8; 6];
        let run = |min, max, got: &mut [u8; 6]| {
            range(v.view([1, 2, 3]), Affine::new(-2.0, 1.0), Some(2), min, max, ViewMut::dense(got, [1, 2, 3]))
        };
        run(Some(-5.0), Some(1.0), &mut got); // scaled: 7 1 -1 (-3) -5 -197
        assert_eq!(got, [0, 1, 1, 0, 1, 0]);
        run(None, None, &mut got);
        assert_eq!(got, [1, 1, 1, 0, 1, 1]);
        let f = Voxels::F32(vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.5, 0.0, -0.0]);
        range(f.view([1, 2, 3]), Affine::IDENTITY, None, Some(0.0), None, ViewMut::dense(&mut got, [1, 2, 3]));
        assert_eq!(got, [0, 1, 0, 1, 1, 1]);
    }

    /// Every crossing against every voxel.
    fn reference(v: &Voxels, shape: [usize; 3], missing: Option<i64>, iso: &[f64], band: f64, s: [f64; 3]) -> Vec<u8> {
        let whole = Region::whole(shape);
        let at = |p: [i64; 3]| {
            let value = v.at((p[0] as usize * shape[1] + p[1] as usize) * shape[2] + p[2] as usize);
            if missing.is_some_and(|m| !v.dtype().is_float() && m as f64 == value) { f64::NAN } else { value }
        };
        let finest = s[0].min(s[1]).min(s[2]);
        let mut points = Vec::new();
        for p in whole.iter() {
            for axis in 0..3 {
                let mut q = p;
                q[axis] += 1;
                if q[axis] == whole.hi[axis] {
                    continue;
                }
                for &level in iso {
                    if let Some(t) = crossing(at(p), at(q), level) {
                        let mut point = p.map(|i| i as f64);
                        point[axis] += t;
                        points.push(point);
                    }
                }
            }
        }
        let near = |q: [i64; 3], c: &[f64; 3]| {
            (0..3).map(|a| ((q[a] as f64 - c[a]) * s[a] / finest).powi(2)).sum::<f64>().sqrt() <= band + 1e-9
        };
        whole.iter().map(|q| (!at(q).is_nan() && points.iter().any(|c| near(q, c))) as u8).collect()
    }

    #[test]
    fn band_equals_brute_force_for_every_type_box_and_spacing() {
        for (case, dtype) in DType::ALL.into_iter().enumerate() {
            for (k, shape) in SHAPES.into_iter().enumerate() {
                // a smooth field, so that the mask is neither empty nor full, with hostile voxels
                let mut v = volume(dtype, shape, 11 + case as u64);
                if k == 3 {
                    v.fill(10.0);
                    let middle = v.len() / 2 + 7;
                    crate::with_voxels!(&mut v, v => v[middle] = 60 as _);
                }
                let (band, s) = [(2.0, [1.0; 3]), (0.0, [2.0, 1.0, 1.5]), (1.3, [0.5, 2.0, 0.7])][(case + k) % 3];
                let iso = [20.0, 45.5];
                let expect = reference(&v, shape, Some(5), &iso, band, s);
                let whole = Region::whole(shape);
                for edge in [3, 64] {
                    for cell in whole.cells([0; 3], [edge; 3]).iter() {
                        let dst_box = Region::of_cell(cell, [0; 3], [edge; 3]).clip(&whole);
                        let src_box = dst_box.grow(iso_reach(band, s)).clip(&whole);
                        let mut part = Voxels::zeroed(dtype, src_box.voxels());
                        let n = src_box.shape();
                        crate::brick::gather::copy_common(v.view(shape), whole, part.view_mut(n), src_box);
                        let mut got = vec![9u8; dst_box.voxels()];
                        let out = ViewMut::dense(&mut got, dst_box.shape());
                        iso_band(part.view(n), src_box, Affine::IDENTITY, Some(5), &iso, band, s, out, dst_box);
                        for (q, got) in dst_box.iter().zip(got) {
                            let i = (q[0] as usize * shape[1] + q[1] as usize) * shape[2] + q[2] as usize;
                            assert_eq!(got, expect[i], "{dtype} {shape:?} {q:?} bricks of {edge}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn an_endless_band_takes_every_voxel_of_a_volume_with_a_crossing() {
        let v = Voxels::U8(vec![0, 0, 9, 9, 9]);
        let whole = Region::whole([1, 1, 5]);
        let mut got = [0u8; 5];
        let out = ViewMut::dense(&mut got, [1, 1, 5]);
        iso_band(v.view([1, 1, 5]), whole, Affine::IDENTITY, None, &[5.0], f64::MAX, [1.0; 3], out, whole);
        assert_eq!(got, [1; 5]);
    }

    #[test]
    fn one_step_marks_a_slab_of_the_band_and_negative_slopes_count() {
        let v = Voxels::U8((0..16).map(|x| if x < 8 { 0 } else { 10 }).collect());
        let whole = Region::whole([1, 1, 16]);
        for affine in [Affine::IDENTITY, Affine::new(-1.0, 10.0)] {
            let mut got = [0u8; 16];
            let out = ViewMut::dense(&mut got, [1, 1, 16]);
            iso_band(v.view([1, 1, 16]), whole, affine, None, &[5.0], 2.0, [3.0, 2.0, 1.0], out, whole);
            let marked: Vec<usize> = (0..16).filter(|&x| got[x] == 1).collect();
            assert_eq!(marked, [6, 7, 8, 9], "the crossing lies at 7.5");
        }
    }
}
