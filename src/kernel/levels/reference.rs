//! What the kernel must compute, one voxel at a time, short enough to check by reading. Not fast.

use super::{Levels, PARTS};
use crate::grid::{View, Voxel};
use crate::stage::{Ties, WindowParams};

/// Openness of voxel `c` of `src` from levels; NaN where it is missing.
pub fn voxel<T: Voxel>(src: View<T>, c: [usize; 3], levels: &Levels, params: &WindowParams, ties: Ties) -> f64 {
    let missing = |v: f64| v.is_nan() || !T::DTYPE.is_float() && params.missing.is_some_and(|m| m as f64 == v);
    let turn = |v: f64| if params.flipped() { -v } else { v };
    let centre = src.at(c).to_f64();
    if missing(centre) {
        return f64::NAN;
    }
    let v = turn(centre);
    if v.is_infinite() {
        return if v > 0.0 { 1.0 } else { 0.0 };
    }
    let axis =
        |a: usize| c[a].saturating_sub(params.radius[a])..c[a].saturating_add(params.radius[a] + 1).min(src.shape[a]);
    let mut window = Vec::new();
    for (z, y) in axis(0).flat_map(|z| axis(1).map(move |y| (z, y))) {
        window.extend(src.row_at(z, y)[axis(2)].iter().map(|v| v.to_f64()).filter(|v| !missing(*v)).map(turn));
    }
    if window.iter().all(|w| *w == v) {
        return if ties == Ties::Le { 1.0 } else { 0.5 };
    }
    let at_most = |t: f64| window.iter().filter(|w| **w <= t).count() as f64;
    let n = window.len() as f64;
    // The level that closes the interval of v.
    let Some(k) = levels.at.iter().position(|t| v <= *t) else { return 1.0 };
    let before = if k == 0 { 0.0 } else { at_most(levels.at[k - 1]) };
    let after = at_most(levels.at[k]);
    if k == 0 || levels.step[k] {
        return if ties == Ties::Le { after / n } else { (before + after) / (2.0 * n) };
    }
    let (from, to) = (levels.at[k - 1], levels.at[k]);
    // The density rises or falls within the interval as it does around it.
    let twice_before = if k < 2 { 0.0 } else { at_most(levels.at[k - 2]) };
    let twice_after = levels.at.get(k + 1).map_or(n, |t| at_most(*t));
    let lean = ((twice_after - after) - (before - twice_before)) / (twice_after - twice_before).max(1.0);
    let rise = |parts: usize| if parts == 0 { 0.0 } else { levels.rise[k][parts - 1] };
    let slope = |u: f64| {
        let way = ((u - from) / (to - from)).max(0.0) * PARTS as f64;
        let parts = (way.floor() as usize).min(PARTS - 1);
        let risen = rise(parts) + (rise(parts + 1) - rise(parts)) * (way - parts as f64);
        (before + (after - before) * (risen - lean * risen * (1.0 - risen))) / n
    };
    let below = if T::DTYPE.is_float() { v } else { v - 1.0 };
    if ties == Ties::Le { slope(v) } else { (slope(v) + slope(below)) / 2.0 }
}
