//! The three passes, tile by tile: columns of the output box through all planes, so that what passes hand to each other stays
//! in the second-level cache.

use std::ops::Range;

use super::rows::{Pooled, Real, any_lost, fill_row, load_row, mean_row, moment_row, pool_row, store_row};
use super::taps::{Edges, Table, Taps, bell};
use super::tiling::{Tile, Tiling, WIDTH, Wanted};
use crate::brick::scratch::cut;
use crate::grid::{Affine, AnyView, AnyViewMut, Shape};
use crate::kernel::simd::Level;
use crate::with_view;

/// What a run of the passes carries.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Pass {
    Mean,
    /// Mean and variance.
    Variance,
    /// Mean and weight; writes only voxels that an earlier run left NaN.
    GapMeans,
    /// Mean, variance and weight, likewise.
    Gaps,
}

impl Pass {
    /// Which of mean, variance and weight a cell has, in `F`.
    fn carries<F>(self) -> [bool; 3] {
        // a mean in f64 is made as a moment, beside its variance
        let moment = self == Pass::Mean && size_of::<F>() == size_of::<f64>();
        [true, moment || matches!(self, Pass::Variance | Pass::Gaps), self.counts()]
    }

    /// Whether cells may be missing.
    fn counts(self) -> bool {
        matches!(self, Pass::GapMeans | Pass::Gaps)
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

/// Buffers of one number of a cell; see [`Tiling::field`].
struct Field<'a, F> {
    row: &'a mut [F],
    plane: &'a mut [F],
    ring: &'a mut [F],
    out: &'a mut [F],
}

/// What is asked for.
pub(super) struct Out<'a, 'm, 'v> {
    pub mean: Option<&'a mut AnyViewMut<'m>>,
    pub variance: Option<&'a mut AnyViewMut<'v>>,
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
            Pass::GapMeans | Pass::Gaps => {
                let from = Pooled { mean: from[0], variance: from[1], weight: from[2] };
                pool_row(level, from, taps, [mean, variance, weight]);
            }
        }
    }
}

impl Job<'_> {
    /// Runs the passes and writes what is asked for; adds rows to `wanted` where a result is not finite though its centre is
    /// there.
    pub fn run<F: Passes>(&self, bytes: &mut [u8], pass: Pass, mut out: Out, wanted: &mut Wanted) {
        let mut run = self.start::<F>(bytes, pass);
        for tile in self.tiles(run.tiling.rows) {
            run.tile(&tile, &mut out, wanted);
        }
    }

    /// Makes what is `wanted` once more, over the voxels that are not missing.
    pub fn mend(&self, bytes: &mut [u8], mut out: Out, wanted: &mut Wanted) {
        let pass = if out.variance.is_some() { Pass::Gaps } else { Pass::GapMeans };
        let mut run = self.start::<f64>(bytes, pass);
        for mut tile in self.tiles(run.tiling.rows) {
            // a run of planes costs two half-widths of planes more
            while let Some(part) = wanted.next(&tile, 2 * self.radius[0]) {
                run.tile(&part, &mut out, wanted);
                tile.z.start = part.z.end;
            }
        }
    }

    /// The tiles of the output box.
    fn tiles(&self, rows: usize) -> impl Iterator<Item = Tile> {
        let [nz, ny, nx] = self.dst;
        (0..nx).step_by(WIDTH).flat_map(move |x| {
            let row = x..(x + WIDTH).min(nx);
            (0..ny).step_by(rows).map(move |y| Tile { z: 0..nz, y: y..(y + rows).min(ny), x: row.clone() })
        })
    }

    fn start<'b, F: Passes>(&self, bytes: &'b mut [u8], pass: Pass) -> Run<'_, 'b, F> {
        let carries = pass.carries::<F>();
        let cell = carries.iter().filter(|c| **c).count() * size_of::<F>();
        let tiling = Tiling::new(self.src.shape(), self.dst, self.radius, cell);
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
        let fields = carries.map(|carried| {
            let [row, plane, ring, out] = if carried { tiling.field() } else { [0; 4] }.map(&mut take);
            Field { row, plane, ring, out }
        });
        Run { job: self, pass, tiling, tables, edges, fields }
    }
}

/// A run of the passes: what it carries, how it is cut, and its buffers.
struct Run<'j, 'b, F> {
    job: &'j Job<'j>,
    pass: Pass,
    tiling: Tiling,
    /// Along z, y, x.
    tables: [Table<'b, F>; 3],
    edges: Edges<'b, F>,
    /// Mean, variance, weight; those that the pass does not carry are empty.
    fields: [Field<'b, F>; 3],
}

impl<F: Passes> Run<'_, '_, F> {
    /// What the windows of outputs see along an axis.
    fn needed(&self, a: usize, out: &Range<usize>) -> Range<usize> {
        let (at, r) = (self.job.at[a], self.job.radius[a]);
        (at + out.start).saturating_sub(r)..(at + out.end + r).min(self.job.src.shape()[a])
    }

    fn tile(&mut self, tile: &Tile, out: &mut Out, wanted: &mut Wanted) {
        let (src, at, r) = (self.job.src.shape(), self.job.at, self.job.radius);
        let (planes, rows) = (self.needed(0, &tile.z), self.needed(1, &tile.y));
        let width = self.tiling.width;
        for (i, y) in tile.y.clone().enumerate() {
            self.tables[1].set(i, at[1] + y, src[1], |q| (q - rows.start) * width);
        }
        let edge = self.along_x_at(tile);
        let mut done = tile.z.start;
        for sz in planes.clone() {
            for (i, sy) in rows.clone().enumerate() {
                self.load([sz, sy], tile);
                self.along_x(i, edge);
            }
            self.along_y(sz % self.tiling.slots, tile);
            // outputs whose windows are complete
            let ready = if sz + 1 == src[0] { tile.z.end } else { (sz + 1).saturating_sub(at[0] + r[0]) };
            let ready = ready.clamp(done, tile.z.end);
            if ready - done == self.tiling.batch || sz + 1 == planes.end {
                self.along_z(done..ready, tile, out, wanted);
                done = ready;
            }
        }
    }

    /// Weights along x for the lanes of a tile; whether some of them see an end of the axis. Rows are cleared: what stands beyond an
    /// end has weight 0.
    fn along_x_at(&mut self, tile: &Tile) -> bool {
        let (n, r) = (self.job.src.shape()[2], self.job.radius[2]);
        let [margin, _] = self.tiling.row();
        let (first, last) = (self.job.at[2] + tile.x.start, self.job.at[2] + tile.x.end - 1);
        // the taps of a voxel in the middle
        self.tables[2].set(0, r, 2 * r + 1, |q| margin + q - r);
        let edge = first < r || last + r >= n;
        if edge {
            self.edges.set(first, n, self.tables[2].bell);
        }
        self.fields.iter_mut().for_each(|f| f.row.fill(F::narrow(0.0)));
        edge
    }

    /// Source row `[sz, sy]`; where gaps are counted, as mean, variance 0 and weight 1 or 0.
    fn load(&mut self, [sz, sy]: [usize; 2], tile: &Tile) {
        let x = self.needed(2, &tile.x);
        let start = self.tiling.row()[0] + x.start - (self.job.at[2] + tile.x.start);
        let [mean, _, weight] = &mut self.fields;
        let row = &mut mean.row[start..start + x.len()];
        let Job { src, missing, level, .. } = *self.job;
        with_view!(AnyView, src, v => load_row(level, &v.row_at(sz, sy)[x], missing, row));
        if self.pass.counts() {
            for (m, w) in row.iter_mut().zip(&mut weight.row[start..]) {
                let gone = m.to_f64().is_nan();
                *w = F::narrow(f64::from(!gone));
                *m = if gone { F::narrow(0.0) } else { *m };
            }
        }
    }

    fn along_x(&mut self, row: usize, edge: bool) {
        let (width, [margin, _]) = (self.tiling.width, self.tiling.row());
        let Run { tables, edges, fields: [a, b, c], .. } = self;
        let taps = tables[2].taps(0, margin);
        // where gaps are counted, what does not exist has no weight
        let edges = (edge && !self.pass.counts()).then_some(&*edges);
        let to = row * width..(row + 1) * width;
        let to = [&mut a.plane, &mut b.plane, &mut c.plane].map(|p| part_mut(p, to.clone()));
        F::row(self.job.level, self.pass, [&*a.row, &*b.row, &*c.row], true, &taps, edges, to);
    }

    fn along_y(&mut self, slot: usize, tile: &Tile) {
        let Tiling { width, pitch, .. } = self.tiling;
        let first = (self.job.at[1] + tile.y.start).min(self.job.radius[1]);
        let Run { tables, fields: [a, b, c], .. } = self;
        for y in 0..tile.y.len() {
            let taps = tables[1].taps(y, (first + y) * width);
            let start = slot * pitch + y * width;
            let to = [&mut a.ring, &mut b.ring, &mut c.ring].map(|p| part_mut(p, start..start + width));
            F::row(self.job.level, self.pass, [&*a.plane, &*b.plane, &*c.plane], false, &taps, None, to);
        }
    }

    /// Planes `z` of results, whose windows are in the ring, row by row: what one row of windows reads stays close.
    fn along_z(&mut self, z: Range<usize>, tile: &Tile, out: &mut Out, wanted: &mut Wanted) {
        let (n, at) = (self.job.src.shape()[0], self.job.at[0]);
        let (level, pass) = (self.job.level, self.pass);
        let Tiling { width, batch, slots, pitch, .. } = self.tiling;
        let place = |q: usize| q % slots * pitch;
        for start in z.clone().step_by(batch) {
            let batch = start..(start + batch).min(z.end);
            for (i, z) in batch.clone().enumerate() {
                self.tables[0].set(i, at + z, n, place);
            }
            for y in 0..tile.y.len() {
                for (i, z) in batch.clone().enumerate() {
                    let row = [z, tile.y.start + y];
                    if self.pass.counts() && !wanted.holds(row, tile.x.start) {
                        continue;
                    }
                    let Run { tables, fields: [a, b, c], .. } = &mut *self;
                    let taps = tables[0].taps(i, place(at + z));
                    let from = [&a.ring, &b.ring, &c.ring].map(|r| r.get(y * width..).unwrap_or_default());
                    let to = [&mut *a.out, &mut *b.out, &mut *c.out];
                    F::row(level, pass, from, false, &taps, None, to);
                    self.write(row, tile, out, wanted);
                }
            }
        }
    }

    /// Scales and stores one row of what is asked for. What is not finite becomes NaN, which is what passes that count gaps
    /// then write over.
    fn write(&self, [z, y]: [usize; 2], tile: &Tile, out: &mut Out, wanted: &mut Wanted) {
        let (a, b) = (self.job.affine.slope, self.job.affine.intercept);
        let mut lost = false;
        if let Some(dst) = &mut out.mean {
            lost |= self.write_one([z, y], tile, 0, [a, b], dst);
        }
        if let Some(dst) = &mut out.variance {
            lost |= self.write_one([z, y], tile, 1, [a * a, 0.0], dst);
        }
        if lost {
            wanted.add([z, y], tile.x.start);
        }
    }

    /// One row of one output from a field; whether a voxel is left NaN that is not missing.
    fn write_one(&self, [z, y]: [usize; 2], tile: &Tile, field: usize, scale: [f64; 2], dst: &mut AnyViewMut) -> bool {
        match dst {
            AnyViewMut::F32(d) => self.write_row([z, y], tile, field, scale, &mut d.row_at(z, y)[tile.x.clone()]),
            AnyViewMut::F64(d) => self.write_row([z, y], tile, field, scale, &mut d.row_at(z, y)[tile.x.clone()]),
            other => panic!("a Gaussian moment is not {}", other.dtype()),
        }
    }

    fn write_row<D: Real>(
        &self,
        [z, y]: [usize; 2],
        tile: &Tile,
        field: usize,
        [a, b]: [f64; 2],
        dst: &mut [D],
    ) -> bool {
        let Job { src, missing, level, at, .. } = *self.job;
        let row = &self.fields[field].out[..dst.len()];
        let x = at[2] + tile.x.start..at[2] + tile.x.end;
        if self.pass.counts() {
            let weight = &self.fields[2].out[..dst.len()];
            with_view!(AnyView, src, v => {
                fill_row(level, &v.row_at(at[0] + z, at[1] + y)[x], missing, [row, weight], [a, b], dst);
            });
            return false;
        }
        let finite = store_row(level, row, a, b, dst);
        !finite && with_view!(AnyView, src, v => any_lost(level, &v.row_at(at[0] + z, at[1] + y)[x], missing, dst))
    }
}

/// A part of a buffer; nothing of one that the pass does not carry.
fn part_mut<F>(buffer: &mut [F], range: Range<usize>) -> &mut [F] {
    buffer.get_mut(range).unwrap_or_default()
}
