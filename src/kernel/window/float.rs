//! Float volumes: extremes exactly, sums and merges of (sum, M2) in an order that depends on the window and its place in
//! the volume alone, so that neither the brick nor a NaN elsewhere in it shows in a single bit.
//!
//! Per tile and batch of planes: z leaves planes of cells, y leaves lines of x that hold eight rows each, x leaves rows
//! ([`super::moments`]).

use std::ops::Range;

use super::emit::{Emit, Estimator, estimator, polarity, put_moment, put_openness, repair};
use super::float_estimate as est;
use super::float_extremes::Extremes;
use super::float_power::{self, Centre, Windows};
use super::float_spread::{self, Spreads};
use super::lines::Elem;
use super::merge::{Sum, Weight};
use super::moments::{self, First, Held, Layout, Moments, Pass, Wanted};
use super::parts::{BLOCK, Weights};
use super::plan::{self, Job, Needs, Tile, cut};
use super::{Place, WindowOut};
use crate::brick::scratch::padded;
use crate::grid::{AnyViewMut, Shape, View};
use crate::kernel::lanes::LANES;
use crate::kernel::simd::Level;
use crate::stage::{WindowChannel, WindowParams};

/// f32 (sums in f64) or f64 (sums in pairs of f64).
pub trait Float: Elem + Centre + First {
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

/// Bytes of scratch.
pub fn bytes<T: Float>(job: &Job) -> usize {
    let wanted = Wanted { pairs: T::Total::PAIR, variance: job.needs.variance, counts: true };
    let sums = if job.needs.mean { Buffers::<T::Total>::bytes(job, wanted) } else { 0 };
    Emit::bytes(job.tile[1], job.tile[1]) + padded::<T>(Lines::<T>::len(job)) + Extremes::<T>::bytes(job) + sums
}

/// The lines along z of one buffer row of a batch, side by side, from [`first`] column on: planes lie a power of two apart in many volumes, and then
/// few cache sets hold all of a column, which extremes and sums both read. 2-core Zen 4 VM, AVX-512, 2026-11-23, 256 x 256
/// planes, cdf_power r=10 of f32: 12.9 ns/voxel in place, 11.4 and 10.0 staged, in runs of their own on a busy machine.
pub struct Lines<'a, T> {
    pub buffer: &'a mut [T],
    pub pitch: usize,
    /// Source plane of line 0, and lines that exist.
    first: isize,
    pub exist: (usize, usize),
}

impl<'a, T: Float> Lines<'a, T> {
    /// An odd number of cache lines.
    fn pitch(job: &Job) -> usize {
        ((job.narrow * size_of::<T>()).div_ceil(64) | 1) * 64 / size_of::<T>()
    }

    fn len(job: &Job) -> usize {
        (job.batch + job.window[0] - 1) * Self::pitch(job)
    }

    fn new(job: &Job, buffer: &'a mut [T]) -> Self {
        Lines { buffer, pitch: Self::pitch(job), first: 0, exist: (0, 0) }
    }

    /// For the batch that starts at output `z0`: what does not exist is `nothing`.
    fn aim(&mut self, job: &Job, z0: usize, nothing: T) {
        self.first = job.at[0] + z0 as isize - job.radius[0] as isize;
        let lines = (job.batch + job.window[0] - 1) as isize;
        self.exist = [0, job.src[0] as isize].map(|z| (z - self.first).clamp(0, lines) as usize).into();
        self.buffer.fill(nothing);
    }

    /// Copies the lines of buffer row `j`, which exists.
    fn fill(&mut self, tile: &Tile, src: View<T>, j: usize) {
        let (y, cols, first) = (tile.rows.2 + j - tile.rows.0, tile.columns(), tile.cols.0 - first(tile));
        for i in self.exist.0..self.exist.1 {
            let z = (self.first + i as isize) as usize;
            let from = &src.row_at(z, y)[tile.cols.2..tile.cols.2 + cols];
            self.buffer[i * self.pitch + first..][..cols].copy_from_slice(from);
            plan::fetch_below(src, [z, y, tile.cols.2], cols);
        }
    }
}

/// Columns of a row of a tile with its halo, in whole vectors.
fn width(job: &Job) -> usize {
    (job.tile[1] + 2 * job.radius[2]).next_multiple_of(LANES)
}

/// First column of a tile that sums are made for: the eight that hold its first column that exists. What lies outside is
/// nothing, and costs nothing.
pub fn first(tile: &Tile) -> usize {
    tile.cols.0 / LANES * LANES
}

/// Columns from there on, in whole vectors.
fn existing(tile: &Tile) -> usize {
    (tile.cols.1 - first(tile)).next_multiple_of(LANES)
}

crate::multiversion! {
    /// Whether a row has NaN, and infinities.
    fn odd_row[T: Float](row: &[T]) -> (bool, bool) = odd_inner;
}

#[inline(always)]
#[allow(clippy::eq_op)]
fn odd_inner<T: Float>(row: &[T]) -> (bool, bool) {
    let (mut nan, mut infinite) = (false, false);
    for v in row {
        nan |= *v != *v;
        // The ends of the order.
        infinite |= (*v == T::GREATEST) | (*v == T::LEAST);
    }
    (nan, infinite)
}

/// Whether there are NaN, and infinities, for which it looks no further than it must unless they `matter`.
fn odd_voxels<T: Float>(level: Level, src: View<T>, matter: bool) -> (bool, bool) {
    let (mut nan, mut infinite) = (false, false);
    for (z, y) in (0..src.shape[0]).flat_map(|z| (0..src.shape[1]).map(move |y| (z, y))) {
        let (n, i) = odd_row(level, src.row_at(z, y));
        (nan, infinite) = (nan | n, infinite | i);
        if nan && (infinite || !matter) {
            break;
        }
    }
    (nan, infinite)
}

/// Runs every tile of a call, with [`bytes`] of scratch.
pub fn run<T: Float>(
    src: View<T>,
    params: &WindowParams,
    place: Place,
    dst: Shape,
    outs: &mut [WindowOut],
    level: Level,
    bytes: &mut [u8],
) {
    let needs = Needs::of(outs.iter().map(|o| o.channel), true);
    let job = &Job::new(src.shape, dst, place, params, needs, plan::batch_bytes(T::DTYPE, needs));
    assert!(job.counts().0 < 1 << 31, "windows of {} voxels", job.counts().0);
    // Openness by the spread asks extremes whether a window is constant, which the M2 of finite f32 says as well.
    let asked = Needs::of(outs.iter().map(|o| o.channel), false).extremes || T::Total::PAIR;
    let (counts, infinite) = odd_voxels(level, src, needs.extremes && !asked);
    let ends = needs.extremes && (asked || infinite);
    let wanted = Wanted { pairs: T::Total::PAIR, variance: needs.variance, counts };
    let bytes = &mut &mut *bytes;
    let mut emit = Emit::new(outs, params, level, [job.tile[1]; 2], bytes);
    let mut lines = Lines::new(job, cut::<T>(bytes, Lines::<T>::len(job)));
    // Sums without counts take what does not exist as 0, others as missing.
    let nothing = T::from_f64(if counts { f64::NAN } else { 0.0 });
    let mut extremes = Extremes::<T>::cut(job, bytes);
    let mut sums = needs.mean.then(|| Buffers::<T::Total>::cut(job, wanted, bytes));
    for x in (0..job.dst[2]).step_by(job.tile[1]) {
        if ends {
            extremes.clear();
        }
        if let Some(sums) = &mut sums {
            sums.columns.clear();
        }
        for (z0, y) in corners(job) {
            let tile = Tile::new(job, y, x);
            // Rows that the tile above has made are kept.
            let kept = if y == 0 { 0 } else { 2 * job.radius[1] };
            if y == 0 {
                lines.aim(job, z0, nothing);
            }
            if ends {
                extremes.keep(job, &tile, kept);
            }
            if let Some(sums) = &mut sums {
                sums.keep(job, &tile, kept, z0);
            }
            for j in kept..tile.rows.1 {
                let exists = j >= tile.rows.0;
                if exists {
                    lines.fill(&tile, src, j);
                    if ends {
                        extremes.planes(level, job, &tile, j, &lines);
                    }
                }
                if let Some(sums) = sums.as_mut().filter(|_| exists) {
                    sums.planes(level, wanted, job, &tile, z0, j, &lines);
                }
            }
            for z in z0.max(job.skip[0])..(z0 + job.batch).min(job.dst[0]) {
                if let Some(sums) = &mut sums {
                    sums.rows(level, wanted, job, &tile, z - z0);
                }
                for j in 0..tile.size[0] {
                    if ends {
                        extremes.row(level, job, &tile, z - z0, j);
                    }
                    if let Some(sums) = &mut sums {
                        if j.is_multiple_of(BLOCK) {
                            sums.block(level, wanted, job, &tile, j / BLOCK);
                        }
                        if y + j >= job.skip[1] {
                            let section = (job.count(0, z) * job.count(1, y + j)) as f64;
                            sums.finish(level, wanted, j % BLOCK, section, job.tile[1], emit.numerator);
                        }
                    }
                    if y + j < job.skip[1] {
                        continue;
                    }
                    let from = job.skip[2].saturating_sub(x);
                    let at = [z, y + j, x + from];
                    let [v_z, v_y, v_x] = std::array::from_fn(|a| (job.at[a] + at[a] as isize) as usize);
                    let len = tile.size[1] - from;
                    let (s, m) = sums.as_ref().map_or((&[][..], &[][..]), |s| s.row(j % BLOCK, job.tile[1]));
                    let of_whole = sums.as_ref().map(|s| [&*s.whole, &*s.inverse].map(|r| plan::tail(r, from)));
                    let row = Row {
                        v: &src.row_at(v_z, v_y)[v_x..v_x + len],
                        lo: if ends { plan::tail(extremes.out_lo, from) } else { &[] },
                        hi: if ends { plan::tail(extremes.out_hi, from) } else { &[] },
                        s: plan::tail(s, from),
                        m: plan::tail(m, from),
                        whole: of_whole,
                        skip: from,
                    };
                    emit_row(&mut emit, row, std::array::from_fn(|a| at[a] - job.skip[a]), counts);
                }
            }
        }
    }
}

/// First planes of batches and first rows of tiles.
fn corners(job: &Job) -> impl Iterator<Item = (usize, usize)> + '_ {
    let planes = (0..job.dst[0]).step_by(job.batch);
    planes.flat_map(|z| (0..job.dst[1]).step_by(job.tile[0]).map(move |y| (z, y)))
}

/// The last `kept` rows of the buffer of the tile above, in the plane at `plane`; they become the first of this tile's.
pub fn made_above(job: &Job, kept: usize, plane: usize) -> Range<usize> {
    plane + job.tile[0] * job.narrow..plane + (job.tile[0] + kept) * job.narrow
}

/// Rows after the kept ones that do not exist, as elements of the plane at `plane`.
pub fn empty_rows(job: &Job, tile: &Tile, kept: usize, plane: usize) -> impl Iterator<Item = Range<usize>> {
    let pitch = job.narrow;
    let rows = [kept..tile.rows.0, tile.rows.1.max(kept)..job.height];
    rows.into_iter().filter(|r| r.start < r.end).map(move |r| plane + r.start * pitch..plane + r.end * pitch)
}

/// Finished windows of one row; what no channel needs may be empty.
pub struct Row<'a, T: Float> {
    pub v: &'a [T],
    pub lo: &'a [T],
    pub hi: &'a [T],
    pub s: &'a [T::Total],
    pub m: &'a [f64],
    /// Voxels of the windows where none is missing, and their reciprocals, if they are known.
    pub whole: Option<[&'a [f64]; 2]>,
    /// Counts of the row start there in `Emit::numerator`.
    pub skip: usize,
}

/// Writes a row that starts at output voxel `at`; `masked` where voxels may be NaN.
pub fn emit_row<T: Float>(emit: &mut Emit, row: Row<T>, at: [usize; 3], masked: bool) {
    let (level, len) = (emit.level, row.v.len());
    let n = &emit.numerator[row.skip..row.skip + len];
    use WindowChannel::{Mean, Moment2, Std, Variance};
    if emit.outs.iter().any(|o| matches!(o.channel, Mean | Moment2)) {
        est::mean_row(level, row.s, n, &mut emit.mean[..len]);
    }
    if emit.outs.iter().any(|o| matches!(o.channel, Variance | Std | Moment2)) {
        let variance = &mut emit.variance[..len];
        match row.whole {
            None => est::variance_row(level, row.m, n, variance),
            Some([_, inverse]) if !masked => est::whole_variance_row(level, row.m, inverse, variance),
            Some([whole, inverse]) => est::gapped_variance_row(level, row.m, n, whole, inverse, variance),
        }
    }
    let affine = emit.params.affine;
    for out in emit.outs.iter_mut() {
        let channel = out.channel;
        match channel {
            WindowChannel::Openness(method, ties) => {
                let polarity = polarity(emit.params, ties);
                let (v, [lo, hi]) = (row.v, [row.lo, row.hi].map(|e| &e[..len.min(e.len())]));
                let ends = (lo.len() == len).then_some([lo, hi]);
                let fill = |o: &mut [f32]| match estimator(method) {
                    Estimator::Power => {
                        float_power::cdf_power(level, &Windows { v, lo, hi, s: row.s, n }, polarity, o);
                    }
                    Estimator::Beta => est::beta_row(level, v, lo, hi, row.s, row.m, n, polarity, o),
                    Estimator::Spread(kind) => {
                        float_spread::spread_row(level, kind, &Spreads { v, ends, s: row.s, m: row.m, n }, polarity, o);
                    }
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

/// Moments on their way through the three axes.
struct Buffers<'a, A> {
    /// Planes of a batch after z.
    planes: Moments<'a>,
    /// Rows after y: for each block of eight, lines along x that hold eight rows each.
    columns: Moments<'a>,
    /// Eight rows after x, and the finished sums of one.
    rows: Moments<'a>,
    totals: &'a mut [A],
    groups: Moments<'a>,
    weights: [Weights<'a>; 3],
    /// Lines in the windows of each output, by axis.
    counts: [&'a mut [f64]; 3],
    /// Voxels of the windows of a row where none is missing, and their reciprocals, which differ from row to row only where
    /// `section`, the lines along x of a window, does.
    whole: &'a mut [f64],
    inverse: &'a mut [f64],
    section: f64,
}

impl<'a, A: Sum> Buffers<'a, A> {
    /// Outputs of a batch or tile by axis, a multiple of eight.
    fn outputs(job: &Job) -> [usize; 3] {
        [job.batch, job.tile[0], job.tile[1]]
    }

    fn lens(job: &Job) -> [usize; 4] {
        let outputs = Self::outputs(job);
        let groups = (0..3).map(|a| moments::groups_len(job.window[a], outputs[a] / BLOCK)).max().unwrap_or(0);
        let width = width(job);
        [job.batch * job.narrow_plane(), job.tile[0] * width, BLOCK * job.tile[1], groups]
    }

    fn bytes(job: &Job, wanted: Wanted) -> usize {
        let moments: usize = Self::lens(job).into_iter().map(|n| Moments::bytes(n, wanted)).sum();
        let of_axis = |a: usize| {
            let outputs = Self::outputs(job)[a];
            let [groups, blocks, kinds] = Weights::lens(job.window[a], outputs / BLOCK);
            padded::<Weight>(groups) + padded::<Weight>(blocks) + padded::<u32>(kinds) + padded::<f64>(outputs)
        };
        moments + padded::<A>(job.tile[1]) + 2 * padded::<f64>(job.tile[1]) + (0..3).map(of_axis).sum::<usize>()
    }

    fn cut(job: &Job, wanted: Wanted, bytes: &mut &'a mut [u8]) -> Self {
        let [planes, columns, rows, groups] = Self::lens(job).map(|len| Moments::cut(len, wanted, bytes));
        let totals = cut(bytes, job.tile[1]);
        let mut weights = |a: usize| {
            let outputs = Self::outputs(job)[a];
            let [groups, blocks, kinds] = Weights::lens(job.window[a], outputs / BLOCK);
            let (groups, blocks) = (cut(bytes, groups), cut(bytes, blocks));
            (Weights::new(job.window[a], groups, blocks, cut(bytes, kinds)), cut(bytes, outputs))
        };
        let [(wz, nz), (wy, ny), (wx, nx)] = [0, 1, 2].map(&mut weights);
        let (weights, counts) = ([wz, wy, wx], [nz, ny, nx]);
        let (whole, inverse) = (cut(bytes, job.tile[1]), cut(bytes, job.tile[1]));
        Buffers { planes, columns, rows, totals, groups, weights, counts, whole, inverse, section: f64::NAN }
    }

    /// Weights and counts along an axis for outputs from `start` on.
    fn aim(&mut self, job: &Job, a: usize, start: usize) {
        let outputs = Self::outputs(job)[a].min(job.dst[a] - start);
        let axis = job.axis(a, start, outputs.div_ceil(BLOCK));
        self.weights[a].fill(axis);
        self.counts[a].iter_mut().enumerate().for_each(|(k, n)| *n = axis.count(k));
    }

    /// Prepares a tile: weights, rows that the tile above has made, empty rows where none exist.
    fn keep(&mut self, job: &Job, tile: &Tile, kept: usize, z0: usize) {
        if tile.y == 0 {
            self.aim(job, 0, z0);
            if z0 == 0 {
                self.aim(job, 2, tile.x);
                self.section = f64::NAN;
            }
        }
        self.aim(job, 1, tile.y);
        for plane in (0..self.planes.s.len()).step_by(job.narrow_plane()) {
            self.planes.copy_within(made_above(job, kept, plane), plane);
            for gap in empty_rows(job, tile, kept, plane) {
                self.planes.part(gap).clear();
            }
        }
    }

    /// Over z, buffer row `j` of all planes of a batch.
    #[allow(clippy::too_many_arguments)]
    fn planes<T: Float<Total = A>>(
        &mut self,
        level: Level,
        wanted: Wanted,
        job: &Job,
        tile: &Tile,
        z0: usize,
        j: usize,
        lines: &Lines<T>,
    ) {
        let pass = Pass {
            lines: Held::default(),
            pitch: lines.pitch,
            window: job.window[0],
            blocks: 0..job.batch.min(job.dst[0] - z0).div_ceil(BLOCK),
            columns: existing(tile),
            weights: &self.weights[0],
            counts: &*self.counts[0],
            layout: Layout { block: BLOCK * job.narrow_plane(), column: 1, output: job.narrow_plane() },
        };
        let end = self.planes.s.len();
        let out = &mut self.planes.part(j * job.narrow..end);
        T::pass(level, wanted, lines.buffer, &pass, &mut self.groups, out);
    }

    /// Over y, all rows of the tile in plane `k` of the batch.
    fn rows(&mut self, level: Level, wanted: Wanted, job: &Job, tile: &Tile, k: usize) {
        let width = width(job);
        let pass = Pass {
            lines: self.planes.held().tail(k * job.narrow_plane()),
            pitch: job.narrow,
            window: job.window[1],
            blocks: 0..tile.size[0].div_ceil(BLOCK),
            columns: existing(tile),
            weights: &self.weights[1],
            counts: &*self.counts[1],
            layout: Layout { block: BLOCK * width, column: LANES, output: LANES },
        };
        let end = self.columns.s.len();
        let out = &mut self.columns.part(first(tile) * LANES..end);
        moments::pass_turned(level, wanted, &pass, &mut self.groups, out);
    }

    /// Over x, the eight rows of block `b`.
    fn block(&mut self, level: Level, wanted: Wanted, job: &Job, tile: &Tile, b: usize) {
        let pass = Pass {
            lines: self.columns.held().tail(b * BLOCK * width(job)),
            pitch: LANES,
            window: job.window[2],
            blocks: 0..tile.size[1].div_ceil(BLOCK),
            columns: LANES,
            weights: &self.weights[2],
            counts: &*self.counts[2],
            layout: Layout { block: BLOCK, column: 1, output: job.tile[1] },
        };
        moments::pass_turned(level, wanted, &pass, &mut self.groups, &mut self.rows);
    }

    /// Row `i` of a block in its final units: M2, and voxels in `n`; `section` are the lines along x of a window.
    fn finish(&mut self, level: Level, wanted: Wanted, i: usize, section: f64, width: usize, n: &mut [f64]) {
        let rows = self.rows.part(i * width..(i + 1) * width);
        let n = &mut n[..width];
        if section != self.section {
            est::whole_row(level, &self.counts[2][..width], section, self.whole, self.inverse);
            self.section = section;
        }
        est::totals_row(level, rows.s, rows.t, self.totals);
        match wanted.counts {
            true => est::counts_row(level, rows.n, self.whole, n),
            false => n.copy_from_slice(&self.whole[..width]),
        }
        if wanted.variance {
            est::settle_row(level, self.totals, n, self.whole, self.inverse, rows.m);
        }
    }

    fn row(&self, i: usize, width: usize) -> (&[A], &[f64]) {
        let m = if self.rows.m.is_empty() { &[][..] } else { &self.rows.m[i * width..(i + 1) * width] };
        (self.totals, m)
    }
}
