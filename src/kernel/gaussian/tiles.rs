//! The three passes, tile by tile: columns of the output box through all planes, so that what passes hand to each other stays
//! in the second-level cache.

use std::ops::Range;

use super::rows::{LANES, Pooled, Real, load_row, mean_row, moment_row, pool_row, store_row};
use super::taps::{Edges, Table, Taps, bell};
use crate::brick::scratch::{cut, padded};
use crate::grid::{Affine, AnyView, AnyViewMut, Shape, Voxel};
use crate::kernel::simd::Level;
use crate::kernel::values::{load_any, store_any};
use crate::with_view;

/// What a run of the passes carries.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Pass {
    Mean,
    /// Mean and variance.
    Variance,
    /// Mean, variance and weight; writes only voxels that an earlier run left NaN.
    Gaps,
}

impl Pass {
    /// Numbers of a cell.
    fn fields(self) -> usize {
        match self {
            Pass::Mean => 1,
            Pass::Variance => 2,
            Pass::Gaps => 3,
        }
    }
}

pub(super) struct Job<'a> {
    pub src: AnyView<'a>,
    pub missing: Option<i64>,
    pub affine: Affine,
    pub at: [usize; 3],
    pub dst: Shape,
    pub radius: [usize; 3],
    pub sigma: [f64; 3],
    pub level: Level,
}

/// Voxels of a tile along x.
const WIDTH: usize = 64;
/// Bytes that the planes between the passes along y and z take, where that leaves rows enough.
const RING_BYTES: usize = 512 << 10;
/// Least rows of a tile for each that its windows add at both sides.
const ROWS_PER_HALO: usize = 1;

/// Elements after which addresses meet in the sets of a first-level cache: a page of f32, two of f64.
const PAGE: usize = 1024;

/// How the output box is cut, and what a tile holds between passes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tiling {
    /// Lanes of a row.
    width: usize,
    rows: usize,
    /// Planes of results made together, so that each plane of the ring is read fewer times.
    batch: usize,
    /// Planes of the ring, and elements from one to the next.
    slots: usize,
    pitch: usize,
    radius: [usize; 3],
}

impl Tiling {
    /// `cell` is the size of all numbers of a cell.
    pub fn new(src: Shape, dst: Shape, radius: [usize; 3], cell: usize) -> Tiling {
        let width = dst[2].min(WIDTH).next_multiple_of(LANES);
        let batch = radius[0].clamp(4, 16).min(dst[0]);
        let slots = (2 * radius[0] + batch).min(src[0]);
        let fit = RING_BYTES / (slots * width * cell);
        let rows = fit.max(2 * radius[1] * ROWS_PER_HALO).max(8).min(dst[1]);
        // tiles of one height
        let rows = dst[1].div_ceil(dst[1].div_ceil(rows));
        // the same row of all planes falls into sets of its own in the first-level cache
        let pitch = (rows * width).next_multiple_of(PAGE) + width;
        Tiling { width, rows, batch, slots, pitch, radius }
    }

    /// Lanes before the first of a source row, and of all of it.
    fn row(&self) -> [usize; 2] {
        let margin = self.radius[2].next_multiple_of(LANES);
        [margin, margin + self.width + self.radius[2].next_multiple_of(LANES)]
    }

    /// Elements of a field's buffers: a source row, a plane after the pass along x, the ring after that along y, a row of
    /// results.
    fn field(&self) -> [usize; 4] {
        [self.row()[1], (self.rows + 2 * self.radius[1]) * self.width, self.slots * self.pitch, self.width]
    }

    /// Bytes of scratch for `fields` numbers of `F` in a cell.
    pub fn bytes<F>(&self, fields: usize) -> usize {
        let table = |axis: usize, entries: usize| {
            let r = self.radius[axis];
            padded::<f64>(r + 1)
                + padded::<F>(entries * (r + 1))
                + padded::<u32>(2 * entries * r)
                + padded::<u32>(2 * entries)
        };
        let edges = padded::<F>((self.radius[2] + 1) * self.width) + 2 * padded::<F>(self.width);
        let tables = table(2, 1) + table(1, self.rows) + table(0, self.batch);
        fields * self.field().into_iter().map(padded::<F>).sum::<usize>() + tables + edges
    }
}

/// Buffers of one number of a cell; see [`Tiling::field`].
struct Field<'a, F> {
    row: &'a mut [F],
    plane: &'a mut [F],
    ring: &'a mut [F],
    out: &'a mut [F],
}

/// Buffers of a run.
struct Work<'a, F> {
    /// Along z, y, x.
    tables: [Table<'a, F>; 3],
    edges: Edges<'a, F>,
    /// Mean, variance, weight; those that the pass does not carry are empty.
    fields: [Field<'a, F>; 3],
}

/// What is asked for.
pub(super) struct Out<'a, 'm, 'v> {
    pub mean: Option<&'a mut AnyViewMut<'m>>,
    pub variance: Option<&'a mut AnyViewMut<'v>>,
}

/// A tile: its outputs along y and x.
struct Tile {
    y: Range<usize>,
    x: Range<usize>,
}

/// A pass over one row, in `F`: `from` are buffers of mean, variance, weight; `first` says that cells have no variance yet.
pub(super) trait Passes: Real {
    fn row(
        level: Level,
        pass: Pass,
        from: [&[Self]; 3],
        first: bool,
        taps: &Taps<Self>,
        edges: Option<&Edges<Self>>,
        to: [&mut [Self]; 3],
    );
}

impl Passes for f32 {
    fn row(
        level: Level,
        _pass: Pass,
        [from, ..]: [&[f32]; 3],
        _first: bool,
        taps: &Taps<f32>,
        edges: Option<&Edges<f32>>,
        [to, ..]: [&mut [f32]; 3],
    ) {
        mean_row(level, from, taps, edges, to);
    }
}

impl Passes for f64 {
    fn row(
        level: Level,
        pass: Pass,
        from: [&[f64]; 3],
        first: bool,
        taps: &Taps<f64>,
        edges: Option<&Edges<f64>>,
        [mean, variance, weight]: [&mut [f64]; 3],
    ) {
        match pass {
            Pass::Mean | Pass::Variance => {
                moment_row(level, [from[0], from[1]], !first, taps, edges, [mean, variance]);
            }
            Pass::Gaps => {
                let from = Pooled { mean: from[0], variance: from[1], weight: from[2] };
                pool_row(level, from, taps, [mean, variance, weight]);
            }
        }
    }
}

impl Job<'_> {
    /// Runs the passes and writes what is asked for; returns whether every result is finite.
    pub fn run<F: Passes>(&self, bytes: &mut [u8], pass: Pass, mut out: Out) -> bool {
        let tiling = self.tiling::<F>(pass);
        let mut work = self.carve::<F>(bytes, &tiling, fields_of::<F>(pass));
        let [_, ny, nx] = self.dst;
        let mut finite = true;
        for x in (0..nx).step_by(WIDTH) {
            for y in (0..ny).step_by(tiling.rows) {
                let tile = Tile { y: y..(y + tiling.rows).min(ny), x: x..(x + WIDTH).min(nx) };
                finite &= self.tile(&tile, &tiling, pass, &mut work, &mut out);
            }
        }
        finite
    }

    fn tiling<F>(&self, pass: Pass) -> Tiling {
        Tiling::new(self.src.shape(), self.dst, self.radius, fields_of::<F>(pass) * size_of::<F>())
    }

    fn tile<F: Passes>(&self, tile: &Tile, tiling: &Tiling, pass: Pass, work: &mut Work<F>, out: &mut Out) -> bool {
        let (src, r) = (self.src.shape(), self.radius);
        let needed = |a: usize, out: Range<usize>| {
            (self.at[a] + out.start).saturating_sub(r[a])..(self.at[a] + out.end + r[a]).min(src[a])
        };
        let (planes, rows) = (needed(0, 0..self.dst[0]), needed(1, tile.y.clone()));
        let width = tiling.width;
        for (i, y) in tile.y.clone().enumerate() {
            work.tables[1].set(i, self.at[1] + y, src[1], |q| (q - rows.start) * width);
        }
        let edge = self.along_x_at(tile, tiling, work);
        let (mut done, mut finite) = (0, true);
        for sz in planes.clone() {
            for (i, sy) in rows.clone().enumerate() {
                self.load(pass, [sz, sy], needed(2, tile.x.clone()), tile, tiling, work);
                self.along_x(pass, i, edge, tiling, work);
            }
            self.along_y(pass, sz % tiling.slots, tile, tiling, work);
            // outputs whose windows are complete
            let ready = if sz + 1 == src[0] {
                self.dst[0]
            } else {
                (sz + 1).saturating_sub(self.at[0] + r[0]).min(self.dst[0])
            };
            if ready - done == tiling.batch || sz + 1 == planes.end {
                finite &= self.along_z(pass, done..ready, tile, tiling, work, out);
                done = ready;
            }
        }
        finite
    }
}

fn fields_of<F>(pass: Pass) -> usize {
    // a mean in f64 is made as a moment, beside its variance
    if size_of::<F>() == size_of::<f64>() { pass.fields().max(2) } else { 1 }
}

impl Job<'_> {
    fn carve<'b, F: Passes>(&self, bytes: &'b mut [u8], tiling: &Tiling, fields: usize) -> Work<'b, F> {
        let mut rest = bytes;
        let tables = [(0, tiling.batch), (1, tiling.rows), (2, 1)].map(|(a, entries)| {
            let r = self.radius[a];
            let (bells, tail) = cut::<f64>(std::mem::take(&mut rest), r + 1);
            let (weights, tail) = cut::<F>(tail, entries * (r + 1));
            let (places, tail) = cut::<u32>(tail, 2 * entries * r);
            let (counts, tail) = cut::<u32>(tail, 2 * entries);
            rest = tail;
            bells.iter_mut().enumerate().for_each(|(k, b)| *b = bell(self.sigma[a], k));
            let [places, counts] = [places, counts].map(|p| p.as_chunks_mut::<2>().0);
            Table { radius: r, bell: bells, weights, places, counts }
        });
        let mut take = |len: usize| {
            let (part, tail) = cut::<F>(std::mem::take(&mut rest), len);
            rest = tail;
            part
        };
        let weights = take((self.radius[2] + 1) * tiling.width);
        let edges = Edges { weights, room: [take(tiling.width), take(tiling.width)] };
        let fields = std::array::from_fn(|i| {
            let [row, plane, ring, out] = if i < fields { tiling.field() } else { [0; 4] }.map(&mut take);
            Field { row, plane, ring, out }
        });
        Work { tables, edges, fields }
    }

    /// Weights along x for the lanes of a tile; whether some of them see an end of the axis. Rows are cleared: what stands beyond an
    /// end has weight 0.
    fn along_x_at<F: Passes>(&self, tile: &Tile, tiling: &Tiling, work: &mut Work<F>) -> bool {
        let (n, r) = (self.src.shape()[2], self.radius[2]);
        let [margin, _] = tiling.row();
        let (first, last) = (self.at[2] + tile.x.start, self.at[2] + tile.x.end - 1);
        // the taps of a voxel in the middle
        work.tables[2].set(0, r, 2 * r + 1, |q| margin + q - r);
        let edge = first < r || last + r >= n;
        if edge {
            work.edges.set(first, n, work.tables[2].bell);
        }
        work.fields.iter_mut().for_each(|f| f.row.fill(F::narrow(0.0)));
        edge
    }

    /// Source row `[sz, sy]`; where gaps are counted, as mean, variance 0 and weight 1 or 0.
    fn load<F: Passes>(
        &self,
        pass: Pass,
        [sz, sy]: [usize; 2],
        x: Range<usize>,
        tile: &Tile,
        tiling: &Tiling,
        work: &mut Work<F>,
    ) {
        let start = tiling.row()[0] + x.start - (self.at[2] + tile.x.start);
        let [mean, _, weight] = &mut work.fields;
        let row = &mut mean.row[start..start + x.len()];
        with_view!(AnyView, self.src, v => load_row(self.level, &v.row_at(sz, sy)[x], self.missing, row));
        if pass == Pass::Gaps {
            for (m, w) in row.iter_mut().zip(&mut weight.row[start..]) {
                let gone = m.to_f64().is_nan();
                *w = F::narrow(f64::from(!gone));
                *m = if gone { F::narrow(0.0) } else { *m };
            }
        }
    }

    fn along_x<F: Passes>(&self, pass: Pass, row: usize, edge: bool, tiling: &Tiling, work: &mut Work<F>) {
        let Work { tables, edges, fields: [a, b, c] } = work;
        let taps = tables[2].taps(0, tiling.row()[0]);
        // where gaps are counted, what does not exist has no weight
        let edges = (edge && pass != Pass::Gaps).then_some(&*edges);
        let to = row * tiling.width..(row + 1) * tiling.width;
        let to = [&mut a.plane, &mut b.plane, &mut c.plane].map(|p| part_mut(p, to.clone()));
        F::row(self.level, pass, [&*a.row, &*b.row, &*c.row], true, &taps, edges, to);
    }

    fn along_y<F: Passes>(&self, pass: Pass, slot: usize, tile: &Tile, tiling: &Tiling, work: &mut Work<F>) {
        let Work { tables, fields: [a, b, c], .. } = work;
        let first = (self.at[1] + tile.y.start).min(self.radius[1]);
        for y in 0..tile.y.len() {
            let taps = tables[1].taps(y, (first + y) * tiling.width);
            let start = slot * tiling.pitch + y * tiling.width;
            let to = [&mut a.ring, &mut b.ring, &mut c.ring].map(|p| part_mut(p, start..start + tiling.width));
            F::row(self.level, pass, [&*a.plane, &*b.plane, &*c.plane], false, &taps, None, to);
        }
    }

    /// Planes `z` of results, whose windows are in the ring, row by row: what one row of windows reads stays close.
    fn along_z<F: Passes>(
        &self,
        pass: Pass,
        z: Range<usize>,
        tile: &Tile,
        tiling: &Tiling,
        work: &mut Work<F>,
        out: &mut Out,
    ) -> bool {
        let n = self.src.shape()[0];
        let place = |q: usize| q % tiling.slots * tiling.pitch;
        let mut finite = true;
        for start in z.clone().step_by(tiling.batch) {
            let batch = start..(start + tiling.batch).min(z.end);
            for (i, z) in batch.clone().enumerate() {
                work.tables[0].set(i, self.at[0] + z, n, place);
            }
            for y in 0..tile.y.len() {
                for (i, z) in batch.clone().enumerate() {
                    let Work { tables, fields: [a, b, c], .. } = &mut *work;
                    let taps = tables[0].taps(i, place(self.at[0] + z));
                    let from = [&a.ring, &b.ring, &c.ring].map(|r| r.get(y * tiling.width..).unwrap_or_default());
                    F::row(self.level, pass, from, false, &taps, None, [&mut *a.out, &mut *b.out, &mut *c.out]);
                    let (at, x) = ([z, tile.y.start + y], tile.x.clone());
                    if let Some(dst) = &mut out.mean {
                        finite &= self.write(pass, at, x.clone(), work, false, dst);
                    }
                    if let Some(dst) = &mut out.variance {
                        finite &= self.write(pass, at, x, work, true, dst);
                    }
                }
            }
        }
        finite
    }

    /// Scales and stores one row of means, or of variances (`squared`); returns whether it is finite. What is not becomes
    /// NaN, which is what [`Pass::Gaps`] then writes over.
    fn write<F: Passes>(
        &self,
        pass: Pass,
        [z, y]: [usize; 2],
        x: Range<usize>,
        work: &Work<F>,
        squared: bool,
        dst: &mut AnyViewMut,
    ) -> bool {
        let row = &work.fields[usize::from(squared)].out[..x.len()];
        let (a, b) = (self.affine.slope, self.affine.intercept);
        let (a, b) = if squared { (a * a, 0.0) } else { (a, b) };
        match (pass, dst) {
            (Pass::Gaps, dst) => {
                let weight = &work.fields[2].out[..x.len()];
                for ((x, v), w) in x.zip(row).zip(weight) {
                    if w.to_f64() > 0.0 && is_nan_at(dst, [z, y, x]) && !self.is_missing([z, y, x]) {
                        store_any(dst, [z, y, x], &[a * v.to_f64() + b]);
                    }
                }
                true
            }
            (_, AnyViewMut::F32(d)) => store_row(self.level, row, a, b, &mut d.row_at(z, y)[x]),
            (_, AnyViewMut::F64(d)) => store_row(self.level, row, a, b, &mut d.row_at(z, y)[x]),
            (_, other) => panic!("a Gaussian moment is not {}", other.dtype()),
        }
    }

    /// Whether the centre of an output voxel is missing.
    fn is_missing(&self, [z, y, x]: [usize; 3]) -> bool {
        let mut centre = [0.0];
        load_any(&self.src, [self.at[0] + z, self.at[1] + y, self.at[2] + x], self.missing, &mut centre);
        centre[0].is_nan()
    }
}

fn is_nan_at(dst: &mut AnyViewMut, [z, y, x]: [usize; 3]) -> bool {
    with_view!(AnyViewMut, dst, d => d.row_at(z, y)[x].to_f64().is_nan())
}

/// A part of a buffer; nothing of one that the pass does not carry.
fn part_mut<F>(buffer: &mut [F], range: Range<usize>) -> &mut [F] {
    buffer.get_mut(range).unwrap_or_default()
}
