//! Extremes of integer codes over a tile: planes along z, rows along y, windows along x, each from the one before.

use super::along::SLACK;
use super::estimate::Code;
use super::extremes::{Groups, blocked, deep, deep_extremes, deep_len, rows_extremes, slots};
use super::lines::{self, Coding, Masked, Pitches, Sources};
use super::plan::{Job, ROWS, Stage, Tile, cut};
use crate::brick::scratch::padded;
use crate::grid::View;
use crate::kernel::simd::Level;

/// Buffers of both extremes.
pub(super) struct Extremes<'a, T> {
    /// Over z, of a batch of planes.
    lo: &'a mut [T],
    hi: &'a mut [T],
    /// Over z and y, of some rows.
    row_lo: &'a mut [T],
    row_hi: &'a mut [T],
    /// Of the windows of a block of rows.
    pub out_lo: &'a mut [T],
    pub out_hi: &'a mut [T],
    work: &'a mut [T],
    deep: &'a mut [T],
    kept: &'a mut [T],
    /// Lines side by side for the passes along z.
    stage: &'a mut [T],
}

impl<'a, T: Code> Extremes<'a, T> {
    /// Elements of each buffer.
    fn lens(job: &Job) -> [usize; 10] {
        let batch = job.batch * job.narrow_plane();
        let rows = job.rows * job.pitch + SLACK;
        let out = ROWS * job.out_pitch();
        let (work, stage) = (2 * (job.pitch + SLACK), Stage::len(job, size_of::<T>()));
        let all = [batch, batch, rows, rows, out, out, work, deep_len(job), kept_len(job), stage];
        all.map(|len| job.needs.extremes as usize * len)
    }

    pub fn cut(job: &Job, bytes: &mut &'a mut [u8]) -> Self {
        let [lo, hi, row_lo, row_hi, out_lo, out_hi, work, deep, kept, stage] = Self::lens(job);
        Extremes {
            lo: cut(bytes, lo),
            hi: cut(bytes, hi),
            row_lo: cut(bytes, row_lo),
            row_hi: cut(bytes, row_hi),
            out_lo: cut(bytes, out_lo),
            out_hi: cut(bytes, out_hi),
            work: cut(bytes, work),
            deep: cut(bytes, deep),
            kept: cut(bytes, kept),
            stage: cut(bytes, stage),
        }
    }

    pub fn bytes(job: &Job) -> usize {
        Self::lens(job).into_iter().map(padded::<T>).sum()
    }

    pub fn begin_tile(&mut self, tile: &Tile) {
        if tile.columns() < T::CHUNK.as_ref().len() {
            self.lo.fill(T::GREATEST);
            self.hi.fill(T::LEAST);
        }
        self.row_lo.fill(T::GREATEST);
        self.row_hi.fill(T::LEAST);
    }

    /// Extremes over z of a batch of output planes, straight from `src`. Long windows are made of groups of planes, which stay in
    /// `kept`, so that a batch reads no plane but those at the ends of its windows. 2-core Zen 4 VM, AVX-512, 2026-11-27, min and
    /// max of u16, 256 x 256 planes, r=64, ns per voxel with groups made anew: 3.7 in batches of 32 planes, 3.4 of 64; kept: 2.96 of
    /// 32, 3.15 of 16, 3.5 of 8; with lines copied side by side first 3.8 of 64.
    pub fn planes<const M: bool>(
        &mut self,
        level: Level,
        job: &Job,
        tile: &Tile,
        src: View<T>,
        coding: Coding<T>,
        z0: usize,
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
                deep_extremes(
                    level, masked, sources, src, lines, w, cols, coding, blocks, self.lo, self.hi, out, groups,
                    self.kept,
                );
                continue;
            }
            let (from, lines) = stage.fill(tile, src, j, self.stage);
            let blocks = (job.batch, job.block);
            let out = (at, plane);
            blocked(
                level, blocks, masked, sources, [from; 2], lines, w, cols, coding, self.lo, self.hi, out, self.kept,
            );
        }
    }

    /// Extremes of the windows of `rows` output rows from `y` of the tile on, of plane `z` of the batch.
    pub fn finish_rows(&mut self, level: Level, job: &Job, tile: &Tile, [z, y]: [usize; 2], rows: usize) {
        if y % job.rows == 0 {
            let plane = z * job.narrow_plane()..(z + 1) * job.narrow_plane();
            let from = [&self.lo[plane.clone()], &self.hi[plane]];
            let lines = tile.lines(job, y);
            rows_extremes(level, job, tile, from, lines, self.row_lo, self.row_hi, self.deep);
        }
        let line = (y % job.rows) * job.pitch;
        let (w, n) = (job.window[2], job.tile[1]);
        let pitches = Pitches { from: job.pitch, to: job.out_pitch(), rows };
        let (lo, hi) = (&self.row_lo[line..], &self.row_hi[line..]);
        lines::row_extremes(level, lo, hi, w, n, self.out_lo, self.out_hi, pitches, self.work);
    }
}

/// Elements of the extremes of groups of planes that a tile keeps from batch to batch.
fn kept_len(job: &Job) -> usize {
    2 * slots(job.window[0], job.batch / 8) * job.narrow_plane()
}
