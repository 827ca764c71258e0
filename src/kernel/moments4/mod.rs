//! Openness from the window's first four power moments: the share of voxels not above the centre lies between two bounds that
//! are the best four moments allow (Peters and Klein 2015 use one of them for shadows). Guaranteed per voxel: integers of up to
//! 16 bits have exact moments ([`sums`]), other types are first rounded to codes of 16 bits in a way that keeps order
//! ([`codes`]), and rounding of the bounds themselves is allowed for ([`bounds`]).

mod bounds;
mod codes;
pub mod reference;
mod rows;
mod sums;
#[cfg(test)]
mod tests;

pub use codes::Codes;

use super::Context;
use super::levels::sums::Tile;
use super::simd::Level;
use super::values::missing_as;
use crate::brick::scratch::{cut, padded};
use crate::grid::{AnyView, AnyViewMut, DType, Shape, View, ViewMut, Voxel};
use crate::stage::{Bound, Ties, WindowParams};
use rows::{Count, GROUP, Group, bound_group};
use sums::{Code, Sums, sweep};

/// One requested result, of the type `src.dtype().result()`.
pub struct BoundOut<'a> {
    pub channel: Bound,
    pub dst: AnyViewMut<'a>,
}

/// Planes, rows and columns of a tile at least; windows want tiles no smaller than themselves.
const TILE: Shape = [256, 64, 128];

/// Whether voxels of this type are rounded to [`Codes`].
pub fn needs_codes(dtype: DType) -> bool {
    dtype.size() > 2
}

/// Writes bounds of the openness of the box that starts at voxel `at` of `src`, and the middle between them: `lower` is never
/// above, `upper` never below what [`super::rank::rank`] counts in the window. Where all values are equal, and at infinite
/// voxels, all three are what the count is. A missing voxel gives NaN. `codes` are for types that [`needs_codes`] names.
/// Panics if extents or types disagree, or if a window could hold 2^31 voxels.
pub fn moments4(
    src: AnyView,
    codes: Option<&Codes>,
    params: &WindowParams,
    ties: Ties,
    at: [usize; 3],
    outs: &mut [BoundOut],
    cx: &mut Context,
) {
    let from = src.shape();
    let Some(to) = outs.first().map(|o| o.dst.shape()) else { return };
    for out in outs.iter() {
        assert_eq!((out.dst.shape(), out.dst.dtype()), (to, src.dtype().result()), "shape and type of the outputs");
    }
    assert!((0..3).all(|a| at[a] + to[a] <= from[a]), "the output box sticks out of the source");
    assert!(codes.is_some() || !needs_codes(src.dtype()), "{} needs codes", src.dtype());
    if to.contains(&0) {
        return;
    }
    let bytes = cx.scratch.take(scratch_bytes(src.dtype(), from, to, params));
    let radius: [usize; 3] = std::array::from_fn(|a| params.radius[a].min(from[a] - 1));
    for (lo, first, tile) in Tile::all(from, to, at, radius, tile_shape(radius, to)) {
        let mut job = Job { level: cx.level, tile: &tile, count: Count { ties, flipped: params.flipped() }, lo, outs };
        let missing = params.missing;
        match src {
            AnyView::U8(v) => job.plain(v.part(first, tile.src), missing, bytes),
            AnyView::I8(v) => job.plain(v.part(first, tile.src), missing, bytes),
            AnyView::U16(v) => job.plain(v.part(first, tile.src), missing, bytes),
            AnyView::I16(v) => job.plain(v.part(first, tile.src), missing, bytes),
            AnyView::U32(v) => job.coded(v.part(first, tile.src), codes, missing, bytes),
            AnyView::I32(v) => job.coded(v.part(first, tile.src), codes, missing, bytes),
            AnyView::F32(v) => job.coded(v.part(first, tile.src), codes, missing, bytes),
            AnyView::F64(v) => job.coded(v.part(first, tile.src), codes, missing, bytes),
        }
    }
}

fn tile_shape(radius: [usize; 3], to: Shape) -> Shape {
    std::array::from_fn(|a| TILE[a].max(2 * radius[a]).min(to[a]))
}

/// Bytes of scratch that [`moments4`] takes at most.
pub fn scratch_bytes(dtype: DType, src: Shape, dst: Shape, params: &WindowParams) -> usize {
    if dst.contains(&0) {
        return 0;
    }
    let radius: [usize; 3] = std::array::from_fn(|a| params.radius[a].min(src[a] - 1));
    let dst = tile_shape(radius, dst);
    let src: Shape = std::array::from_fn(|a| (dst[a] + 2 * radius[a]).min(src[a]));
    let tile = Tile { src, dst, at: radius, radius };
    let sums: usize = sums::lengths(&tile, channels(dtype, &tile, true)).into_iter().map(padded::<f64>).sum();
    sums + padded::<f64>(dst[2]) + if needs_codes(dtype) { padded::<u16>(src.iter().product()) } else { 0 }
}

/// Sums per window that windows of a tile need.
fn channels(dtype: DType, tile: &Tile, missing: bool) -> usize {
    let most: usize = (0..3).map(|a| (2 * tile.radius[a] + 1).min(tile.src[a])).product();
    assert!(most < 1 << 31, "windows of {most} voxels");
    let coarse = match dtype.size() {
        1 => 0,
        _ if most < 1 << 15 => 1,
        _ => 2,
    };
    4 + coarse + missing as usize
}

/// One tile.
struct Job<'a, 'o> {
    level: Level,
    tile: &'a Tile,
    count: Count,
    /// First voxel of the tile in the outputs.
    lo: [usize; 3],
    outs: &'a mut [BoundOut<'o>],
}

impl Job<'_, '_> {
    /// Codes are the voxels themselves.
    fn plain<T: Code>(&mut self, src: View<T>, missing: Option<i64>, bytes: &mut [u8]) {
        let missing = missing_as::<T>(missing);
        let gone = |v: T| missing == Some(v);
        self.dispatch(src, missing, src, |_, _| true, gone, bytes);
    }

    /// Codes are made first.
    fn coded<T: Voxel>(&mut self, src: View<T>, codes: Option<&Codes>, missing: Option<i64>, bytes: &mut [u8]) {
        let (Some(codes), shape) = (codes, self.tile.src) else { unreachable!("the caller has looked") };
        let missing = missing_as::<T>(missing);
        let (made, bytes) = cut::<u16>(bytes, shape.iter().product());
        let any = codes::encode_all(self.level, src, missing, codes, ViewMut::dense(made, shape));
        let tile = self.tile;
        let gone = |v: T| v.to_f64().is_nan() || missing == Some(v);
        // Whether the window's voxels of the centre's code have its value. Where all have that code, they are looked at: a constant
        // must be found out. (Of two codes one is the centre's, and no voxel tells which without its code.)
        let mut known: Option<([usize; 3], T)> = None;
        let equal = |[z, y, x]: [usize; 3], v: T| {
            if codes.alone(v.to_f64()) {
                return true;
            }
            let beside = known.is_some_and(|(at, w)| at == [z, y, x.wrapping_sub(1)] && w == v);
            let columns = tile.window(2, x);
            let columns = if beside { tile.window(2, x - 1).end..columns.end } else { columns };
            let mut rows = tile.window(0, z).flat_map(|z| tile.window(1, y).map(move |y| (z, y)));
            let all = rows.all(|(z, y)| src.row_at(z, y)[columns.clone()].iter().all(|w| *w == v || gone(*w)));
            known = all.then_some(([z, y, x], v));
            all
        };
        self.dispatch(View::dense(made, shape), any.then_some(codes::GONE), src, equal, gone, bytes);
    }

    /// With the sums that the type and the window ask for.
    fn dispatch<T: Code, V: Voxel>(
        &mut self,
        codes: View<T>,
        missing: Option<T>,
        src: View<V>,
        equal: impl FnMut([usize; 3], V) -> bool,
        gone: impl Fn(V) -> bool,
        bytes: &mut [u8],
    ) {
        let m = missing.unwrap_or_default();
        match (channels(T::DTYPE, self.tile, missing.is_some()), missing.is_some()) {
            (4, false) => self.run::<T, V, 4, false>(codes, m, src, equal, gone, bytes),
            (5, true) => self.run::<T, V, 5, true>(codes, m, src, equal, gone, bytes),
            (5, false) => self.run::<T, V, 5, false>(codes, m, src, equal, gone, bytes),
            (6, true) => self.run::<T, V, 6, true>(codes, m, src, equal, gone, bytes),
            (6, false) => self.run::<T, V, 6, false>(codes, m, src, equal, gone, bytes),
            (_, _) => self.run::<T, V, 7, true>(codes, m, src, equal, gone, bytes),
        }
    }

    fn run<T: Code, V: Voxel, const C: usize, const M: bool>(
        &mut self,
        codes: View<T>,
        missing: T,
        src: View<V>,
        mut equal: impl FnMut([usize; 3], V) -> bool,
        gone: impl Fn(V) -> bool,
        bytes: &mut [u8],
    ) {
        let (tile, level) = (self.tile, self.level);
        let [plane, run, lines] = sums::lengths(tile, C);
        let (plane, bytes) = cut::<f64>(bytes, plane);
        let (run, bytes) = cut::<f64>(bytes, run);
        let (lines, bytes) = cut::<f64>(bytes, lines);
        let (columns, _) = cut::<f64>(bytes, tile.dst[2]);
        columns.iter_mut().enumerate().for_each(|(x, c)| *c = tile.window(2, x).len() as f64);
        let work = [plane, run, lines].map(bytemuck::cast_slice_mut::<f64, i64>);
        let w = 2 * tile.radius[2] + 1;
        let mut group = Group::NONE;
        sweep::<T, C, M>(level, codes, missing, tile, work, |z, y, lines| {
            let (sz, sy) = (tile.at[0] + z, tile.at[1] + y);
            let (codes, voxels) = (&codes.row_at(sz, sy)[tile.at[2]..], &src.row_at(sz, sy)[tile.at[2]..]);
            let section = (tile.window(0, z).len() * tile.window(1, y).len()) as f64;
            for x in (0..tile.dst[2]).step_by(GROUP) {
                let len = GROUP.min(tile.dst[2] - x);
                let (part, columns) = (&codes[x..x + len], &columns[x..x + len]);
                bound_group(level, Sums::<C, M>, lines, x, w, part, columns, section, self.count, &mut group);
                let some = special(level, &voxels[x..x + len], &group) || M;
                for (i, v) in voxels[x..x + len].iter().enumerate().filter(|_| some) {
                    if gone(*v) {
                        (group.lower[i], group.upper[i]) = (f64::NAN, f64::NAN);
                    } else if v.to_f64().is_infinite() {
                        let open = if (v.to_f64() > 0.0) != self.count.flipped { group.n[i] } else { 0.0 };
                        (group.lower[i], group.upper[i]) = (open, open);
                    } else if group.known[i] != 0.0 && equal([z, y, x + i], *v) {
                        let (lower, upper) = (group.lower[i], group.upper[i]);
                        let exact = if self.count.ties == Ties::Le { upper } else { 0.5 * (lower + upper) };
                        (group.lower[i], group.upper[i]) = (exact, exact);
                    }
                }
                let at = [self.lo[0] + z, self.lo[1] + y, self.lo[2] + x];
                self.outs.iter_mut().for_each(|out| emit(level, out, at, len, &group));
            }
        });
    }
}

crate::multiversion! {
    /// Whether any voxel of a group has no finite value or known counts.
    fn special[V: Voxel](voxels: &[V], group: &Group) -> bool = special_inner;
}

#[inline(always)]
fn special_inner<V: Voxel>(voxels: &[V], group: &Group) -> bool {
    // Less itself, all that is finite is 0.
    let endless = |v: &V| V::DTYPE.is_float() && v.to_f64() - v.to_f64() != 0.0;
    let infinite = voxels.iter().fold(false, |any, v| any | endless(v));
    group.known[..voxels.len()].iter().fold(infinite, |any, k| any | (*k != 0.0))
}

fn emit(level: Level, out: &mut BoundOut, [z, y, x]: [usize; 3], len: usize, group: &Group) {
    match &mut out.dst {
        AnyViewMut::F32(d) => shares_f32(level, out.channel, group, &mut d.row_at(z, y)[x..x + len]),
        AnyViewMut::F64(d) => shares_f64(level, out.channel, group, &mut d.row_at(z, y)[x..x + len]),
        other => unreachable!("bounds of type {}", other.dtype()),
    }
}

crate::multiversion! {
    fn shares_f32[](channel: Bound, group: &Group, out: &mut [f32]) -> () = shares_f32_inner;
}

/// Shares of the windows' voxels, bounds rounded outward.
#[inline(always)]
fn shares_f32_inner(channel: Bound, group: &Group, out: &mut [f32]) {
    for (i, o) in out.iter_mut().enumerate() {
        let (n, lower, upper) = (group.n[i], group.lower[i], group.upper[i]);
        let share = match channel {
            Bound::Openness => (lower + upper) / (2.0 * n),
            Bound::Lower => lower / n,
            Bound::Upper => upper / n,
        };
        let near = share as f32;
        // Shares are 0 or well above the least f32, so the next number is the next pattern of bits.
        let by = match channel {
            Bound::Lower => (f64::from(near) > share) as u32,
            Bound::Upper => ((f64::from(near) < share) as u32).wrapping_neg(),
            Bound::Openness => 0,
        };
        *o = f32::from_bits(near.to_bits().wrapping_sub(by));
    }
}

crate::multiversion! {
    fn shares_f64[](channel: Bound, group: &Group, out: &mut [f64]) -> () = shares_f64_inner;
}

#[inline(always)]
fn shares_f64_inner(channel: Bound, group: &Group, out: &mut [f64]) {
    for (i, o) in out.iter_mut().enumerate() {
        let (n, lower, upper) = (group.n[i], group.lower[i], group.upper[i]);
        let (whole, n) = match channel {
            Bound::Openness => (lower + upper, 2.0 * n),
            Bound::Lower => (lower, n),
            Bound::Upper => (upper, n),
        };
        let near = whole / n;
        let rest = near.mul_add(n, -whole);
        let by = match channel {
            Bound::Lower => (rest > 0.0) as u64,
            Bound::Upper => ((rest < 0.0) as u64).wrapping_neg(),
            Bound::Openness => 0,
        };
        *o = f64::from_bits(near.to_bits().wrapping_sub(by));
    }
}
