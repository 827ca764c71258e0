//! Float volumes: extremes exactly, sums and (mean, M2) merges along a tree that depends on the window alone, so that
//! neither the brick nor a NaN elsewhere in it shows in a single bit.

use super::emit::{Emit, polarity, put_moment, put_openness, repair, spread_of};
use super::float_estimate::{self as est, Centre};
use super::int::{blocked, rows_extremes};
use super::lines::{self, Add, Coding, Elem, Hi, Lines, Lo, Masked, Op, Sources};
use super::merge::{Moments, Sum, Wanted, tree_merge};
use super::plan::{self, Job, Needs, Plain, Tile, cut, padded};
use super::{Context, WindowOut};
use crate::grid::{AnyViewMut, Shape, View};
use crate::kernel::simd::Level;
use crate::stage::{WindowChannel, WindowParams};

/// f32 (sums in f64) or f64 (sums in pairs of f64).
pub trait Float: Elem + Plain + Centre {
    fn row_of<'a>(dst: &'a mut AnyViewMut, at: [usize; 3], len: usize) -> Option<&'a mut [Self]>;
}
impl Float for f32 {
    fn row_of<'a>(dst: &'a mut AnyViewMut, [z, y, x]: [usize; 3], len: usize) -> Option<&'a mut [f32]> {
        if let AnyViewMut::F32(d) = dst { Some(&mut d.row_at(z, y)[x..x + len]) } else { None }
    }
}
impl Float for f64 {
    fn row_of<'a>(dst: &'a mut AnyViewMut, [z, y, x]: [usize; 3], len: usize) -> Option<&'a mut [f64]> {
        if let AnyViewMut::F64(d) = dst { Some(&mut d.row_at(z, y)[x..x + len]) } else { None }
    }
}

/// Columns that go through z together: their lines and first tree level stay in L1.
const COLUMNS: usize = 64;

/// Bytes of scratch.
pub fn bytes<T: Float>(job: &Job) -> usize {
    let k = job.needs.extremes as usize;
    let planes = 2 * padded::<T>(job.batch * job.plane()) + 2 * padded::<T>(job.rows * job.pitch);
    let rows = padded::<T>(2 * job.pitch) + 2 * padded::<T>(job.tile[1]);
    Emit::bytes(job.tile[1]) + k * (planes + rows) + Buffers::<T::Total>::bytes(job)
}

/// Moments on their way through the three axes.
struct Buffers<'a, A> {
    /// One strip of [`COLUMNS`] through z: its lines, tree and results.
    strip: Moments<'a, A>,
    strip_work: Moments<'a, A>,
    strip_out: Moments<'a, A>,
    /// Planes of a batch after z.
    planes: Moments<'a, A>,
    /// One plane through y.
    plane_work: Moments<'a, A>,
    rows: Moments<'a, A>,
    /// One row through x.
    row_work: Moments<'a, A>,
    row: Moments<'a, A>,
}

impl<'a, A: Sum> Buffers<'a, A> {
    fn lens(job: &Job) -> [usize; 8] {
        let [wz, wy, wx] = job.window;
        let tree = |w: usize, step: usize, len: usize| lines::tree_levels(w) * (len + w * step);
        let (z, y) = (job.batch * COLUMNS, job.tile[0] * job.pitch);
        [
            z + wz * COLUMNS,
            tree(wz, COLUMNS, z),
            z,
            job.batch * job.plane(),
            tree(wy, job.pitch, y),
            y,
            tree(wx, 1, job.tile[1]),
            job.tile[1],
        ]
    }

    fn cut(job: &Job, wanted: Wanted, bytes: &mut &'a mut [u8]) -> Self {
        let [strip, strip_work, strip_out, planes, plane_work, rows, row_work, row] =
            Self::lens(job).map(|len| Moments::cut(len, wanted, bytes));
        Buffers { strip, strip_work, strip_out, planes, plane_work, rows, row_work, row }
    }

    fn bytes(job: &Job) -> usize {
        Self::lens(job).into_iter().map(Moments::<A>::bytes).sum()
    }
}

crate::multiversion! {
    fn any_nan[T: Float](row: &[T]) -> bool = any_nan_inner;
}

#[inline(always)]
#[allow(clippy::eq_op)]
fn any_nan_inner<T: Float>(row: &[T]) -> bool {
    row.iter().fold(false, |any, v| any | (*v != *v))
}

/// Runs every tile of a call.
pub fn run<T: Float>(
    src: View<T>,
    params: &WindowParams,
    at: [usize; 3],
    dst: Shape,
    outs: &mut [WindowOut],
    cx: &mut Context,
) where
    Add: Op<T::Total>,
{
    let needs = Needs::of(outs.iter().map(|o| o.channel), true);
    let job = &Job::new(src.shape, dst, at, params, needs, plan::batch_bytes(T::DTYPE, needs));
    assert!(job.counts().0 < 1 << 31, "windows of {} voxels", job.counts().0);
    let level = cx.level;
    let rows = (0..src.shape[0]).flat_map(|z| (0..src.shape[1]).map(move |y| (z, y)));
    let counts = rows.into_iter().any(|(z, y)| any_nan(level, src.row_at(z, y)));
    let wanted = Wanted { variance: needs.variance, counts };
    let bytes = &mut cx.scratch.take(bytes::<T>(job));
    let mut emit = Emit::new(outs, params, level, job.tile[1], bytes);
    let k = needs.extremes as usize;
    let lo = cut::<T>(bytes, k * job.batch * job.plane());
    let hi = cut::<T>(bytes, k * job.batch * job.plane());
    let row_lo = cut::<T>(bytes, k * job.rows * job.pitch);
    let row_hi = cut::<T>(bytes, k * job.rows * job.pitch);
    let work = cut::<T>(bytes, k * 2 * job.pitch);
    let out_lo = cut::<T>(bytes, k * job.tile[1]);
    let out_hi = cut::<T>(bytes, k * job.tile[1]);
    let mut b = Buffers::<T::Total>::cut(job, wanted, bytes);
    let plain = Coding { flip: T::default(), missing: T::default() };
    for tile in Tile::all(job) {
        lo.fill(T::GREATEST);
        hi.fill(T::LEAST);
        b.planes.clear();
        for z0 in (0..dst[0]).step_by(job.batch) {
            if needs.extremes {
                planes_extremes(level, job, &tile, src, z0, lo, hi);
            }
            if needs.mean {
                planes_moments(level, wanted, job, &tile, src, z0, &mut b);
            }
            for z in z0..(z0 + job.batch).min(dst[0]) {
                let plane = (z - z0) * job.plane();
                if needs.mean {
                    let from = b.planes.part(plane..plane + job.plane());
                    tree_merge(level, wanted, &from, job.window[1], job.pitch, &mut b.rows, &mut b.plane_work);
                }
                for j in 0..tile.size[0] {
                    if needs.extremes {
                        if j % job.rows == 0 {
                            let from = [&lo[plane..plane + job.plane()], &hi[plane..plane + job.plane()]];
                            rows_extremes(level, job, from, j, plain, row_lo, row_hi);
                        }
                        let line = (j % job.rows) * job.pitch;
                        let w = job.window[2];
                        lines::tree_extreme(level, Lo, &row_lo[line..line + job.pitch], w, 1, out_lo, work);
                        lines::tree_extreme(level, Hi, &row_hi[line..line + job.pitch], w, 1, out_hi, work);
                    }
                    if needs.mean {
                        let from = b.rows.part(j * job.pitch..(j + 1) * job.pitch);
                        tree_merge(level, wanted, &from, job.window[2], 1, &mut b.row, &mut b.row_work);
                    }
                    let y = tile.y + j;
                    let first = at[2] + tile.x;
                    let v = &src.row_at(at[0] + z, at[1] + y)[first..first + tile.size[1]];
                    let len = v.len();
                    if needs.mean && !wanted.variance && !counts {
                        let section = job.count(0, z) * job.count(1, y);
                        for (i, n) in emit.numerator[..len].iter_mut().enumerate() {
                            *n = (section * job.count(2, tile.x + i)) as f64;
                        }
                    } else if needs.mean {
                        emit.numerator[..len].copy_from_slice(&b.row.n[..len]);
                    }
                    let row = Row { v, lo: out_lo, hi: out_hi, s: b.row.s, m: b.row.m };
                    emit_row(&mut emit, row, [z, y, tile.x], counts);
                }
            }
        }
    }
}

/// Finished windows of one row; the counts are in `Emit::numerator`.
struct Row<'a, T: Float> {
    v: &'a [T],
    lo: &'a [T],
    hi: &'a [T],
    s: &'a [T::Total],
    m: &'a [f64],
}

fn emit_row<T: Float>(emit: &mut Emit, row: Row<T>, at: [usize; 3], masked: bool) {
    let (level, len) = (emit.level, row.v.len());
    let n = &emit.numerator[..len.min(emit.numerator.len())];
    let needs = Needs::of(emit.outs.iter().map(|o| o.channel), true);
    if needs.mean {
        est::mean_row(level, row.s, n, &mut emit.mean[..len]);
    }
    if needs.variance {
        est::variance_row(level, row.m, n, &mut emit.variance[..len]);
    }
    let affine = emit.params.affine;
    for out in emit.outs.iter_mut() {
        let channel = out.channel;
        match channel {
            WindowChannel::Openness(method, ties) => {
                let polarity = polarity(emit.params, ties);
                let (v, lo, hi) = (row.v, &row.lo[..len], &row.hi[..len]);
                let fill = |o: &mut [f32]| match spread_of(method) {
                    None => T::cdf_power(level, v, lo, hi, row.s, n, polarity, o),
                    Some(kind) => est::spread_row(level, kind, v, lo, hi, row.s, row.m, n, polarity, o),
                };
                put_openness(level, &mut out.dst, at, len, emit.open, fill);
            }
            WindowChannel::Min | WindowChannel::Max => {
                let lower = (channel == WindowChannel::Min) == (affine.slope > 0.0);
                let from = if lower { row.lo } else { row.hi };
                let to = T::row_of(&mut out.dst, at, len).expect("types were checked");
                est::extreme_row(level, &from[..len], affine, to);
            }
            _ => put_moment(level, channel, &mut out.dst, at, len, emit.mean, emit.variance, affine),
        }
        if masked {
            repair(&mut out.dst, at, len, |x| row.v[x].to_f64().is_nan());
        }
    }
}

/// Extremes over z of a batch of output planes, straight from `src`. NaN never wins a comparison, so it does not count.
fn planes_extremes<T: Float>(
    level: Level,
    job: &Job,
    tile: &Tile,
    src: View<T>,
    z0: usize,
    lo: &mut [T],
    hi: &mut [T],
) {
    let cols = tile.cols.1 - tile.cols.0;
    let plain = Coding { flip: T::default(), missing: T::default() };
    for j in tile.rows.0..tile.rows.1 {
        let lines = Lines {
            base: (tile.rows.2 + j - tile.rows.0) * src.row + tile.cols.2,
            pitch: src.plane,
            first: (job.at[0] + z0) as isize - job.radius[0] as isize,
            clip: (0, job.src[0] as isize),
        };
        let out = (tile.span(job, j).start, job.plane());
        let (w, from) = (job.window[0], [src.data; 2]);
        blocked(level, job.batch, Masked::<false>, Sources::<false>, from, lines, w, cols, plain, lo, hi, out);
    }
}

/// Moments over z of a batch of output planes, strip by strip.
fn planes_moments<T: Float>(
    level: Level,
    wanted: Wanted,
    job: &Job,
    tile: &Tile,
    src: View<T>,
    z0: usize,
    b: &mut Buffers<T::Total>,
) where
    Add: Op<T::Total>,
{
    let first = (job.at[0] + z0) as isize - job.radius[0] as isize;
    for j in tile.rows.0..tile.rows.1 {
        let y = tile.rows.2 + j - tile.rows.0;
        for x in (tile.cols.0..tile.cols.1).step_by(COLUMNS) {
            let cols = COLUMNS.min(tile.cols.1 - x);
            for k in 0..job.window[0] + job.batch - 1 {
                let z = first + k as isize;
                let mut line = b.strip.part(k * COLUMNS..(k + 1) * COLUMNS);
                if (0..job.src[0] as isize).contains(&z) {
                    let start = tile.cols.2 + x - tile.cols.0;
                    load(level, wanted, &src.row_at(z as usize, y)[start..start + cols], &mut line);
                } else {
                    line.clear();
                }
            }
            tree_merge(level, wanted, &b.strip, job.window[0], COLUMNS, &mut b.strip_out, &mut b.strip_work);
            for k in 0..job.batch {
                let from = b.strip_out.part(k * COLUMNS..k * COLUMNS + cols);
                let start = k * job.plane() + j * job.pitch + x;
                b.planes.part(start..start + cols).copy_from(&from);
            }
        }
    }
}

/// Moments of single voxels; the rest of the line has none.
fn load<T: Float>(level: Level, wanted: Wanted, row: &[T], line: &mut Moments<T::Total>) {
    load_sums(level, row, line.s);
    if wanted.variance || wanted.counts {
        load_counts(level, row, line.n);
    }
    if wanted.variance {
        line.m.fill(0.0);
        line.i.copy_from_slice(line.n);
    }
}

crate::multiversion! {
    fn load_sums[T: Float](row: &[T], to: &mut [T::Total]) -> () = load_sums_inner;
}

#[inline(always)]
#[allow(clippy::eq_op)]
fn load_sums_inner<T: Float>(row: &[T], to: &mut [T::Total]) {
    for (t, v) in to.iter_mut().zip(row) {
        *t = T::Total::of(if *v == *v { v.to_f64() } else { 0.0 });
    }
    to[row.len()..].fill(T::Total::default());
}

crate::multiversion! {
    fn load_counts[T: Float](row: &[T], to: &mut [f64]) -> () = load_counts_inner;
}

#[inline(always)]
#[allow(clippy::eq_op)]
fn load_counts_inner<T: Float>(row: &[T], to: &mut [f64]) {
    for (t, v) in to.iter_mut().zip(row) {
        *t = if *v == *v { 1.0 } else { 0.0 };
    }
    to[row.len()..].fill(0.0);
}
