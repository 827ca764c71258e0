//! Exact local rank: openness as the share of the window's voxels that are not above the centre (A 2.3).
//!
//! Voxels become keys in scratch, padded along x, so that one order serves every type and `solid`: of two voxels the denser
//! has the larger key, and a missing voxel or a pad has the least. Then `#{v_i <= v} = n - #{k_i > k}`, which pads and
//! missing voxels never enter, and n is a product of extents, or a second count where voxels are missing. Everything is
//! counted in integers, so nothing depends on brick, order or instruction set.

mod buckets;
mod coded;
mod compare;
mod read;
mod slide;
mod vector;

use super::Context;
use super::values::missing_as;
use crate::brick::scratch::{cut, padded};
use crate::grid::{AnyView, AnyViewMut, DType, Shape, View, Voxel};
use crate::stage::{Ties, WindowParams, WindowShape};

/// Writes the exact openness of the box that starts at voxel `at` of `src`. `dst` has `src.dtype().result()`. A voxel at
/// +inf (after `solid` and a negative slope turned the order) gives 1, at -inf 0, whatever the window; a missing one NaN.
/// Panics if extents or types disagree.
pub fn rank(
    src: AnyView,
    params: &WindowParams,
    shape: WindowShape,
    ties: Ties,
    at: [usize; 3],
    mut dst: AnyViewMut,
    cx: &mut Context,
) {
    let (from, to) = (src.shape(), dst.shape());
    assert_eq!(dst.dtype(), src.dtype().result(), "type of the openness of {}", src.dtype());
    assert!((0..3).all(|a| at[a] + to[a] <= from[a]), "the output box sticks out of the source");
    if to.contains(&0) {
        return;
    }
    let plan = Plan::new(from, to, at, params.radius, shape, ties);
    let bytes = cx.scratch.take(scratch_bytes(src.dtype(), from, to, params, shape));
    let flipped = params.flipped();
    macro_rules! run {
        ($view:expr, $key:ty, $lanes:literal) => {{
            let missing = missing_as(params.missing);
            count_all::<_, $key, $lanes>(cx.level, $view, missing, flipped, &plan, bytes, dst)
        }};
    }
    if let (true, AnyViewMut::F32(dst)) = (coded::serves(&plan, src.dtype()), &mut dst) {
        macro_rules! coded {
            ($view:expr, $key:ty) => {{
                let source = coded::Source { view: $view, missing: missing_as(params.missing), flipped };
                return coded::count_all::<_, $key>(cx.level, &source, &plan, bytes, dst);
            }};
        }
        match src {
            AnyView::U8(v) => coded!(v, i8),
            AnyView::I8(v) => coded!(v, i8),
            AnyView::U16(v) => coded!(v, i16),
            AnyView::I16(v) => coded!(v, i16),
            _ => {}
        }
    }
    match src {
        AnyView::U8(v) if plan.slides() => {
            slide_all(cx.level, v, missing_as(params.missing), flipped, &plan, bytes, dst);
        }
        AnyView::I8(v) if plan.slides() => {
            slide_all(cx.level, v, missing_as(params.missing), flipped, &plan, bytes, dst);
        }
        AnyView::U8(v) => run!(v, i8, 64),
        AnyView::I8(v) => run!(v, i8, 64),
        AnyView::U16(v) => run!(v, i16, 32),
        AnyView::I16(v) => run!(v, i16, 32),
        AnyView::U32(v) => run!(v, i32, 16),
        AnyView::I32(v) => run!(v, i32, 16),
        AnyView::F32(v) => run!(v, f32, 16),
        AnyView::F64(v) => run!(v, f64, 8),
    }
}

/// Bytes of scratch that [`rank`] takes at most.
pub fn scratch_bytes(dtype: DType, src: Shape, dst: Shape, params: &WindowParams, shape: WindowShape) -> usize {
    // at = 0 needs no more rows than any other place, but an inner box may need the whole source
    let plan = Plan::new(src, dst, [0; 3], params.radius, shape, Ties::Le);
    let voxels = src[0] * src[1] * plan.width;
    let keys = match dtype.size() {
        1 => padded::<i8>(voxels),
        2 => padded::<i16>(voxels),
        4 => padded::<i32>(voxels),
        _ => padded::<f64>(voxels),
    };
    let columns = if dtype.size() == 1 { padded::<u16>(slide::columns(&plan)) } else { 0 };
    let coded = match dtype.size() {
        1 => coded::scratch_bytes::<i8>(&plan),
        2 => coded::scratch_bytes::<i16>(&plan),
        _ => 0,
    };
    (keys + padded::<i8>(voxels) + columns).max(coded)
}

/// What [`rank`] takes on a box, in nanoseconds: once, per voxel that it writes, per voxel that it sees.
pub fn cost(dtype: DType, params: &WindowParams, shape: WindowShape) -> [f64; 3] {
    let window: f64 = params.radius.iter().map(|&r| 2.0 * r as f64 + 1.0).product();
    let counted = shape == WindowShape::Box && coded::pays(params.radius, dtype);
    match dtype.size() {
        1 if counted => [5e3, 8.0, 1.2],
        2 if counted => [800e3, 200.0, 10.0],
        size => [5e3, 0.014 * window * (size as f64).max(2.0), 1.0],
    }
}

/// Where windows lie: all that does not depend on the element type.
struct Plan {
    src: Shape,
    dst: Shape,
    at: [usize; 3],
    /// Half-widths, no larger than the source.
    radius: [usize; 3],
    ties: Ties,
    /// Voxels that the window has on each side along x at row `(dz, dy)`: `reach[(dz + rz) * (2 ry + 1) + dy + ry]`; `None`
    /// where it has none at all. Empty for a box.
    reach: Vec<Option<u32>>,
    /// Keys of a padded row: the radius, the output box in whole vectors, the radius.
    width: usize,
}

/// Voxels of a window from which sliding histograms are used: on noisy u8 rows of 256 they take 75 ns per voxel at radius
/// 10, comparing takes 91 there and grows with the window (2-core Zen 4 VM, AVX-512, 2026-11-23).
const SLIDE_FROM: usize = 7000;

/// Most lanes of any key type; rows are padded to it.
const MOST_LANES: usize = 64;

impl Plan {
    fn new(src: Shape, dst: Shape, at: [usize; 3], radius: [usize; 3], shape: WindowShape, ties: Ties) -> Plan {
        let clipped: [usize; 3] = std::array::from_fn(|a| radius[a].min(src[a].saturating_sub(1)));
        let reach = match shape {
            WindowShape::Box => Vec::new(),
            WindowShape::Ball => ball(radius, clipped),
        };
        let width = dst[2].next_multiple_of(MOST_LANES) + 2 * clipped[2];
        Plan { src, dst, at, radius: clipped, ties, reach, width }
    }

    /// Reach along x at row `(dz, dy)` of the window.
    #[inline(always)]
    fn reach(&self, dz: i64, dy: i64) -> Option<usize> {
        if self.reach.is_empty() {
            return Some(self.radius[2]);
        }
        let (rz, ry) = (self.radius[0] as i64, self.radius[1] as i64);
        self.reach[((dz + rz) * (2 * ry + 1) + dy + ry) as usize].map(|r| r as usize)
    }

    /// Whether sliding histograms are the faster way for keys of 8 bits: they cost about the same for every radius, while
    /// comparing grows with the window.
    fn slides(&self) -> bool {
        let window: [usize; 3] = self.radius.map(|r| 2 * r + 1);
        let rows = window[0] * window[1];
        self.reach.is_empty() && rows * window[2] > SLIDE_FROM && rows <= usize::from(u16::MAX)
    }

    /// First and last row (or plane) of the window about row `i` of the output box, in voxels of the source.
    #[inline(always)]
    fn window(&self, axis: usize, i: usize) -> std::ops::RangeInclusive<usize> {
        let centre = self.at[axis] + i;
        centre.saturating_sub(self.radius[axis])..=(centre + self.radius[axis]).min(self.src[axis] - 1)
    }

    /// Voxels that exist in the windows about output voxels `[z, y, x..]`. Past the end of the output row: rubbish.
    fn sizes(&self, z: usize, y: usize, x: usize, sizes: &mut [u32]) {
        let (cz, cy) = ((self.at[0] + z) as i64, (self.at[1] + y) as i64);
        let (zs, ys) = (self.window(0, z), self.window(1, y));
        let (n, first) = (self.src[2], self.at[2] + x);
        let span = |c: usize, r: usize| ((c + r).min(n - 1) + 1).saturating_sub(c.saturating_sub(r)) as u32;
        if self.reach.is_empty() {
            let rows = (zs.count() * ys.count()) as u32;
            sizes.iter_mut().enumerate().for_each(|(x, s)| *s = rows * span(first + x, self.radius[2]));
            return;
        }
        sizes.fill(0);
        for r in zs.flat_map(|z| ys.clone().filter_map(move |y| self.reach(z as i64 - cz, y as i64 - cy))) {
            sizes.iter_mut().enumerate().for_each(|(x, s)| *s += span(first + x, r));
        }
    }
}

/// Reach along x of each row of the ball `sum (d / r)^2 <= 1`, decided in integers; an axis of radius 0 admits d = 0 only.
/// Rows beyond `clipped` meet no voxel and are left out.
fn ball(radius: [usize; 3], clipped: [usize; 3]) -> Vec<Option<u32>> {
    // radii beyond 2^20 are far beyond any volume; the bound keeps the sixth powers below within 128 bits
    let r2 = radius.map(|r| (r.clamp(1, 1 << 20) as u128).pow(2));
    let whole = r2[0] * r2[1] * r2[2];
    let inside = |z: i64, y: i64, x: i64| {
        let square = |d: i64| (d.unsigned_abs() as u128).pow(2);
        square(z) * r2[1] * r2[2] + square(y) * r2[0] * r2[2] + square(x) * r2[0] * r2[1] <= whole
            && [z, y, x].iter().zip(radius).all(|(d, r)| *d == 0 || r > 0)
    };
    let (rz, ry) = (clipped[0] as i64, clipped[1] as i64);
    let mut reach = Vec::with_capacity(((2 * rz + 1) * (2 * ry + 1)) as usize);
    for z in -rz..=rz {
        for y in -ry..=ry {
            let limit = clipped[2] as i64;
            // the largest x inside, by bisection: inside() can only turn false as x grows
            let (mut low, mut high) = (-1, limit + 1);
            while high - low > 1 {
                let middle = (low + high) / 2;
                if inside(z, y, middle) { low = middle } else { high = middle }
            }
            reach.push(u32::try_from(low).ok());
        }
    }
    reach
}

/// What voxels are compared as. `LEAST` is no larger than any key.
pub(crate) trait Key: Voxel + vector::Vector {
    const LEAST: Self;
    /// As wide as the key, so that a comparison's result needs no widening.
    type Count: Copy + Default + std::ops::AddAssign + From<bool> + Into<u64>;
    /// Most comparisons before `Count` may overflow.
    const MOST: usize;
    /// Openness that the specification fixes for a centre, whatever the window.
    fn fixed(self) -> Option<f64>;
}

macro_rules! keys {
    ($($key:ty, $count:ty, $most:expr, $least:expr, $fixed:expr;)*) => {$(
        impl Key for $key {
            const LEAST: $key = $least;
            type Count = $count;
            const MOST: usize = $most;
            #[inline(always)]
            fn fixed(self) -> Option<f64> { ($fixed)(self) }
        }
    )*};
}
keys! {
    i8, u8, 255, i8::MIN, |_| None;
    i16, u16, 65535, i16::MIN, |_| None;
    i32, u32, 1 << 30, i32::MIN, |_| None;
    f32, u32, 1 << 30, f32::NEG_INFINITY, |k: f32| k.is_infinite().then(|| f64::from(k > 0.0));
    f64, u64, 1 << 30, f64::NEG_INFINITY, |k: f64| k.is_infinite().then(|| f64::from(k > 0.0));
}

/// A voxel's key: larger is denser.
trait ToKey<K>: Voxel {
    fn key(self, flipped: bool) -> K;
}

macro_rules! to_key {
    ($($voxel:ty, $key:ty, $map:expr, $flip:expr;)*) => {$(
        impl ToKey<$key> for $voxel {
            #[inline(always)]
            fn key(self, flipped: bool) -> $key {
                let key: $key = ($map)(self);
                if flipped { ($flip)(key) } else { key }
            }
        }
    )*};
}
to_key! {
    u8, i8, |v: u8| (v ^ 0x80) as i8, |k: i8| !k;
    i8, i8, |v| v, |k: i8| !k;
    u16, i16, |v: u16| (v ^ 0x8000) as i16, |k: i16| !k;
    i16, i16, |v| v, |k: i16| !k;
    u32, i32, |v: u32| (v ^ 0x8000_0000) as i32, |k: i32| !k;
    i32, i32, |v| v, |k: i32| !k;
    f32, f32, |v| v, |k: f32| -k;
    f64, f64, |v| v, |k: f64| -k;
}

/// Whether a voxel is missing.
#[inline(always)]
fn gone<T: Voxel>(v: T, missing: Option<T>) -> bool {
    #[allow(clippy::eq_op)] // only NaN differs from itself
    let nan = v != v;
    nan || missing == Some(v)
}

/// Keys of the whole source, padded along x so that the window about output voxel 0 starts at key 0; true in `valid` (1)
/// where a voxel exists. Returns whether any voxel is missing.
fn fill_keys<T: ToKey<K>, K: Key>(
    src: &View<T>,
    missing: Option<T>,
    flipped: bool,
    plan: &Plan,
    keys: &mut [K],
    valid: &mut [i8],
) -> bool {
    let shift = plan.radius[2] as i64 - plan.at[2] as i64;
    let mut any = false;
    for (i, (keys, valid)) in keys.chunks_exact_mut(plan.width).zip(valid.chunks_exact_mut(plan.width)).enumerate() {
        let row = src.row_at(i / src.shape[1], i % src.shape[1]);
        keys.fill(K::LEAST);
        valid.fill(0);
        // key k holds voxel k - shift
        let (first, last) = (shift.max(0), (row.len() as i64 + shift).min(plan.width as i64));
        for k in first..last {
            let v = row[(k - shift) as usize];
            let lost = gone(v, missing);
            any |= lost;
            if !lost {
                keys[k as usize] = v.key(flipped);
                valid[k as usize] = 1;
            }
        }
    }
    any
}

/// Counts by comparing every voxel of every window.
fn count_all<T: ToKey<K>, K: Key, const L: usize>(
    level: super::simd::Level,
    src: View<T>,
    missing: Option<T>,
    flipped: bool,
    plan: &Plan,
    bytes: &mut [u8],
    mut dst: AnyViewMut,
) {
    let voxels = plan.src[0] * plan.src[1] * plan.width;
    let (keys, bytes) = cut::<K>(bytes, voxels);
    let (valid, _) = cut::<i8>(bytes, voxels);
    let any_missing = fill_keys(&src, missing, flipped, plan, keys, valid);
    let valid: Option<&[i8]> = any_missing.then_some(valid);
    let mut counts = [Counts::default(); compare::ROWS];
    for z in 0..plan.dst[0] {
        for y in (0..plan.dst[1]).step_by(compare::ROWS) {
            let rows = compare::ROWS.min(plan.dst[1] - y);
            for x in (0..plan.dst[2]).step_by(MOST_LANES) {
                compare::count::<K, L>(level, keys, valid, plan, [z, y, x], rows, &mut counts);
                for (j, counts) in counts[..rows].iter().enumerate() {
                    write(&src, missing, flipped, plan, [z, y + j, x], counts, &mut dst);
                }
            }
        }
    }
}

/// Counts by histograms that slide, for types of 8 bits and box windows.
fn slide_all<T: ToKey<i8>>(
    level: super::simd::Level,
    src: View<T>,
    missing: Option<T>,
    flipped: bool,
    plan: &Plan,
    bytes: &mut [u8],
    mut dst: AnyViewMut,
) {
    let voxels = plan.src[0] * plan.src[1] * plan.width;
    let (keys, bytes) = cut::<i8>(bytes, voxels);
    let (valid, bytes) = cut::<i8>(bytes, voxels);
    let (columns, _) = cut::<u16>(bytes, slide::columns(plan));
    let any_missing = fill_keys(&src, missing, flipped, plan, keys, valid);
    let valid: Option<&[i8]> = any_missing.then_some(valid);
    for z in 0..plan.dst[0] {
        for y in 0..plan.dst[1] {
            slide::move_columns(level, keys, valid, plan, [z, y], columns);
            let mut window = slide::Window::default();
            let mut counts = Counts::default();
            for x in (0..plan.dst[2]).step_by(MOST_LANES) {
                if !any_missing {
                    plan.sizes(z, y, x, &mut counts.n);
                }
                slide::count(level, keys, any_missing, plan, [z, y, x], columns, &mut window, &mut counts);
                write(&src, missing, flipped, plan, [z, y, x], &counts, &mut dst);
            }
        }
    }
}

/// Writes the openness of up to [`MOST_LANES`] voxels of an output row from `[z, y, x]` on.
fn write<T: ToKey<K>, K: Key>(
    src: &View<T>,
    missing: Option<T>,
    flipped: bool,
    plan: &Plan,
    [z, y, x]: [usize; 3],
    counts: &Counts,
    dst: &mut AnyViewMut,
) {
    let n = MOST_LANES.min(plan.dst[2] - x);
    let centres = &src.row_at(plan.at[0] + z, plan.at[1] + y)[plan.at[2] + x..][..n];
    let openness = |(i, v): (usize, &T)| {
        if gone(*v, missing) { f64::NAN } else { counts.openness(i, v.key(flipped), plan.ties) }
    };
    let values = centres.iter().enumerate().map(openness);
    match dst {
        AnyViewMut::F32(d) => d.row_at(z, y)[x..x + n].iter_mut().zip(values).for_each(|(d, v)| *d = v as f32),
        AnyViewMut::F64(d) => d.row_at(z, y)[x..x + n].iter_mut().zip(values).for_each(|(d, v)| *d = v),
        other => unreachable!("an openness of type {}", other.dtype()),
    }
}

/// What was counted for a run of output voxels.
#[derive(Clone, Copy)]
struct Counts {
    /// Voxels of the window that exist.
    n: [u32; MOST_LANES],
    /// Those denser than the centre.
    above: [u32; MOST_LANES],
    /// Those at least as dense, pads and missing voxels included where the centre has the least key.
    not_below: [u32; MOST_LANES],
}

impl Default for Counts {
    fn default() -> Self {
        Counts { n: [0; MOST_LANES], above: [0; MOST_LANES], not_below: [0; MOST_LANES] }
    }
}

impl Counts {
    /// Openness of voxel `i`, whose key is `key`. The quotient of two counts below 2^27 is rounded to f64 and then to f32
    /// as if at once: no such quotient lies so close to the middle between two f32.
    #[inline(always)]
    fn openness<K: Key>(&self, i: usize, key: K, ties: Ties) -> f64 {
        if let Some(fixed) = key.fixed() {
            return fixed;
        }
        let n = self.n[i] as f64;
        let at_most = n - self.above[i] as f64;
        match ties {
            Ties::Le => at_most / n,
            Ties::Mid => {
                let not_below = if key == K::LEAST { n } else { self.not_below[i] as f64 };
                (n - not_below + at_most) / (2.0 * n)
            }
        }
    }
}

#[cfg(test)]
mod tests;
