//! Running sums of integer codes: a plane along z, a row along y, and windows along x from both.

use super::estimate::{Acc, Code};
use super::lines::{self, Add, Coding, Masked, Op};
use super::plan::{Job, ROWS, Tile, bits, cut};
use super::slide::{Rows, Slide};
use crate::brick::scratch::padded;
use crate::grid::View;
use crate::kernel::simd::Level;

/// Buffers of one moment: a running plane over z; a running row over y and the rows made from it; those widened for x;
/// the tree of one row; the results of all.
pub(super) struct Moment<'a, Z, Y, X> {
    plane: &'a mut [Z],
    rows: &'a mut [Y],
    wide: &'a mut [X],
    work: &'a mut [X],
    pub out: &'a mut [X],
}

/// Elements of a tree along x of a row, or of its running sums.
fn tree_len(job: &Job) -> usize {
    (lines::tree_levels(job.window[2]) * (job.tile[1] + job.window[2])).max(job.pitch + 64)
}

impl<'a, Z: bytemuck::Pod, Y: bytemuck::Pod, X: bytemuck::Pod> Moment<'a, Z, Y, X> {
    /// Elements of each buffer.
    fn lens(job: &Job, wanted: bool) -> [usize; 5] {
        let wide = if size_of::<Y>() == size_of::<X>() { 0 } else { ROWS * job.pitch };
        let all = [job.plane(), (1 + ROWS) * job.pitch, wide, tree_len(job), ROWS * job.out_pitch()];
        all.map(|len| wanted as usize * len)
    }

    pub fn cut(job: &Job, wanted: bool, bytes: &mut &'a mut [u8]) -> Self {
        let [plane, rows, wide, work, out] = Self::lens(job, wanted);
        Moment {
            plane: cut(bytes, plane),
            rows: cut(bytes, rows),
            wide: cut(bytes, wide),
            work: cut(bytes, work),
            out: cut(bytes, out),
        }
    }

    pub fn bytes(job: &Job, wanted: bool) -> usize {
        let [plane, rows, wide, work, out] = Self::lens(job, wanted);
        padded::<Z>(plane) + padded::<Y>(rows) + padded::<X>(wide) + padded::<X>(work) + padded::<X>(out)
    }
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

impl<Z: Acc, Y: Acc + From<Z>, X: Acc + From<Y> + Slide<Z, Y>> Moment<'_, Z, Y, X>
where
    Add: Op<X>,
{
    /// Starts the running row with all but the last row of the first window.
    pub fn begin_rows(&mut self, level: Level, job: &Job) {
        let run = &mut self.rows[..job.pitch];
        run.fill(Y::default());
        for y in 0..job.window[1] - 1 {
            add_row(level, &self.plane[y * job.pitch..][..job.columns()], run);
        }
    }

    /// Sums of the windows of `rows` output rows from `y` of the tile on, left in `out`.
    pub fn finish_rows(&mut self, level: Level, job: &Job, y: usize, rows: usize) {
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

/// The sums of a run: first and second moments and, where voxels may be missing (`M`), counts.
pub(super) struct Sums<'a, Z1, Y1, X1, Z2, Y2, X2, const M: bool> {
    pub s1: Moment<'a, Z1, Y1, X1>,
    pub s2: Moment<'a, Z2, Y2, X2>,
    pub count: Moment<'a, u32, u32, u32>,
}

impl<'a, Z1, Y1, X1, Z2, Y2, X2, const M: bool> Sums<'a, Z1, Y1, X1, Z2, Y2, X2, M>
where
    Z1: Acc,
    Y1: Acc + From<Z1>,
    X1: Acc + From<Y1> + Slide<Z1, Y1>,
    Z2: Acc,
    Y2: Acc + From<Z2>,
    X2: Acc + From<Y2> + Slide<Z2, Y2>,
    Add: Op<X1> + Op<X2>,
{
    pub fn cut(job: &Job, bytes: &mut &'a mut [u8]) -> Self {
        Sums {
            s1: Moment::cut(job, job.needs.mean, bytes),
            s2: Moment::cut(job, job.needs.variance, bytes),
            count: Moment::cut(job, M, bytes),
        }
    }

    pub fn bytes(job: &Job) -> usize {
        Moment::<Z1, Y1, X1>::bytes(job, job.needs.mean)
            + Moment::<Z2, Y2, X2>::bytes(job, job.needs.variance)
            + Moment::<u32, u32, u32>::bytes(job, M)
    }

    pub fn begin_tile(&mut self) {
        self.s1.plane.fill(Z1::default());
        self.s2.plane.fill(Z2::default());
        self.count.plane.fill(0);
    }

    /// Adds the tile's part of the plane `new` of `src` to the running planes and drops that of `old`.
    pub fn slide_in<T>(
        &mut self,
        level: Level,
        job: &Job,
        tile: &Tile,
        src: View<T>,
        coding: Coding<T>,
        [new, old]: [Option<usize>; 2],
    ) where
        T: Code,
        Z1: From<T>,
        Z2: From<T::Square>,
    {
        for j in tile.rows.0..tile.rows.1 {
            let part = |z: usize| {
                let (first, len) = (tile.cols.2, tile.cols.1 - tile.cols.0);
                &src.row_at(z, tile.rows.2 + j - tile.rows.0)[first..first + len]
            };
            let (new, old) = (new.map_or(&[][..], part), old.map_or(&[][..], part));
            let span = tile.span(job, j);
            if job.needs.mean {
                slide(level, Plainly, Masked::<M>, coding, new, old, &mut self.s1.plane[span.clone()]);
            }
            if job.needs.variance {
                slide(level, Squared, Masked::<M>, coding, new, old, &mut self.s2.plane[span.clone()]);
            }
            if M {
                slide(level, Counted, Masked::<M>, coding, new, old, &mut self.count.plane[span]);
            }
        }
    }

    /// Starts the running rows of a plane of outputs.
    pub fn begin_rows(&mut self, level: Level, job: &Job) {
        if job.needs.mean {
            self.s1.begin_rows(level, job);
        }
        if job.needs.variance {
            self.s2.begin_rows(level, job);
        }
        if M {
            self.count.begin_rows(level, job);
        }
    }

    /// Sums of the windows of `rows` output rows from `y` of the tile on.
    pub fn finish_rows(&mut self, level: Level, job: &Job, y: usize, rows: usize) {
        if job.needs.mean {
            self.s1.finish_rows(level, job, y, rows);
        }
        if job.needs.variance {
            self.s2.finish_rows(level, job, y, rows);
        }
        if M {
            self.count.finish_rows(level, job, y, rows);
        }
    }
}
