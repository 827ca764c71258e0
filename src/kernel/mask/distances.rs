//! Squared distances from the voxels of a tile to crossings: walks along the axes, spread over the others.

use super::lines::{find, lower, square_of, step, walk_row};
use crate::brick::scratch::{cut, padded};
use crate::grid::{Shape, ViewMut};
use crate::kernel::simd::Level;
use crate::multiversion;

/// A box of outputs in the box that it sees.
pub(super) struct Tile {
    pub seen: Shape,
    pub out: Shape,
    /// First output voxel.
    pub at: [usize; 3],
}

impl Tile {
    pub fn rows(&self) -> usize {
        self.out[0] * self.out[1]
    }

    /// What the rows about output row (or plane) `i` within `steps` are.
    #[inline(always)]
    fn about(&self, axis: usize, i: usize, steps: usize) -> std::ops::Range<usize> {
        let centre = self.at[axis] + i;
        centre.saturating_sub(steps)..centre.saturating_add(steps).saturating_add(1).min(self.seen[axis])
    }
}

/// Distances, all infinite where nothing is near. Planes and rows of what a tile sees lie densely.
pub(super) struct Work<'s> {
    /// Values of two neighbouring planes.
    values: [&'s mut [f64]; 2],
    /// Of every voxel of a plane to the last crossing of its column; planes ago that was, by row (see [`step`]).
    column: &'s mut [f64],
    age: &'s mut [u32],
    /// The same along y for one row.
    line: &'s mut [f64],
    /// Rows of squared distances along an axis, and which of them hold any.
    squares: &'s mut [f64],
    rows: &'s mut [u8],
    /// Such a row after they spread along y.
    spread: &'s mut [f64],
    /// Least and largest place of a crossing on the edges of a row.
    edges: [&'s mut [f64]; 2],
    /// Squared distances in their plane to crossings along x and y, for output columns of all planes, and whether a row has any.
    planes: &'s mut [f64],
    live: &'s mut [u8],
    /// Squared distances of the outputs.
    near: &'s mut [f64],
}

impl<'s> Work<'s> {
    pub fn bytes(tile: &Tile) -> usize {
        let ([sz, sy, sx], [tz, ty, tx]) = (tile.seen, tile.out);
        let plane = padded::<f64>(sy * sx);
        4 * plane
            + 4 * padded::<f64>(sx)
            + padded::<u32>(sy)
            + padded::<u8>(sy)
            + padded::<f64>(sz * ty * tx)
            + padded::<u8>(sz * ty)
            + padded::<f64>(tz * ty * tx)
    }

    pub fn cut(bytes: &'s mut [u8], tile: &Tile) -> Work<'s> {
        let ([sz, sy, sx], [tz, ty, tx]) = (tile.seen, tile.out);
        let (first, bytes) = cut::<f64>(bytes, sy * sx);
        let (second, bytes) = cut::<f64>(bytes, sy * sx);
        let (column, bytes) = cut::<f64>(bytes, sy * sx);
        let (squares, bytes) = cut::<f64>(bytes, sy * sx);
        let (spread, bytes) = cut::<f64>(bytes, sx);
        let (line, bytes) = cut::<f64>(bytes, sx);
        let (least, bytes) = cut::<f64>(bytes, sx);
        let (most, bytes) = cut::<f64>(bytes, sx);
        let (age, bytes) = cut::<u32>(bytes, sy);
        let (rows, bytes) = cut::<u8>(bytes, sy);
        let (planes, bytes) = cut::<f64>(bytes, sz * ty * tx);
        let (live, bytes) = cut::<u8>(bytes, sz * ty);
        let (near, _) = cut::<f64>(bytes, tz * ty * tx);
        Work {
            values: [first, second],
            column,
            age,
            line,
            squares,
            rows,
            spread,
            edges: [least, most],
            planes,
            live,
            near,
        }
    }
}

/// How a tile's distances are measured.
#[derive(Clone, Copy)]
pub(super) struct Measure {
    /// Length of a voxel per axis, in voxels of the finest.
    pub unit: [f64; 3],
    /// Voxels that the band may reach.
    pub steps: [usize; 3],
    /// Largest squared distance.
    pub limit: f64,
}

impl Work<'_> {
    /// Marks what lies within the band around surfaces of these values; `load` gives the values of a plane that the tile sees.
    pub fn mark(
        mut self,
        level: Level,
        iso: &[f64],
        load: &dyn Fn(usize, &mut [f64]),
        tile: &Tile,
        measure: &Measure,
        mut dst: ViewMut<u8>,
    ) {
        self.planes.fill(f64::INFINITY);
        self.live.fill(0);
        self.near.fill(f64::INFINITY);
        for up in [true, false] {
            self.column.fill(f64::INFINITY);
            self.age.fill(u32::MAX);
            for i in 0..tile.seen[0] {
                let z = if up { i } else { tile.seen[0] - 1 - i };
                let out = z.wrapping_sub(tile.at[0]);
                if !up && z < tile.at[0] {
                    break;
                }
                self.values.swap(0, 1);
                load(z, self.values[0]);
                if i > 0 {
                    walk_columns(level, &mut self, iso, tile, measure, up);
                }
                if out < tile.out[0] {
                    spread_columns(level, &mut self, tile, measure, out);
                }
                if up {
                    along_x(level, &mut self, iso, tile, measure, z);
                    along_y(level, &mut self, iso, tile, measure, z);
                }
            }
        }
        finish(level, &mut self, tile, measure, &mut dst);
    }
}

multiversion! { fn walk_columns['w](work: &mut Work<'w>, iso: &[f64], tile: &Tile, measure: &Measure, up: bool) -> () = walk_columns_inner; }
multiversion! { fn spread_columns['w](work: &mut Work<'w>, tile: &Tile, measure: &Measure, z: usize) -> () = spread_columns_inner; }
multiversion! { fn along_x['w](work: &mut Work<'w>, iso: &[f64], tile: &Tile, measure: &Measure, z: usize) -> () = along_x_inner; }
multiversion! { fn along_y['w](work: &mut Work<'w>, iso: &[f64], tile: &Tile, measure: &Measure, z: usize) -> () = along_y_inner; }
multiversion! { fn finish['w, 'd](work: &mut Work<'w>, tile: &Tile, measure: &Measure, dst: &mut ViewMut<'d, u8>) -> () = finish_inner; }

/// Moves the distances to the last crossing of every column on by one plane, up or down.
#[inline(always)]
fn walk_columns_inner(work: &mut Work, iso: &[f64], tile: &Tile, measure: &Measure, up: bool) {
    let Work { values: [here, before], column, age, edges, .. } = work;
    let n = tile.seen[2];
    for (y, age) in age.iter_mut().enumerate() {
        let row = y * n..(y + 1) * n;
        let (here, before) = (&here[row.clone()], &before[row.clone()]);
        let crossed = if up { find(before, here, iso, edges) } else { find(here, before, iso, edges) };
        step(&mut column[row], edges, crossed, age, measure.steps[0], up);
    }
}

/// Spreads the distances of a plane along y and x to output plane `z`.
#[inline(always)]
fn spread_columns_inner(work: &mut Work, tile: &Tile, measure: &Measure, z: usize) {
    let Work { column, age, squares, spread, near, .. } = work;
    let (n, [_, ty, tx]) = (tile.seen[2], tile.out);
    for (y, age) in age.iter().enumerate() {
        if *age as usize <= measure.steps[0] {
            let row = y * n..(y + 1) * n;
            square_of(&mut squares[row.clone()], &column[row], measure.unit[0]);
        }
    }
    let spread = &mut spread[..n];
    for y in 0..ty {
        let mut any = false;
        for from in tile.about(1, y, measure.steps[1]) {
            if age[from] as usize <= measure.steps[0] {
                if !any {
                    spread.fill(f64::INFINITY);
                    any = true;
                }
                lower(spread, &squares[from * n..][..n], measure.square(1, from.abs_diff(tile.at[1] + y)));
            }
        }
        if any {
            widen(&mut near[(z * ty + y) * tx..][..tx], spread, tile, measure);
        }
    }
}

/// Distances of the rows of plane `z` to crossings along them, spread along y.
#[inline(always)]
fn along_x_inner(work: &mut Work, iso: &[f64], tile: &Tile, measure: &Measure, z: usize) {
    let Work { values: [here, _], squares, rows, line, edges, planes, live, .. } = work;
    let (n, [_, ty, tx]) = (tile.seen[2], tile.out);
    for (y, found) in rows.iter_mut().enumerate() {
        let row = &here[y * n..][..n];
        *found = u8::from(find(&row[..n - 1], &row[1..], iso, edges));
        if *found == 0 {
            continue;
        }
        walk_row(&mut line[..n], edges, measure.steps[2]);
        square_of(&mut squares[y * n..][..tx], &line[tile.at[2]..], measure.unit[2]);
    }
    for y in 0..ty {
        for from in tile.about(1, y, measure.steps[1]) {
            if rows[from] != 0 {
                live[z * ty + y] = 1;
                let add = measure.square(1, from.abs_diff(tile.at[1] + y));
                lower(&mut planes[(z * ty + y) * tx..][..tx], &squares[from * n..][..tx], add);
            }
        }
    }
}

/// Distances of the output rows of plane `z` to crossings along y, spread along x.
#[inline(always)]
fn along_y_inner(work: &mut Work, iso: &[f64], tile: &Tile, measure: &Measure, z: usize) {
    let Work { values: [here, _], squares, rows, line, edges, planes, live, .. } = work;
    let ([_, sy, n], [_, ty, tx]) = (tile.seen, tile.out);
    rows.fill(0);
    for up in [true, false] {
        line.fill(f64::INFINITY);
        let mut age = u32::MAX;
        for i in 0..sy {
            let y = if up { i } else { sy - 1 - i };
            if i > 0 {
                let lower = if up { y - 1 } else { y };
                let crossed = find(&here[lower * n..][..n], &here[(lower + 1) * n..][..n], iso, edges);
                step(line, edges, crossed, &mut age, measure.steps[1], up);
            }
            let out = y.wrapping_sub(tile.at[1]);
            if out >= ty || age as usize > measure.steps[1] {
                continue;
            }
            let kept = &mut squares[out * n..][..n];
            if rows[out] == 0 {
                kept.copy_from_slice(line);
                rows[out] = 1;
            } else {
                lower(kept, line, 0.0);
            }
        }
    }
    for y in 0..ty {
        if rows[y] != 0 {
            live[z * ty + y] = 1;
            let row = &mut squares[y * n..][..n];
            for d in row.iter_mut() {
                *d = (*d * measure.unit[1]) * (*d * measure.unit[1]);
            }
            widen(&mut planes[(z * ty + y) * tx..][..tx], row, tile, measure);
        }
    }
}

/// Spreads what the planes hold along z, and marks what is near.
#[inline(always)]
fn finish_inner(work: &mut Work, tile: &Tile, measure: &Measure, dst: &mut ViewMut<u8>) {
    let Work { planes, live, near, .. } = work;
    let [tz, ty, tx] = tile.out;
    for z in 0..tz {
        for y in 0..ty {
            let near = &mut near[(z * ty + y) * tx..][..tx];
            for from in tile.about(0, z, measure.steps[0]) {
                if live[from * ty + y] != 0 {
                    let add = measure.square(0, from.abs_diff(tile.at[0] + z));
                    lower(near, &planes[(from * ty + y) * tx..][..tx], add);
                }
            }
            for (d, near) in dst.row_at(z, y).iter_mut().zip(&*near) {
                *d = u8::from(*near <= measure.limit);
            }
        }
    }
}

/// Lowers an output row to what squared distances of a row that the tile sees become along x.
#[inline(always)]
fn widen(row: &mut [f64], from: &[f64], tile: &Tile, measure: &Measure) {
    let (at, steps) = (tile.at[2], measure.steps[2]);
    // Output voxel x lowers to seen voxel x + first.
    for first in at.saturating_sub(steps)..=at.saturating_add(steps).min(from.len() - 1) {
        lower(row, &from[first..], measure.square(2, first.abs_diff(at)));
    }
    // Voxels before the first one that is seen do not exist, but later outputs still look back that far.
    for back in at + 1..=steps.min(at + row.len() - 1) {
        lower(&mut row[back - at..], from, measure.square(2, back));
    }
}

impl Measure {
    /// Squared length of that many voxels along an axis.
    #[inline(always)]
    fn square(&self, axis: usize, voxels: usize) -> f64 {
        let length = voxels as f64 * self.unit[axis];
        length * length
    }
}
