//! Pyramid cells from level-0 voxels, unrounded.
//!
//! A cell is merged from the up to 2x2x2 cells below it, over the halved axes only, always in this order: over z and y the
//! tree (00 + 01) + (10 + 11), then over x. So its bits depend on the voxels that it covers and on nothing else: any brick
//! aligned to the cell size gives the same ones. Rows of cells are made whole; a row takes the fast way (no NaN, no mixed
//! mask) or the general one, which give the same bits where both apply.

mod rows;
#[cfg(test)]
mod tests;

use super::Context;
use super::convert::{Mapping, convert_row};
use super::simd::Level;
use crate::brick::scratch::{cut, padded};
use crate::grid::{AnyView, AnyViewMut, Shape, View};
use crate::stage::Reduce;
use crate::with_view;
use rows::Children;

/// Unrounded cells of a box of one level, dense.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Cells {
    pub kind: Reduce,
    /// Moments: the channel is a standard deviation, squared on the way in, its root taken on the way out.
    pub std: bool,
    pub shape: Shape,
    /// Level-0 voxels per cell and axis.
    pub factor: [usize; 3],
    /// Level-0 voxels of the box; the last cell of an axis covers what is left.
    pub extent: Shape,
    /// Mean: sum of values. Moments: sum of means. Min, Max, Stride: the value (NaN where none is valid).
    pub value: Vec<f64>,
    /// Mean, Moments: valid voxels that entered; the sign (also of 0) is negative where the cell covers only voxels that
    /// `where` excluded. Min, Max, Stride: the sign alone counts. Empty: every cell has all the voxels that its place
    /// implies, none excluded.
    pub mark: Vec<f64>,
    /// Moments: sum of the voxels' variances; else empty.
    pub inner: Vec<f64>,
    /// Moments: sum of squared deviations of the voxels' means from the cell's mean; else empty.
    pub between: Vec<f64>,
}

/// Level-0 voxels of a box that starts at a cell boundary and ends at one or at the end of the volume, also for every level
/// made from it.
#[derive(Clone, Copy)]
pub struct Level0<'a> {
    pub value: AnyView<'a>,
    /// Moments: the channel `mean` of the same stage. Others: `None`.
    pub mean: Option<AnyView<'a>>,
    /// 1 where `where` needs the voxel. `None`: everywhere.
    pub needed: Option<View<'a, u8>>,
}

/// How the mask lies on one row of cells.
#[derive(Clone, Copy, PartialEq)]
enum Mask {
    Needed,
    Excluded,
    Mixed,
}

/// f64 values per cell in [`Cells::store`].
pub fn planes(kind: Reduce) -> usize {
    if kind == Reduce::Moments { 4 } else { 2 }
}

/// Bytes per cell in [`Cells::store`], and the most that a cell takes in memory.
pub fn bytes_per_cell(kind: Reduce) -> usize {
    planes(kind) * size_of::<f64>()
}

impl Cells {
    /// Sets kind and extent and makes room; no allocation where capacities suffice. Contents are undefined (all marks
    /// implied) until pasted, loaded or made.
    pub fn prepare(&mut self, kind: Reduce, std: bool, factor: [usize; 3], extent: Shape) {
        let shape: Shape = std::array::from_fn(|a| extent[a].div_ceil(factor[a]));
        let n = shape.iter().product();
        let moments = if kind == Reduce::Moments { n } else { 0 };
        (self.kind, self.std, self.shape, self.factor, self.extent) = (kind, std, shape, factor, extent);
        self.value.resize(n, 0.0);
        self.inner.resize(moments, 0.0);
        self.between.resize(moments, 0.0);
        self.mark.clear();
    }

    /// Bytes of memory reserved.
    pub fn capacity_bytes(&self) -> usize {
        [&self.value, &self.mark, &self.inner, &self.between].iter().map(|v| v.capacity() * size_of::<f64>()).sum()
    }

    /// The cells, of any level, of a box in which every voxel has the value `v`, finite or NaN, exactly as they are made from the voxels,
    /// where all sums of `v` over a cell are exact; `excluded` by `where` or needed. Panics for Moments.
    pub fn uniform(&mut self, kind: Reduce, factor: [usize; 3], extent: Shape, v: f64, excluded: bool) {
        assert!(kind != Reduce::Moments, "moments of equal values are not made here");
        self.prepare(kind, false, factor, extent);
        let rows = self.shape[0] * self.shape[1];
        let n = self.shape[2];
        let mut value = std::mem::take(&mut self.value);
        if kind == Reduce::Mean && v.is_nan() {
            // No voxel counts.
            value.fill(0.0);
            self.mark.resize(rows * n, 0.0);
        } else if kind == Reduce::Mean {
            for c in 0..rows {
                self.implied([c / self.shape[1], c % self.shape[1]], &mut value[c * n..(c + 1) * n]);
            }
            value.iter_mut().for_each(|count| *count *= v);
        } else {
            value.fill(v);
        }
        self.value = value;
        for c in 0..if excluded { rows } else { 0 } {
            self.marks(c).iter_mut().for_each(|m| *m = -*m);
        }
    }

    /// Makes the first level above `src`, halving the axes named. NaN voxels do not count (Moments: in either channel);
    /// excluded voxels enter only cells that cover nothing else. Stride takes the first voxel that counts, in z, y, x
    /// order. Panics if the shapes differ or Moments lack the mean.
    pub fn first(&mut self, kind: Reduce, std: bool, src: Level0, halve: [bool; 3], cx: &mut Context) {
        let extent = src.value.shape();
        assert!(src.needed.is_none_or(|m| m.shape == extent), "the mask covers the voxels");
        assert!(src.mean.is_none_or(|m| m.shape() == extent), "the means cover the voxels");
        assert!(kind != Reduce::Moments || src.mean.is_some(), "moments need the channel of means");
        self.prepare(kind, std, halve.map(|h| 1 + usize::from(h)), extent);
        let Context { level, scratch } = cx;
        let scratch = scratch.take(padded::<f64>(extent[2]) * (rows::SCRATCH_ROWS + 3));
        let (line, rest) = cut::<f64>(scratch, extent[2]);
        let (up, rest) = cut::<f64>(rest, extent[2]);
        let (counts, rest) = cut::<f64>(rest, extent[2]);
        for c in 0..self.shape[0] * self.shape[1] {
            let at = RowOf::new(c, self.shape, extent, halve);
            let mask = mask_of(src.needed, &at);
            let done = mask != Mask::Mixed && self.first_direct(*level, c, &src, &at, halve[2], [line, up, counts]);
            if !done {
                let mut children = Children::new(rest, at.n, extent[2]);
                load_voxels(*level, &mut children, kind, std, &src, &at);
                self.merge(*level, c, &mut children, halve[2], true);
            } else if mask == Mask::Excluded {
                self.marks(c).iter_mut().for_each(|m| *m = -*m);
            }
        }
    }

    /// Row `c` the fast way, where no voxel is NaN and the mask is uniform. False if it must be made the general way.
    fn first_direct(
        &mut self,
        level: Level,
        c: usize,
        src: &Level0,
        at: &RowOf,
        halve_x: bool,
        [line, up, counts]: [&mut [f64]; 3],
    ) -> bool {
        let n = self.shape[2];
        let row = c * n..(c + 1) * n;
        if self.kind != Reduce::Moments {
            return with_view!(AnyView, src.value, v => {
                let picked = at.map(|[z, y]| v.row_at(z, y));
                rows::direct(level, self.kind, &picked[..at.n], halve_x, line, &mut self.value[row])
            });
        }
        let counts = &mut counts[..n];
        self.implied([c / self.shape[1], c % self.shape[1]], counts);
        let out = [&mut self.value, &mut self.inner, &mut self.between].map(|v| &mut v[row.clone()]);
        macro_rules! rows_of {
            ($variance:expr, $mean:expr) => {{
                let variance = at.map(|[z, y]| $variance.row_at(z, y));
                let mean = at.map(|[z, y]| $mean.row_at(z, y));
                rows::moments(level, &variance[..at.n], &mean[..at.n], self.std, halve_x, counts, [line, up], out)
            }};
        }
        match (src.value, src.mean) {
            (AnyView::F32(v), Some(AnyView::F32(m))) => rows_of!(v, m),
            (AnyView::F32(v), Some(AnyView::F64(m))) => rows_of!(v, m),
            (AnyView::F64(v), Some(AnyView::F64(m))) => rows_of!(v, m),
            _ => false,
        }
    }

    /// Makes the next level above `fine`, halving the axes named.
    pub fn next_from(&mut self, fine: &Cells, halve: [bool; 3], cx: &mut Context) {
        let factor = std::array::from_fn(|a| fine.factor[a] << usize::from(halve[a]));
        self.prepare(fine.kind, fine.std, factor, fine.extent);
        let Context { level, scratch } = cx;
        let width = fine.shape[2];
        let scratch = scratch.take(padded::<f64>(width) * (rows::SCRATCH_ROWS + 1));
        let (line, rest) = cut::<f64>(scratch, width);
        for c in 0..self.shape[0] * self.shape[1] {
            let at = RowOf::new(c, self.shape, fine.shape, halve);
            let n = self.shape[2];
            let source = at.map(|[z, y]| (z * fine.shape[1] + y) * width);
            if fine.mark.is_empty() {
                let picked = source.map(|s| &fine.value[s..s + width]);
                let out = &mut self.value[c * n..(c + 1) * n];
                if rows::direct(*level, fine.kind, &picked[..at.n], halve[2], line, out) {
                    continue;
                }
            }
            let mut children = Children::new(rest, at.n, width);
            for (r, &s) in source[..at.n].iter().enumerate() {
                let [value, mark, inner, between] = children.row(r);
                value.copy_from_slice(&fine.value[s..s + width]);
                if fine.mark.is_empty() {
                    fine.implied(at.ids[r], mark);
                } else {
                    mark.copy_from_slice(&fine.mark[s..s + width]);
                }
                if fine.kind == Reduce::Moments {
                    inner.copy_from_slice(&fine.inner[s..s + width]);
                    between.copy_from_slice(&fine.between[s..s + width]);
                }
            }
            self.merge(*level, c, &mut children, halve[2], false);
        }
    }

    /// The general way: row `c` of cells from any children.
    fn merge(&mut self, level: Level, c: usize, children: &mut Children, halve_x: bool, single: bool) {
        let n = self.shape[2];
        self.marks(c);
        let row = c * n..(c + 1) * n;
        let moments = if self.kind == Reduce::Moments { row.clone() } else { 0..0 };
        rows::merge(
            level,
            self.kind,
            children,
            halve_x,
            single,
            &mut self.value[row.clone()],
            &mut self.mark[row],
            &mut self.inner[moments.clone()],
            &mut self.between[moments],
        );
    }

    /// The marks of row `c`, spelled out if they were implied.
    fn marks(&mut self, c: usize) -> &mut [f64] {
        let n = self.shape[2];
        if self.mark.is_empty() {
            let mut mark = std::mem::take(&mut self.mark);
            mark.resize(self.value.len(), 0.0);
            for row in 0..self.shape[0] * self.shape[1] {
                self.implied([row / self.shape[1], row % self.shape[1]], &mut mark[row * n..(row + 1) * n]);
            }
            self.mark = mark;
        }
        &mut self.mark[c * n..(c + 1) * n]
    }

    /// Level-0 voxels along `axis` in cell `i`.
    fn along(&self, axis: usize, i: usize) -> usize {
        self.factor[axis].min(self.extent[axis] - i * self.factor[axis])
    }

    /// Level-0 voxels of each cell of row `[z, y]`.
    fn implied(&self, [z, y]: [usize; 2], out: &mut [f64]) {
        let Some(last) = out.len().checked_sub(1) else { return };
        let rows = self.along(0, z) * self.along(1, y);
        out.fill((rows * self.factor[2]) as f64);
        out[last] = (rows * self.along(2, last)) as f64;
    }

    /// Copies the cells of a part, of the same kind and factor, to cell index `at`. Panics if it sticks out.
    pub fn paste(&mut self, part: &Cells, at: [usize; 3]) {
        assert_eq!((part.kind, part.std, part.factor), (self.kind, self.std, self.factor), "parts are alike");
        assert!((0..3).all(|a| at[a] + part.shape[a] <= self.shape[a]), "{at:?} + {:?} sticks out", part.shape);
        if !part.mark.is_empty() && !part.value.is_empty() {
            self.marks(0);
        }
        let n = part.shape[2];
        for (c, from) in (0..part.shape[0] * part.shape[1]).map(|c| (c, c * n..(c + 1) * n)) {
            let id = [c / part.shape[1], c % part.shape[1]];
            let start = ((at[0] + id[0]) * self.shape[1] + at[1] + id[1]) * self.shape[2] + at[2];
            let to = start..start + n;
            self.value[to.clone()].copy_from_slice(&part.value[from.clone()]);
            if !self.mark.is_empty() {
                match part.mark.is_empty() {
                    true => part.implied(id, &mut self.mark[to.clone()]),
                    false => self.mark[to.clone()].copy_from_slice(&part.mark[from.clone()]),
                }
            }
            if self.kind == Reduce::Moments {
                self.inner[to.clone()].copy_from_slice(&part.inner[from.clone()]);
                self.between[to].copy_from_slice(&part.between[from]);
            }
        }
    }

    /// Appends the cells as plain numbers, plane by plane (value, mark and, for Moments, inner, between): [`planes`] times
    /// the number of cells.
    pub fn store(&self, out: &mut Vec<f64>) {
        out.extend_from_slice(&self.value);
        if self.mark.is_empty() {
            let (start, n) = (out.len(), self.shape[2]);
            out.resize(start + self.value.len(), 0.0);
            for c in 0..self.shape[0] * self.shape[1] {
                let row = start + c * n;
                self.implied([c / self.shape[1], c % self.shape[1]], &mut out[row..row + n]);
            }
        } else {
            out.extend_from_slice(&self.mark);
        }
        out.extend_from_slice(&self.inner);
        out.extend_from_slice(&self.between);
    }

    /// Takes back what [`Cells::store`] wrote for the same arguments. Panics if the length is another.
    pub fn load(&mut self, kind: Reduce, std: bool, factor: [usize; 3], extent: Shape, data: &[f64]) {
        self.prepare(kind, std, factor, extent);
        let n = self.value.len();
        assert_eq!(data.len(), n * planes(kind), "numbers for {n} cells of {kind:?}");
        if n == 0 {
            return;
        }
        self.value.copy_from_slice(&data[..n]);
        let marks = &data[n..2 * n];
        self.marks(0);
        // Implied marks stay implied: the levels above are then made the fast way.
        if self.mark.iter().zip(marks).all(|(a, b)| a.to_bits() == b.to_bits()) {
            self.mark.clear();
        } else {
            self.mark.copy_from_slice(marks);
        }
        if kind == Reduce::Moments {
            self.inner.copy_from_slice(&data[2 * n..3 * n]);
            self.between.copy_from_slice(&data[3 * n..]);
        }
    }

    /// Valid voxels that entered cell `index` (Min, Max, Stride: not counted, so what its place implies).
    pub fn count(&self, [z, y, x]: [usize; 3]) -> f64 {
        match self.mark.is_empty() {
            true => (self.along(0, z) * self.along(1, y) * self.along(2, x)) as f64,
            false => self.mark[(z * self.shape[1] + y) * self.shape[2] + x].abs(),
        }
    }

    /// The value of cell `index`, unrounded; NaN where no voxel is valid.
    pub fn at(&self, index: [usize; 3]) -> f64 {
        let i = (index[0] * self.shape[1] + index[1]) * self.shape[2] + index[2];
        let n = self.count(index);
        let variance = || self.inner[i] / n + self.between[i] / n;
        match self.kind {
            Reduce::Mean => self.value[i] / n,
            Reduce::Moments if self.std => rows::signed_root(variance()),
            Reduce::Moments => variance(),
            Reduce::Min | Reduce::Max | Reduce::Stride => self.value[i],
        }
    }

    /// Writes the box of cells that starts at `lo` and has the shape of `dst`, rounded once, by `mapping`. Panics if it
    /// sticks out.
    pub fn write(&self, lo: [usize; 3], mapping: Mapping, mut dst: AnyViewMut, cx: &mut Context) {
        let shape = dst.shape();
        assert!((0..3).all(|a| lo[a] + shape[a] <= self.shape[a]), "{lo:?} + {shape:?} sticks out of {:?}", self.shape);
        let width = shape[2];
        if shape.contains(&0) {
            return;
        }
        let scratch = cx.scratch.take(padded::<f64>(self.shape[2]) + padded::<f64>(width));
        let (counts, rest) = cut::<f64>(scratch, self.shape[2]);
        let (line, _) = cut::<f64>(rest, width);
        for (z, y) in (0..shape[0]).flat_map(|z| (0..shape[1]).map(move |y| (z, y))) {
            let id = [lo[0] + z, lo[1] + y];
            let start = (id[0] * self.shape[1] + id[1]) * self.shape[2] + lo[2];
            let row = start..start + width;
            let count = match self.mark.is_empty() {
                true => {
                    self.implied(id, counts);
                    &counts[lo[2]..lo[2] + width]
                }
                false => &self.mark[row.clone()],
            };
            let moments = if self.kind == Reduce::Moments { row.clone() } else { 0..0 };
            let (inner, between) = (&self.inner[moments.clone()], &self.between[moments]);
            rows::values(cx.level, self.kind, self.std, &self.value[row], count, inner, between, line);
            with_view!(AnyViewMut, &mut dst, d => convert_row(cx.level, line, mapping, d.row_at(z, y)));
        }
    }
}

/// The up to four rows of the finer level that a row of cells covers, in merging order.
struct RowOf {
    ids: [[usize; 2]; 4],
    n: usize,
}

impl RowOf {
    fn new(c: usize, shape: Shape, fine: Shape, halve: [bool; 3]) -> RowOf {
        let cell = [c / shape[1], c % shape[1]];
        let span = |a: usize| {
            let lo = cell[a] << usize::from(halve[a]);
            lo..(lo + 1 + usize::from(halve[a])).min(fine[a])
        };
        // Entries beyond `n` repeat the first row, so that they are valid indices.
        let mut rows = RowOf { ids: [[span(0).start, span(1).start]; 4], n: 0 };
        for z in span(0) {
            for y in span(1) {
                rows.ids[rows.n] = [z, y];
                rows.n += 1;
            }
        }
        rows
    }

    fn map<T>(&self, f: impl FnMut([usize; 2]) -> T) -> [T; 4] {
        self.ids.map(f)
    }
}

fn mask_of(needed: Option<View<u8>>, at: &RowOf) -> Mask {
    let Some(needed) = needed else { return Mask::Needed };
    let (mut any, mut all) = (false, true);
    for [z, y] in &at.ids[..at.n] {
        let row = needed.row_at(*z, *y);
        any |= row.iter().fold(0, |a, m| a | m) != 0;
        all &= row.iter().fold(true, |a, m| a & (*m != 0));
    }
    match (any, all) {
        (_, true) => Mask::Needed,
        (false, _) => Mask::Excluded,
        _ => Mask::Mixed,
    }
}

/// Voxels as children: one voxel each, no deviation of its own mean.
fn load_voxels(level: Level, children: &mut Children, kind: Reduce, std: bool, src: &Level0, at: &RowOf) {
    for (r, &[z, y]) in at.ids[..at.n].iter().enumerate() {
        let [value, mark, inner, between] = children.row(r);
        if let (Reduce::Moments, Some(mean)) = (kind, src.mean) {
            with_view!(AnyView, src.value, v => rows::widen(level, v.row_at(z, y), inner));
            with_view!(AnyView, mean, v => rows::widen(level, v.row_at(z, y), value));
            between.fill(0.0);
            if std {
                inner.iter_mut().for_each(|v| *v = rows::signed_square(*v));
            }
        } else {
            with_view!(AnyView, src.value, v => rows::widen(level, v.row_at(z, y), value));
        }
        match src.needed {
            Some(needed) => rows::marks(level, needed.row_at(z, y), mark),
            None => mark.fill(1.0),
        }
        rows::drop_invalid(level, kind, value, mark, inner);
    }
}
