//! Integer volumes: exact sums of unsigned codes, running along z and y, running or by a tree along x ([`super::slide`]).
//!
//! Widths (n voxels in a window, m in its z-y section, w along z; codes up to T, squares up to T^2): a sum type serves
//! an axis where the largest final value fits, since wrapped intermediate values cancel. [`run`] is instantiated per
//! type by [`dispatch`], which checks the bounds.

use super::along::SLACK;
use super::emit::{Emit, IntRows};
use super::estimate::{self, Acc, Code, RowSum, Width};
use super::extremes::{Groups, blocked, deep, deep_extremes, deep_len, rows_extremes, slots};
use super::lines::{self, Add, Coding, Masked, Op, Pitches, Sources};
use super::plan::{Job, Plain, ROWS, Stage, Tile, bits, cut, padded};
use super::slide::{Rows, Slide};
use crate::grid::View;
use crate::kernel::simd::Level;

/// Sum types of the three axes for S1 and S2 (`go!(T, Z1, Y1, X1, Z2, Y2, X2, ..)`), the narrowest that fit.
macro_rules! with_widths {
    (u8, $job:expr, $go:ident!($($rest:tt)*)) => {{
        let fits = Fits::of::<u8>($job);
        if !fits.narrow {
            $go!(u8, u64, u64, u64, u64, u64, u64, $($rest)*)
        } else if fits.squares {
            $go!(u8, u16, u32, u32, u32, u32, u32, $($rest)*)
        } else {
            $go!(u8, u16, u32, u32, u32, u32, u64, $($rest)*)
        }
    }};
    (u16, $job:expr, $go:ident!($($rest:tt)*)) => {{
        let fits = Fits::of::<u16>($job);
        if fits.window {
            $go!(u16, u32, u32, u32, u64, u64, u64, $($rest)*)
        } else if fits.section {
            $go!(u16, u32, u32, u64, u64, u64, u64, $($rest)*)
        } else {
            $go!(u16, u64, u64, u64, u64, u64, u64, $($rest)*)
        }
    }};
    (u32, $job:expr, $go:ident!($($rest:tt)*)) => {{
        Fits::of::<u32>($job);
        $go!(u32, u64, u64, u64, u128, u128, u128, $($rest)*)
    }};
}

/// Which sums fit. n < 2^31 is asserted, so u64 holds S1 of every type (2^63), S2 of 8 and 16-bit codes (2^63), and
/// u128 the rest.
struct Fits {
    /// S1 of a window, and of its section, in u32.
    window: bool,
    section: bool,
    /// S2 of a window in u32.
    squares: bool,
    /// S1 along z in u16, of the window in u32; S2 of the section in u32.
    narrow: bool,
}

impl Fits {
    fn of<T: Code>(job: &Job) -> Fits {
        let (n, m) = job.counts();
        let w = job.window[0].min(job.src[0]) as u64;
        assert!(n < 1 << 31, "windows of {n} voxels");
        let top = T::TOP as u128;
        let fits = |count: u64, most: u128, bits: u32| (count as u128) * most < 1u128 << bits;
        let (window, section) = (fits(n, top, 32), fits(m, top, 32));
        let narrow = fits(w, top, 16) && window && fits(m, top * top, 32);
        Fits { window, section, squares: fits(n, top * top, 32), narrow }
    }
}

/// What a run needs besides the voxels.
pub struct Setup<'a, T> {
    pub job: &'a Job,
    pub level: Level,
    pub flip: T,
    /// Code of missing voxels.
    pub missing: Option<T>,
}

/// Runs every tile of a call over codes of type `T` (`flip` turns stored bits into codes).
pub trait Dispatch: Code + Plain {
    fn run(src: View<Self>, setup: &Setup<Self>, emit: &mut Emit, scratch: &mut [u8]);
    fn bytes(job: &Job, masked: bool) -> usize;
}

macro_rules! go {
    ($t:ident, $z1:ty, $y1:ty, $x1:ty, $z2:ty, $y2:ty, $x2:ty, $src:ident, $setup:ident, $emit:ident, $scratch:ident) => {
        if $setup.missing.is_some() {
            run::<$t, $z1, $y1, $x1, $z2, $y2, $x2, true>($src, $setup, $emit, $scratch)
        } else {
            run::<$t, $z1, $y1, $x1, $z2, $y2, $x2, false>($src, $setup, $emit, $scratch)
        }
    };
}
macro_rules! bytes {
    ($t:ident, $z1:ty, $y1:ty, $x1:ty, $z2:ty, $y2:ty, $x2:ty, $job:ident, $masked:ident) => {
        buffer_bytes::<$t, $z1, $y1, $x1, $z2, $y2, $x2>($job, $masked)
    };
}
macro_rules! dispatch {
    ($($t:ident)*) => {$(
        impl Dispatch for $t {
            fn run(src: View<$t>, setup: &Setup<$t>, emit: &mut Emit, scratch: &mut [u8]) {
                with_widths!($t, setup.job, go!(src, setup, emit, scratch))
            }
            fn bytes(job: &Job, masked: bool) -> usize {
                with_widths!($t, job, bytes!(job, masked))
            }
        }
    )*};
}
dispatch!(u8 u16 u32);

/// Buffers of one moment: a running plane over z; a running row over y and the rows made from it; those widened for x;
/// the tree of one row; the results of all.
struct Moment<'a, Z, Y, X> {
    plane: &'a mut [Z],
    rows: &'a mut [Y],
    wide: &'a mut [X],
    work: &'a mut [X],
    out: &'a mut [X],
}

/// Elements of a tree along x of a row, or of its running sums.
fn tree_len(job: &Job) -> usize {
    (lines::tree_levels(job.window[2]) * (job.tile[1] + job.window[2])).max(job.pitch + 64)
}

impl<'a, Z: Plain, Y: Plain, X: Plain> Moment<'a, Z, Y, X> {
    /// Elements of each buffer.
    fn lens(job: &Job, wanted: bool) -> [usize; 5] {
        let wide = if size_of::<Y>() == size_of::<X>() { 0 } else { ROWS * job.pitch };
        let all = [job.plane(), (1 + ROWS) * job.pitch, wide, tree_len(job), ROWS * job.out_pitch()];
        all.map(|len| wanted as usize * len)
    }

    fn cut(job: &Job, wanted: bool, bytes: &mut &'a mut [u8]) -> Self {
        let [plane, rows, wide, work, out] = Self::lens(job, wanted);
        Moment {
            plane: cut(bytes, plane),
            rows: cut(bytes, rows),
            wide: cut(bytes, wide),
            work: cut(bytes, work),
            out: cut(bytes, out),
        }
    }

    fn bytes(job: &Job, wanted: bool) -> usize {
        let [plane, rows, wide, work, out] = Self::lens(job, wanted);
        padded::<Z>(plane) + padded::<Y>(rows) + padded::<X>(wide) + padded::<X>(work) + padded::<X>(out)
    }
}

fn buffer_bytes<T: Plain, Z1: Plain, Y1: Plain, X1: Plain, Z2: Plain, Y2: Plain, X2: Plain>(
    job: &Job,
    masked: bool,
) -> usize {
    let k = job.needs.extremes as usize;
    let planes = 2 * padded::<T>(job.batch * job.narrow_plane()) + 2 * padded::<T>(job.rows * job.pitch + SLACK);
    let stage = padded::<T>(Stage::len(job, size_of::<T>()));
    let rows = stage
        + padded::<T>(kept_len(job))
        + padded::<T>(2 * (job.pitch + SLACK))
        + padded::<T>(deep_len(job))
        + 2 * padded::<T>(ROWS * job.out_pitch());
    k * (planes + rows)
        + Moment::<Z1, Y1, X1>::bytes(job, job.needs.mean)
        + Moment::<Z2, Y2, X2>::bytes(job, job.needs.variance)
        + Moment::<u32, u32, u32>::bytes(job, masked)
        + padded::<u32>(job.tile[1])
        + padded::<u32>(ROWS * job.out_pitch())
        + padded::<f64>(ROWS * job.out_pitch())
}

/// What becomes of a code in a running sum.
trait Term<T>: Copy {
    type Out;
    fn of(self, code: T) -> Self::Out;
}
#[derive(Clone, Copy)]
struct Plainly;
#[derive(Clone, Copy)]
struct Squared;
#[derive(Clone, Copy)]
struct Counted;
impl<T: Code> Term<T> for Plainly {
    type Out = T;
    #[inline(always)]
    fn of(self, code: T) -> T {
        code
    }
}
impl<T: Code> Term<T> for Squared {
    type Out = T::Square;
    #[inline(always)]
    fn of(self, code: T) -> T::Square {
        code.square()
    }
}
impl<T: Code> Term<T> for Counted {
    type Out = u8;
    #[inline(always)]
    fn of(self, _: T) -> u8 {
        1
    }
}

crate::multiversion! {
    /// `run[i] += f(new[i]) - f(old[i])`; an empty slice stands for no row, a missing voxel for 0.
    fn slide[T: Code, Z: Acc + From<<F as Term<T>>::Out>, F: Term<T>, const M: bool](
        term: F, masked: Masked<M>, coding: Coding<T>, new: &[T], old: &[T], run: &mut [Z]
    ) -> () = slide_inner;
}

#[inline(always)]
fn slide_inner<T: Code, Z: Acc + From<F::Out>, F: Term<T>, const M: bool>(
    term: F,
    _: Masked<M>,
    coding: Coding<T>,
    new: &[T],
    old: &[T],
    run: &mut [Z],
) {
    let f = |v: T| {
        let c = v.code(coding.flip);
        let z = Z::from(term.of(c));
        if M && c == coding.missing { Z::default() } else { z }
    };
    match (new.is_empty(), old.is_empty()) {
        (false, false) => {
            for ((r, a), b) in run.iter_mut().zip(new).zip(old) {
                *r = r.plus(f(*a)).minus(f(*b));
            }
        }
        (false, true) => {
            for (r, a) in run.iter_mut().zip(new) {
                *r = r.plus(f(*a));
            }
        }
        (true, false) => {
            for (r, b) in run.iter_mut().zip(old) {
                *r = r.minus(f(*b));
            }
        }
        (true, true) => {}
    }
}

crate::multiversion! {
    /// Adds a row to the running one.
    fn add_row[Z: Acc, Y: Acc + From<Z>](new: &[Z], run: &mut [Y]) -> () = add_row_inner;
}

#[inline(always)]
fn add_row_inner<Z: Acc, Y: Acc + From<Z>>(new: &[Z], run: &mut [Y]) {
    for (r, a) in run.iter_mut().zip(new) {
        *r = r.plus(Y::from(*a));
    }
}

crate::multiversion! {
    /// Sums along y for `count` output rows from `first` on: each is the row before it with the last line of its window and
    /// without the line before its window (there is none at 0). Row 0 of `rows` is the one before `first`.
    fn slide_rows[Z: Acc, Y: Acc + From<Z>](
        plane: &[Z], first: usize, w: usize, pitch: usize, columns: usize, count: usize, rows: &mut [Y]
    ) -> () = slide_rows_inner;
}

#[inline(always)]
fn slide_rows_inner<Z: Acc, Y: Acc + From<Z>>(
    plane: &[Z],
    first: usize,
    w: usize,
    pitch: usize,
    columns: usize,
    count: usize,
    rows: &mut [Y],
) {
    for k in 0..count {
        let (before, after) = rows.split_at_mut((k + 1) * pitch);
        let (run, out) = (&before[k * pitch..][..columns], &mut after[..columns]);
        let line = |y: usize| &plane[y * pitch..][..columns];
        let new = line(first + k + w - 1);
        if first + k == 0 {
            for ((o, r), a) in out.iter_mut().zip(run).zip(new) {
                *o = r.plus(Y::from(*a));
            }
        } else {
            for (((o, r), a), b) in out.iter_mut().zip(run).zip(new).zip(line(first + k - 1)) {
                *o = r.plus(Y::from(*a)).minus(Y::from(*b));
            }
        }
    }
}

crate::multiversion! {
    fn widen[Y: Acc, X: Acc + From<Y>](from: &[Y], to: &mut [X]) -> () = widen_inner;
}

#[inline(always)]
fn widen_inner<Y: Acc, X: Acc + From<Y>>(from: &[Y], to: &mut [X]) {
    for (t, f) in to.iter_mut().zip(from) {
        *t = X::from(*f);
    }
}

impl<Z: Acc, Y: Acc + Plain + From<Z>, X: Acc + Plain + From<Y> + Slide<Z, Y>> Moment<'_, Z, Y, X>
where
    Add: Op<X>,
{
    /// Starts the running row with all but the last row of the first window.
    fn begin_rows(&mut self, level: Level, job: &Job) {
        let run = &mut self.rows[..job.pitch];
        run.fill(Y::default());
        for y in 0..job.window[1] - 1 {
            add_row(level, &self.plane[y * job.pitch..][..job.columns()], run);
        }
    }

    /// Sums of the windows of `rows` output rows from `y` of the tile on, left in `out`.
    fn finish_rows(&mut self, level: Level, job: &Job, y: usize, rows: usize) {
        let (w, n, pitch) = (job.window[2], job.tile[1], job.pitch);
        let lines = Rows { plane: self.plane, pitch, first: y, rows, window: job.window[1] };
        let run = &mut self.rows[..pitch];
        if X::windows(level, lines, run, w, n, self.out, job.out_pitch(), self.work) {
            return;
        }
        slide_rows(level, self.plane, y, job.window[1], pitch, job.columns(), rows, self.rows);
        let made = &self.rows[pitch..][..rows * pitch];
        let from = if self.wide.is_empty() {
            bits::<X, Y>(made)
        } else {
            widen(level, made, self.wide);
            &*self.wide
        };
        for k in 0..rows {
            let to = &mut self.out[k * job.out_pitch()..][..n];
            lines::tree_sum(level, &from[k * pitch..][..pitch], w, 1, to, self.work);
        }
        self.rows.copy_within(rows * pitch..(rows + 1) * pitch, 0);
    }
}

/// Voxels in the windows of a block of rows, and their reciprocals where they are wanted.
struct Counts<'a> {
    /// Voxels that exist along x for each column.
    columns: &'a mut [u32],
    n: &'a mut [u32],
    inverse: &'a mut [f64],
    /// The section of every row of the block that `n` was made for.
    made: [usize; ROWS],
}

impl Counts<'_> {
    fn begin_tile(&mut self, job: &Job, tile: &Tile) {
        for (i, c) in self.columns[..tile.size[1]].iter_mut().enumerate() {
            *c = job.count(2, tile.x + i) as u32;
        }
        self.made = [0; ROWS];
    }

    /// For rows whose windows have a section of `section(k)` voxels; returns the elements from row to row, 0 where all rows
    /// have the same counts, which then stay in the first-level cache.
    fn make(&mut self, level: Level, job: &Job, rows: usize, divides: bool, section: impl Fn(usize) -> usize) -> usize {
        let alike = (1..rows).all(|k| section(k) == section(0));
        for k in 0..if alike { 1 } else { rows } {
            let section = section(k);
            if section == self.made[k] {
                continue;
            }
            self.made[k] = section;
            let part = k * job.out_pitch()..k * job.out_pitch() + job.tile[1];
            self.n[part.clone()].iter_mut().zip(&*self.columns).for_each(|(n, c)| *n = section as u32 * c);
            if divides {
                estimate::inverse_row(level, &self.n[part.clone()], &mut self.inverse[part]);
            }
        }
        if alike { 0 } else { job.out_pitch() }
    }
}

#[allow(clippy::too_many_arguments)]
fn run<T, Z1, Y1, X1, Z2, Y2, X2, const M: bool>(
    src: View<T>,
    setup: &Setup<T>,
    emit: &mut Emit,
    mut scratch: &mut [u8],
) where
    T: Code + Plain,
    Z1: Acc + Plain + From<T>,
    Y1: Acc + Plain + From<Z1>,
    X1: RowSum + Plain + From<Y1> + Slide<Z1, Y1>,
    Z2: Acc + Plain + From<T::Square>,
    Y2: Acc + Plain + From<Z2>,
    X2: Acc + Plain + From<Y2> + Slide<Z2, Y2>,
    Add: Op<X1> + Op<X2>,
{
    let Setup { job, level, flip, missing } = *setup;
    let needs = job.needs;
    let bytes = &mut scratch;
    let k = needs.extremes as usize;
    let lo = cut::<T>(bytes, k * job.batch * job.narrow_plane());
    let hi = cut::<T>(bytes, k * job.batch * job.narrow_plane());
    let row_lo = cut::<T>(bytes, k * (job.rows * job.pitch + SLACK));
    let row_hi = cut::<T>(bytes, k * (job.rows * job.pitch + SLACK));
    let work = cut::<T>(bytes, k * 2 * (job.pitch + SLACK));
    let deep = cut::<T>(bytes, k * deep_len(job));
    let kept = cut::<T>(bytes, k * kept_len(job));
    let out_lo = cut::<T>(bytes, k * ROWS * job.out_pitch());
    let out_hi = cut::<T>(bytes, k * ROWS * job.out_pitch());
    let stage = cut::<T>(bytes, k * Stage::len(job, size_of::<T>()));
    let mut s1 = Moment::<Z1, Y1, X1>::cut(job, needs.mean, bytes);
    let mut s2 = Moment::<Z2, Y2, X2>::cut(job, needs.variance, bytes);
    let mut count = Moment::<u32, u32, u32>::cut(job, M, bytes);
    let columns = cut(bytes, job.tile[1]);
    let [n, inverse] = [(); 2].map(|()| ROWS * job.out_pitch());
    let mut counts = Counts { columns, n: cut(bytes, n), inverse: cut(bytes, inverse), made: [0; ROWS] };
    let coding = Coding { flip, missing: missing.unwrap_or_default() };
    let (most, divides) = (job.counts().0, emit.divides());
    let width = Width::of(most, T::TOP);
    for tile in Tile::all(job) {
        let (y, x) = (tile.y, tile.x);
        counts.begin_tile(job, &tile);
        if tile.columns() < T::CHUNK.as_ref().len() {
            lo.fill(T::GREATEST);
            hi.fill(T::LEAST);
        }
        row_lo.fill(T::GREATEST);
        row_hi.fill(T::LEAST);
        s1.plane.fill(Z1::default());
        s2.plane.fill(Z2::default());
        count.plane.fill(0);
        let slide_in = |new: Option<usize>,
                        old: Option<usize>,
                        s1: &mut Moment<Z1, Y1, X1>,
                        s2: &mut Moment<Z2, Y2, X2>,
                        count: &mut Moment<u32, u32, u32>| {
            for j in tile.rows.0..tile.rows.1 {
                let part = |z: usize| {
                    let (first, len) = (tile.cols.2, tile.cols.1 - tile.cols.0);
                    &src.row_at(z, tile.rows.2 + j - tile.rows.0)[first..first + len]
                };
                let (new, old) = (new.map_or(&[][..], part), old.map_or(&[][..], part));
                let span = tile.span(job, j);
                if needs.mean {
                    slide(level, Plainly, Masked::<M>, coding, new, old, &mut s1.plane[span.clone()]);
                }
                if needs.variance {
                    slide(level, Squared, Masked::<M>, coding, new, old, &mut s2.plane[span.clone()]);
                }
                if M {
                    slide(level, Counted, Masked::<M>, coding, new, old, &mut count.plane[span]);
                }
            }
        };
        // The window of the plane before the first output; each output then adds one plane and drops one.
        let at = job.at.map(|v| v as usize); // no output is skipped
        let (reach, first) = (job.radius[0], at[0]);
        for z in (first as isize - 1 - reach as isize).max(0) as usize..(first + reach).min(job.src[0]) {
            slide_in(Some(z), None, &mut s1, &mut s2, &mut count);
        }
        for z0 in (0..job.dst[0]).step_by(job.batch) {
            if needs.extremes {
                planes_extremes::<T, M>(level, job, &tile, src, z0, coding, lo, hi, kept, stage);
            }
            for z in z0..(z0 + job.batch).min(job.dst[0]) {
                let new = Some(first + z + reach).filter(|z| *z < job.src[0]);
                let old = (first + z).checked_sub(reach + 1);
                slide_in(new, old, &mut s1, &mut s2, &mut count);
                let section = job.count(0, z);
                if needs.mean {
                    s1.begin_rows(level, job);
                }
                if needs.variance {
                    s2.begin_rows(level, job);
                }
                if M {
                    count.begin_rows(level, job);
                }
                let plane = (z - z0) * job.narrow_plane()..(z - z0 + 1) * job.narrow_plane();
                for j in (0..tile.size[0]).step_by(ROWS) {
                    let rows = ROWS.min(tile.size[0] - j);
                    if needs.extremes {
                        if j % job.rows == 0 {
                            let from = [&lo[plane.clone()], &hi[plane.clone()]];
                            let lines = tile.lines(job, j);
                            rows_extremes(level, job, &tile, from, lines, row_lo, row_hi, deep);
                        }
                        let line = (j % job.rows) * job.pitch;
                        let (w, n) = (job.window[2], job.tile[1]);
                        let pitches = Pitches { from: job.pitch, to: job.out_pitch(), rows };
                        let from = [&row_lo[line..], &row_hi[line..]];
                        lines::row_extremes(level, from[0], from[1], w, n, out_lo, out_hi, pitches, work);
                    }
                    if needs.mean {
                        s1.finish_rows(level, job, j, rows);
                    }
                    if needs.variance {
                        s2.finish_rows(level, job, j, rows);
                    }
                    let n_pitch = if M {
                        count.finish_rows(level, job, j, rows);
                        if divides {
                            estimate::inverse_row(level, count.out, counts.inverse);
                        }
                        job.out_pitch()
                    } else {
                        counts.make(level, job, rows, divides, |k| section * job.count(1, y + j + k))
                    };
                    let [cz, cy] = [at[0] + z, at[1] + y + j];
                    let first = cz * src.plane + cy * src.row + at[2] + x;
                    let windows = IntRows {
                        v: &src.data[first..first + (rows - 1) * src.row + tile.size[1]],
                        v_pitch: src.row,
                        lo: out_lo,
                        hi: out_hi,
                        s1: s1.out,
                        s2: s2.out,
                        n: if M { count.out } else { counts.n },
                        inverse: counts.inverse,
                        n_pitch,
                        pitch: job.out_pitch(),
                        rows,
                        len: tile.size[1],
                        most,
                        width,
                    };
                    emit.int_rows(setup, windows, [z, y + j, x]);
                }
            }
        }
    }
}

/// Elements of the extremes of groups of planes that a tile keeps from batch to batch.
fn kept_len(job: &Job) -> usize {
    2 * slots(job.window[0], job.batch / 8) * job.narrow_plane()
}

/// Extremes over z of a batch of output planes, straight from `src`. Long windows are made of groups of planes, which stay in
/// `kept`, so that a batch reads no plane but those at the ends of its windows. 2-core Zen 4 VM, AVX-512, 2026-11-27, min and
/// max of u16, 256 x 256 planes, r=64, ns per voxel with groups made anew: 3.7 in batches of 32 planes, 3.4 of 64; kept: 2.96 of
/// 32, 3.15 of 16, 3.5 of 8; with lines copied side by side first 3.8 of 64.
#[allow(clippy::too_many_arguments)]
fn planes_extremes<T: Code + Plain, const M: bool>(
    level: Level,
    job: &Job,
    tile: &Tile,
    src: View<T>,
    z0: usize,
    coding: Coding<T>,
    lo: &mut [T],
    hi: &mut [T],
    kept: &mut [T],
    buffer: &mut [T],
) {
    let (cols, w, plane) = (tile.columns(), job.window[0], job.narrow_plane());
    let (masked, sources) = (Masked::<M>, Sources::<false>);
    let stage = Stage::new(job, size_of::<T>(), z0);
    for j in tile.rows.0..tile.rows.1 {
        let at = (j - tile.rows.0) * job.narrow;
        if deep(w, cols, job.block, T::CHUNK.as_ref().len()) {
            let lines = tile.column(job, src, j);
            let blocks = (z0 / 8, (z0 + job.batch) / 8);
            // Those of the batch before are there.
            let from = if z0 == 0 { 1 } else { z0 / 8 + (w - 8) / 8 };
            let groups = Groups { at, stride: plane, slots: slots(w, job.batch / 8), from };
            let (src, out) = ([src.data; 2], (at, plane));
            deep_extremes(level, masked, sources, src, lines, w, cols, coding, blocks, lo, hi, out, groups, kept);
            continue;
        }
        let (from, lines) = stage.fill(tile, src, j, buffer);
        let blocks = (job.batch, job.block);
        let out = (at, plane);
        blocked(level, blocks, masked, sources, [from; 2], lines, w, cols, coding, lo, hi, out, kept);
    }
}
