//! Extremes of float windows on their way through the axes, a tile and batch of planes at a time ([`super::float`]).

use super::along::SLACK;
use super::extremes::{blocked, deep_len, rows_extremes};
use super::float::{Float, Lines, empty_rows, first, made_above};
use super::lines::{self, Coding, Masked, Pitches, Sources};
use super::plan::{Job, Tile, cut};
use crate::brick::scratch::padded;
use crate::kernel::simd::Level;

/// Minimum and maximum on their way through the three axes.
pub struct Extremes<'a, T> {
    lo: &'a mut [T],
    hi: &'a mut [T],
    row_lo: &'a mut [T],
    row_hi: &'a mut [T],
    work: &'a mut [T],
    deep: &'a mut [T],
    /// The last row made.
    pub out_lo: &'a mut [T],
    pub out_hi: &'a mut [T],
}

impl<'a, T: Float> Extremes<'a, T> {
    /// Planes, rows (twice each), work, deep work, results (twice).
    fn lens(job: &Job) -> [usize; 5] {
        let k = job.needs.extremes as usize;
        [
            job.batch * job.narrow_plane(),
            job.rows * job.pitch + SLACK,
            2 * (job.pitch + SLACK),
            deep_len(job),
            job.tile[1].next_multiple_of(64),
        ]
        .map(|n| k * n)
    }

    pub fn bytes(job: &Job) -> usize {
        let [planes, rows, work, deep, out] = Self::lens(job).map(padded::<T>);
        2 * (planes + rows + out) + work + deep
    }

    pub fn cut(job: &Job, bytes: &mut &'a mut [u8]) -> Self {
        let [planes, rows, work, deep, out] = Self::lens(job);
        let mut of = |n| cut::<T>(bytes, n);
        let (lo, hi, row_lo, row_hi) = (of(planes), of(planes), of(rows), of(rows));
        let (work, deep) = (of(work), of(deep));
        Extremes { lo, hi, row_lo, row_hi, work, deep, out_lo: of(out), out_hi: of(out) }
    }

    /// Nothing is neutral.
    pub fn clear(&mut self) {
        for (lo, hi) in [(&mut self.lo, &mut self.hi), (&mut self.row_lo, &mut self.row_hi)] {
            lo.fill(T::GREATEST);
            hi.fill(T::LEAST);
        }
    }

    /// Moves rows that the tile above has made; rows that do not exist are neutral.
    pub fn keep(&mut self, job: &Job, tile: &Tile, kept: usize) {
        for plane in (0..self.lo.len()).step_by(job.narrow_plane()) {
            let above = made_above(job, kept, plane);
            self.lo.copy_within(above.clone(), plane);
            self.hi.copy_within(above, plane);
            for gap in empty_rows(job, tile, kept, plane) {
                self.lo[gap.clone()].fill(T::GREATEST);
                self.hi[gap].fill(T::LEAST);
            }
        }
    }

    /// Over z, buffer row `j` of all planes of a batch. NaN never wins a comparison, so it does not count.
    pub fn planes(&mut self, level: Level, job: &Job, tile: &Tile, j: usize, lines: &Lines<T>) {
        let plain = Coding { flip: T::default(), missing: T::default() };
        let (masked, sources, blocks) = (Masked::<false>, Sources::<false>, (job.batch, job.block));
        let (cols, out) = (tile.columns(), (j * job.narrow, job.narrow_plane()));
        let clip = (lines.exist.0 as isize, lines.exist.1 as isize);
        let from = lines::Lines { base: tile.cols.0 - first(tile), pitch: lines.pitch, first: 0, clip };
        let (src, w) = ([&*lines.buffer; 2], job.window[0]);
        blocked(level, blocks, masked, sources, src, from, w, cols, plain, self.lo, self.hi, out, self.deep);
    }

    /// Over y and x, row `j` of plane `k`; rows come in order.
    pub fn row(&mut self, level: Level, job: &Job, tile: &Tile, k: usize, j: usize) {
        if j.is_multiple_of(job.rows) {
            let plane = k * job.narrow_plane()..(k + 1) * job.narrow_plane();
            let from = [&self.lo[plane.clone()], &self.hi[plane]];
            let lines = lines::Lines { base: 0, pitch: job.narrow, first: j as isize, clip: (0, job.height as isize) };
            rows_extremes(level, job, tile, from, lines, self.row_lo, self.row_hi, self.deep);
        }
        let line = (j % job.rows) * job.pitch;
        let (lo, hi) = (&self.row_lo[line..], &self.row_hi[line..]);
        let pitches = Pitches { from: 0, to: 0, rows: 1 };
        lines::row_extremes(level, lo, hi, job.window[2], job.tile[1], self.out_lo, self.out_hi, pitches, self.work);
    }
}
