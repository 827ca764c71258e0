//! Float volumes: extremes exactly, sums and (mean, M2) merges along a tree that depends on the window alone, so that
//! neither the brick nor a NaN elsewhere in it shows in a single bit.

use super::along::SLACK;
use super::columns::{self, BLOCK, Columns};
use super::emit::{Emit, Estimator, estimator, polarity, put_moment, put_openness, repair};
use super::float_estimate::{self as est, Centre};
use super::int::{blocked, deep_len, rows_extremes};
use super::lines::{self, Add, Coding, Elem, Lines, Masked, Op, Sources};
use super::merge::{Moments, Sum, Wanted, gather, grow, tree_merge};
use super::plan::{self, Job, Needs, Plain, Stage, Tile, cut, padded};
use super::{Context, WindowOut};
use crate::grid::{AnyViewMut, Shape, View};
use crate::kernel::simd::Level;
use crate::stage::{WindowChannel, WindowParams};

/// f32 (sums in f64) or f64 (sums in pairs of f64).
pub trait Float: Elem + Plain + Centre + Columns<Self::Total> {
    /// A strip of NaN, a line that does not exist.
    const NOTHING: &'static [Self];
    fn row_of<'a>(dst: &'a mut AnyViewMut, at: [usize; 3], len: usize) -> Option<&'a mut [Self]>;
}
impl Float for f32 {
    const NOTHING: &'static [f32] = &[f32::NAN; STRIP];
    fn row_of<'a>(dst: &'a mut AnyViewMut, [z, y, x]: [usize; 3], len: usize) -> Option<&'a mut [f32]> {
        if let AnyViewMut::F32(d) = dst { Some(&mut d.row_at(z, y)[x..x + len]) } else { None }
    }
}
impl Float for f64 {
    const NOTHING: &'static [f64] = &[f64::NAN; STRIP];
    fn row_of<'a>(dst: &'a mut AnyViewMut, [z, y, x]: [usize; 3], len: usize) -> Option<&'a mut [f64]> {
        if let AnyViewMut::F64(d) = dst { Some(&mut d.row_at(z, y)[x..x + len]) } else { None }
    }
}

/// Columns that go through z together: wide enough for the prefetcher, narrow enough for the tree to stay in L2.
/// 2-core Zen 4 VM, AVX-512, 2026-11-23: mean of f32, r=10, 7.6 ns/voxel with 256 columns and column counts
/// made once per tile, 10.9 with 64 and counts per row (the two were not measured apart; 64 for the rest is by size).
fn columns(job: &Job) -> usize {
    if job.needs.variance || job.window[0] > 32 { 64 } else { STRIP }
}

/// Widest strip.
const STRIP: usize = 256;

/// Bytes of scratch.
pub fn bytes<T: Float>(job: &Job) -> usize {
    let k = job.needs.extremes as usize;
    let planes = 2 * padded::<T>(job.batch * job.plane()) + 2 * padded::<T>(job.rows * job.pitch + SLACK);
    let rows =
        padded::<T>(2 * job.pitch) + padded::<T>(deep_len(job)) + 2 * padded::<T>(job.tile[1].next_multiple_of(64));
    Emit::bytes(job.tile[1])
        + padded::<T>(Stage::len(job, size_of::<T>()))
        + padded::<f64>(job.tile[1])
        + k * (planes + rows)
        + Buffers::<T::Total>::bytes(job)
}

/// Moments on their way through the three axes.
struct Buffers<'a, A> {
    /// The tree of one strip of [`columns`] through z.
    strip_work: Moments<'a, A>,
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
    fn lens(job: &Job) -> [usize; 6] {
        let [wz, wy, wx] = job.window;
        let tree = |w: usize, step: usize, len: usize| lines::tree_levels(w) * (len + w * step);
        let width = columns(job);
        let (z, y) = (job.batch * width, job.tile[0] * job.pitch);
        [tree(wz, width, z), job.batch * job.plane(), tree(wy, job.pitch, y), y, tree(wx, 1, job.tile[1]), job.tile[1]]
    }

    fn cut(job: &Job, wanted: Wanted, bytes: &mut &'a mut [u8]) -> Self {
        let [strip_work, planes, plane_work, rows, row_work, row] =
            Self::lens(job).map(|len| Moments::cut(len, wanted, bytes));
        Buffers { strip_work, planes, plane_work, rows, row_work, row }
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
    let row_lo = cut::<T>(bytes, k * (job.rows * job.pitch + SLACK));
    let row_hi = cut::<T>(bytes, k * (job.rows * job.pitch + SLACK));
    let work = cut::<T>(bytes, k * 2 * job.pitch);
    let deep = cut::<T>(bytes, k * deep_len(job));
    let out_lo = cut::<T>(bytes, k * job.tile[1].next_multiple_of(64));
    let out_hi = cut::<T>(bytes, k * job.tile[1].next_multiple_of(64));
    let stage = cut::<T>(bytes, Stage::len(job, size_of::<T>()));
    let mut b = Buffers::<T::Total>::cut(job, wanted, bytes);
    let columns = cut::<f64>(bytes, job.tile[1]);
    let plain = Coding { flip: T::default(), missing: T::default() };
    let corners = (0..dst[2]).step_by(job.tile[1]).flat_map(|x| (0..dst[0]).step_by(job.batch).map(move |z| (x, z)));
    for (x, z0) in corners {
        for y in (0..dst[1]).step_by(job.tile[0]) {
            let mut tile = Tile::new(job, y, x);
            if y == 0 && z0 == 0 {
                for (i, c) in columns[..tile.size[1]].iter_mut().enumerate() {
                    *c = job.count(2, x + i) as f64;
                }
                lo.fill(T::GREATEST);
                hi.fill(T::LEAST);
                b.planes.clear();
            }
            // Rows that do not exist are neutral; those that the tile above has made are kept.
            let covered = (tile.rows.0, tile.rows.1);
            let kept = if y == 0 { 0 } else { 2 * job.radius[1] };
            for plane in (0..job.batch).map(|k| k * job.plane()) {
                let from = plane + job.tile[0] * job.pitch..plane + (job.tile[0] + kept) * job.pitch;
                if kept > 0 {
                    if needs.extremes {
                        lo.copy_within(from.clone(), plane);
                        hi.copy_within(from.clone(), plane);
                    }
                    if needs.mean {
                        b.planes.copy_within(from, plane);
                    }
                }
                for rows in [kept..covered.0, covered.1..job.height] {
                    if rows.start >= rows.end {
                        continue;
                    }
                    let gap = plane + rows.start * job.pitch..plane + rows.end * job.pitch;
                    if needs.extremes {
                        lo[gap.clone()].fill(T::GREATEST);
                        hi[gap.clone()].fill(T::LEAST);
                    }
                    if needs.mean {
                        b.planes.part(gap).clear();
                    }
                }
            }
            // Rows above have been made already, whether `src` covers them or not.
            let skipped = kept.clamp(covered.0, covered.1) - covered.0;
            tile.rows = (covered.0 + skipped, covered.1, tile.rows.2 + skipped);
            let fast = needs.mean && wanted == Wanted::SUMS && T::COLUMNS && columns::fits(job.window[0]);
            if needs.extremes || fast {
                let sums = if fast { &mut *b.planes.s } else { &mut [] };
                planes_rows(level, job, &tile, src, z0, lo, hi, sums, deep, stage);
            }
            if needs.mean && !fast {
                planes_moments(level, wanted, job, &tile, src, z0, &mut b);
            }
            for z in z0..(z0 + job.batch).min(dst[0]) {
                let plane = (z - z0) * job.plane();
                if needs.mean {
                    let from = b.planes.part(plane..plane + job.plane());
                    if !plane_sums(level, wanted, job, &tile, from.s, b.rows.s) {
                        tree_merge(level, wanted, &from, job.window[1], job.pitch, &mut b.rows, &mut b.plane_work);
                    }
                }
                for j in 0..tile.size[0] {
                    if needs.extremes {
                        if j % job.rows == 0 {
                            let from = [&lo[plane..plane + job.plane()], &hi[plane..plane + job.plane()]];
                            rows_extremes(level, job, from, j, plain, row_lo, row_hi, deep);
                        }
                        let line = (j % job.rows) * job.pitch;
                        let w = job.window[2];
                        let n = job.tile[1];
                        lines::row_extremes(level, &row_lo[line..], &row_hi[line..], w, n, out_lo, out_hi, work);
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
                        for (n, c) in emit.numerator[..len].iter_mut().zip(&*columns) {
                            *n = section as f64 * c;
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
    if emit.outs.iter().any(|o| matches!(o.channel, WindowChannel::Mean | WindowChannel::Moment2)) {
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
                let fill = |o: &mut [f32]| match estimator(method) {
                    Estimator::Power => T::cdf_power(level, v, lo, hi, row.s, n, polarity, o),
                    Estimator::Beta => est::beta_row(level, v, lo, hi, row.s, row.m, n, polarity, o),
                    Estimator::Spread(kind) => est::spread_row(level, kind, v, lo, hi, row.s, row.m, n, polarity, o),
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

/// Extremes over z of a batch of output planes, and sums where `sums` holds planes for them. NaN never wins a
/// comparison, so it does not count.
#[allow(clippy::too_many_arguments)]
fn planes_rows<T: Float>(
    level: Level,
    job: &Job,
    tile: &Tile,
    src: View<T>,
    z0: usize,
    lo: &mut [T],
    hi: &mut [T],
    sums: &mut [T::Total],
    work: &mut [T],
    buffer: &mut [T],
) {
    let cols = tile.cols.1 - tile.cols.0;
    let plain = Coding { flip: T::default(), missing: T::default() };
    let stage = Stage::new(job, size_of::<T>(), z0);
    let w = job.window[0];
    for j in tile.rows.0..tile.rows.1 {
        let (from, lines) = stage.fill(tile, src, j, buffer);
        let out = (tile.span(job, j).start, job.plane());
        if !lo.is_empty() {
            let (masked, sources, blocks) = (Masked::<false>, Sources::<false>, (job.batch, job.block));
            blocked(level, blocks, masked, sources, [from; 2], lines, w, cols, plain, lo, hi, out, work);
        }
        for k in (0..job.batch).step_by(BLOCK) {
            if !sums.is_empty() {
                let lines = Lines { first: lines.first + k as isize, ..lines };
                let at = (k * job.plane() + out.0, job.plane());
                T::sums(level, from, lines, w, BLOCK.min(job.batch - k), cols, sums, at);
            }
        }
    }
}

/// Sums over y of a plane, where [`Columns`] has them; else returns false.
fn plane_sums<A: Sum + Columns<A>>(
    level: Level,
    wanted: Wanted,
    job: &Job,
    tile: &Tile,
    plane: &[A],
    rows: &mut [A],
) -> bool {
    let (w, pitch) = (job.window[1], job.pitch);
    let mut done = wanted == Wanted::SUMS && columns::fits(w);
    for j in (0..tile.size[0]).step_by(BLOCK) {
        if done {
            let lines = Lines { base: 0, pitch, first: j as isize, clip: (0, job.height as isize) };
            let cols = job.tile[1] + 2 * job.radius[2];
            done = A::sums(level, plane, lines, w, BLOCK.min(tile.size[0] - j), cols, rows, (j * pitch, pitch));
        }
    }
    done
}

/// Moments over z of a batch of output planes, strip by strip, straight from `src`.
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
    let width = columns(job);
    let (w, len) = (job.window[0], job.batch * width);
    let (levels, pitch) = (lines::tree_levels(w), len + w * width);
    let first = (job.at[0] + z0) as isize - job.radius[0] as isize;
    for j in tile.rows.0..tile.rows.1 {
        for x in (tile.cols.0..tile.cols.1).step_by(width) {
            let cols = width.min(tile.cols.1 - x);
            let corner = (tile.rows.2 + j - tile.rows.0) * src.row + tile.cols.2 + x - tile.cols.0;
            // Lines of voxels that exist: the others would add nothing.
            let part = |from: usize, to: usize| {
                let at = |i: usize| (first + i as isize).clamp(0, job.src[0] as isize) as usize;
                Raw { src: src.data, base: corner, pitch: src.plane, lines: (at(from), at(to)) }
            };
            if levels > 0 {
                for i in 0..job.batch + w - 4 {
                    let out = &mut b.strip_work.part(i * width..i * width + cols);
                    let line = |k: usize| first + (i + k) as isize;
                    let rows = std::array::from_fn(|k| match line(k) {
                        z if z < 0 || z >= job.src[0] as isize => T::NOTHING,
                        z => &src.data[corner + z as usize * src.plane..],
                    });
                    four_raw(level, wanted, rows, out);
                }
                grow(level, wanted, 2, None, w, width, len, &mut b.strip_work);
            }
            for k in 0..job.batch {
                let start = k * job.plane() + j * job.pitch + x;
                let out = &mut b.planes.part(start..start + cols);
                let done = gather(level, wanted, None, w, width, pitch, k * width, out, &b.strip_work);
                join_raw(level, wanted, part(k + done, k + w), out, done > 0);
            }
        }
    }
}

/// Moments of four lines of stored voxels, the first level of a tree; NaN stands for a line that does not exist.
fn four_raw<T: Float>(level: Level, wanted: Wanted, rows: [&[T]; 4], out: &mut Moments<T::Total>) {
    if wanted.variance {
        return four_merges(level, rows, out.s, out.m, out.n, out.i);
    }
    four_sums(level, rows, out.s);
    if wanted.counts {
        for (k, row) in rows.into_iter().enumerate() {
            raw_counts(level, (row, 0, 1), out.n, k > 0);
        }
    }
}

crate::multiversion! {
    fn four_sums[T: Float](rows: [&[T]; 4], out: &mut [T::Total]) -> () = four_sums_inner;
}

#[inline(always)]
fn four_sums_inner<T: Float>(rows: [&[T]; 4], out: &mut [T::Total]) {
    let len = out.len();
    let [a, b, c, d] = rows.map(|r| &r[..len]);
    for i in 0..len {
        let [a, b, c, d] = [a[i], b[i], c[i], d[i]].map(|v| weigh(v).0);
        out[i] = a.plus(b).plus(c.plus(d));
    }
}

crate::multiversion! {
    fn four_merges[T: Float](
        rows: [&[T]; 4], os: &mut [T::Total], om: &mut [f64], on: &mut [f64], oi: &mut [f64]
    ) -> () = four_merges_inner;
}

#[inline(always)]
fn four_merges_inner<T: Float>(rows: [&[T]; 4], os: &mut [T::Total], om: &mut [f64], on: &mut [f64], oi: &mut [f64]) {
    let len = os.len();
    let (om, on, oi) = (&mut om[..len], &mut on[..len], &mut oi[..len]);
    let [a, b, c, d] = rows.map(|r| &r[..len]);
    for x in 0..len {
        let terms = [a[x], b[x], c[x], d[x]].map(weigh);
        let sum = terms[0].0.plus(terms[1].0).plus(terms[2].0.plus(terms[3].0));
        let total = terms[0].1 + terms[1].1 + terms[2].1 + terms[3].1;
        let i = 1.0 / total;
        let i = if total > 0.0 { i } else { 0.0 };
        let mean = sum.mean(total, i);
        let mut square = 0.0;
        for (s, n) in terms {
            let d = s.deviation(n, mean);
            square = (d * d).mul_add(n, square);
        }
        (os[x], om[x], on[x], oi[x]) = (sum, square, total, i);
    }
}

/// Lines of stored voxels, `lines` half-open.
#[derive(Clone, Copy)]
struct Raw<'a, T> {
    src: &'a [T],
    base: usize,
    pitch: usize,
    lines: (usize, usize),
}

/// Moments of up to 8 lines of stored voxels, the first level of a tree (or its last digit, `onto` the others).
fn join_raw<T: Float>(level: Level, wanted: Wanted, raw: Raw<T>, out: &mut Moments<T::Total>, onto: bool)
where
    Add: Op<T::Total>,
{
    let Raw { src, base, pitch, lines } = raw;
    if lines.0 >= lines.1 {
        if !onto {
            out.clear();
        }
        return;
    }
    let rows = (&src[base + lines.0 * pitch..], pitch, lines.1 - lines.0);
    match (wanted.variance, wanted.counts) {
        (true, _) => raw_merges(level, rows, out.s, out.m, out.n, out.i, onto),
        (false, true) => {
            raw_sums(level, Masked::<true>, rows, out.s, onto);
            raw_counts(level, rows, out.n, onto);
        }
        (false, false) => raw_sums(level, Masked::<false>, rows, out.s, onto),
    }
}

crate::multiversion! {
    fn raw_sums[T: Float, const M: bool](
        masked: Masked<M>, rows: (&[T], usize, usize), out: &mut [T::Total], onto: bool
    ) -> () = raw_sums_inner;
}

/// Value and count of a voxel.
#[inline(always)]
#[allow(clippy::eq_op)]
fn weigh<T: Float>(v: T) -> (T::Total, f64) {
    if v == v { (T::Total::of(v.to_f64()), 1.0) } else { (T::Total::default(), 0.0) }
}

#[inline(always)]
fn raw_sums_inner<T: Float, const M: bool>(
    _: Masked<M>,
    (src, pitch, count): (&[T], usize, usize),
    out: &mut [T::Total],
    onto: bool,
) {
    let value = |v: T| if M { weigh(v).0 } else { T::Total::of(v.to_f64()) };
    let len = out.len();
    for k in 0..count {
        let row = &src[k * pitch..k * pitch + len];
        if k == 0 && !onto {
            for (o, v) in out.iter_mut().zip(row) {
                *o = value(*v);
            }
        } else {
            for (o, v) in out.iter_mut().zip(row) {
                *o = o.plus(value(*v));
            }
        }
    }
}

crate::multiversion! {
    fn raw_counts[T: Float](rows: (&[T], usize, usize), out: &mut [f64], onto: bool) -> () = raw_counts_inner;
}

#[inline(always)]
fn raw_counts_inner<T: Float>((src, pitch, count): (&[T], usize, usize), out: &mut [f64], onto: bool) {
    if !onto {
        out.fill(0.0);
    }
    for k in 0..count {
        for (o, v) in out.iter_mut().zip(&src[k * pitch..]) {
            *o += weigh(*v).1;
        }
    }
}

crate::multiversion! {
    fn raw_merges[T: Float](
        rows: (&[T], usize, usize), os: &mut [T::Total], om: &mut [f64], on: &mut [f64], oi: &mut [f64], onto: bool
    ) -> () = raw_merges_inner;
}

/// [`super::merge`] with single voxels (M2 = 0) as terms, in the same order of operations.
#[inline(always)]
fn raw_merges_inner<T: Float>(
    rows: (&[T], usize, usize),
    os: &mut [T::Total],
    om: &mut [f64],
    on: &mut [f64],
    oi: &mut [f64],
    onto: bool,
) {
    macro_rules! arms {
        ($($k:literal)*) => {
            match (rows.2, onto) {
                $(($k, false) => raw_merges_k::<T, $k, false>(rows.0, rows.1, os, om, on, oi),
                  ($k, true) => raw_merges_k::<T, $k, true>(rows.0, rows.1, os, om, on, oi),)*
                _ => unreachable!("one to eight lines"),
            }
        };
    }
    arms!(1 2 3 4 5 6 7 8)
}

#[inline(always)]
fn raw_merges_k<T: Float, const K: usize, const ONTO: bool>(
    src: &[T],
    pitch: usize,
    os: &mut [T::Total],
    om: &mut [f64],
    on: &mut [f64],
    oi: &mut [f64],
) {
    let len = os.len();
    let (om, on, oi) = (&mut om[..len], &mut on[..len], &mut oi[..len]);
    assert!((K - 1) * pitch + len <= src.len());
    for x in 0..len {
        let (mut sum, mut total, mut square) = (T::Total::default(), 0.0, 0.0);
        if ONTO {
            (sum, total, square) = (os[x], on[x], om[x]);
        }
        for k in 0..K {
            // SAFETY: compared with the length above.
            let (s, n) = weigh(unsafe { *src.get_unchecked(k * pitch + x) });
            (sum, total) = (sum.plus(s), total + n);
        }
        let i = 1.0 / total;
        let i = if total > 0.0 { i } else { 0.0 };
        let mean = sum.mean(total, i);
        if ONTO {
            let d = os[x].deviation(on[x], mean);
            square = (d * d).mul_add(oi[x], square);
        }
        for k in 0..K {
            // SAFETY: as above.
            let (s, n) = weigh(unsafe { *src.get_unchecked(k * pitch + x) });
            let d = s.deviation(n, mean);
            square = (d * d).mul_add(n, square);
        }
        (os[x], om[x], on[x], oi[x]) = (sum, square, total, i);
    }
}
