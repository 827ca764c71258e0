//! Which moments a set of channels needs, how a call is cut into tiles, and how its scratch is laid out.

use super::Place;
use super::extremes::DEEP;
use super::lines::Lines;
use super::parts::{Axis, BLOCK};
use crate::brick::scratch;
use crate::grid::{DType, Shape, View, Voxel};
use crate::kernel::simd::fetch;
use crate::stage::{Method, WindowChannel, WindowParams};

/// Moments to compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Needs {
    pub extremes: bool,
    pub mean: bool,
    pub variance: bool,
    /// The input is a float type.
    pub float: bool,
}

impl Needs {
    /// For integers an exact variance of zero says that a window is constant; floats ask the extremes.
    pub fn of(channels: impl Iterator<Item = WindowChannel>, float: bool) -> Needs {
        let mut needs = Needs { extremes: false, mean: false, variance: false, float };
        for channel in channels {
            match channel {
                WindowChannel::Mean => needs.mean = true,
                WindowChannel::Min | WindowChannel::Max => needs.extremes = true,
                WindowChannel::Variance | WindowChannel::Std | WindowChannel::Moment2 => {
                    (needs.mean, needs.variance) = (true, true)
                }
                WindowChannel::Openness(Method::Exact | Method::Levels | Method::Moments4, _) => {
                    panic!("these methods have kernels of their own")
                }
                WindowChannel::Openness(Method::CdfPower, _) => (needs.extremes, needs.mean) = (true, true),
                WindowChannel::Openness(Method::Beta, _) => {
                    (needs.extremes, needs.mean, needs.variance) = (true, true, true)
                }
                WindowChannel::Openness(..) => {
                    (needs.mean, needs.variance) = (true, true);
                    needs.extremes |= float;
                }
            }
        }
        needs
    }
}

/// One call: shapes, windows and tiles. All `[z, y, x]`.
#[derive(Debug, Clone, Copy)]
pub struct Job {
    pub src: Shape,
    pub dst: Shape,
    /// Voxel of `src` at the first output. For floats outputs are counted from a start of blocks, at most 7 in front of the
    /// first one asked for: [`Job::skip`] of them do not exist.
    pub at: [isize; 3],
    pub skip: [usize; 3],
    /// Radius, at most the extent of `src` less one: there a larger one changes no window, and bricks cannot disagree,
    /// since a radius beyond that makes every brick's `src` the whole axis.
    pub radius: [usize; 3],
    /// `2 radius + 1`.
    pub window: [usize; 3],
    pub needs: Needs,
    /// Output rows and columns of a tile.
    pub tile: [usize; 2],
    /// Output planes that go through z together, a multiple of `block`.
    pub batch: usize,
    /// Output planes whose extremes are made together.
    pub block: usize,
    /// Output rows that go through y together, a multiple of `row_block`, the rows whose extremes are made together.
    pub rows: usize,
    pub row_block: usize,
    /// Elements from row to row of tile buffers.
    pub pitch: usize,
    /// The same where only columns that exist are kept.
    pub narrow: usize,
    /// Rows of tile buffers.
    pub height: usize,
}

impl Job {
    /// `moments` is the bytes per voxel of the planes that a batch keeps.
    pub fn new(src: Shape, dst: Shape, place: Place, params: &WindowParams, needs: Needs, moments: usize) -> Job {
        let radius: [usize; 3] = std::array::from_fn(|a| params.radius[a].min(src[a].saturating_sub(1)));
        let window = radius.map(|r| 2 * r + 1);
        let at = place.at.map(|v| v as isize);
        if needs.float {
            return Job { at, ..Job::blocks(src, dst, radius, needs, moments) }.skipping(place.phase);
        }
        let width = even(dst[2], MAX_WIDTH);
        let pitch = odd_lines(width + 2 * radius[2]);
        let narrow = odd_lines((width + 2 * radius[2]).min(src[2]));
        let planes = block(window[0], dst[0]);
        // Each batch reads the groups of extremes anew, so long windows want deep batches.
        let deep = if window[0] < DEEP { 1 } else { 4 };
        let batch = planes * deep.min(dst[0].div_ceil(planes));
        let rows = (TILE_BYTES / (pitch * moments * batch)).saturating_sub(2 * radius[1]);
        let tall = if window[1] < DEEP { 2 } else { TALL };
        let rows = rows.max(MIN_ROWS).max((tall * radius[1]).min(MOST_TALL)).max(2 * radius[1]);
        let tile = [even(dst[1], rows).next_multiple_of(ROWS).min(dst[1]), width];
        let height = tile[0] + 2 * radius[1];
        let row_block = block(window[1], tile[0]);
        let rows = if window[1] < DEEP { ROWS } else { row_block * LONG_ROWS.min(tile[0].div_ceil(row_block)) };
        let (skip, block) = ([0; 3], planes);
        Job { src, dst, at, skip, radius, window, needs, tile, batch, block, rows, row_block, pitch, narrow, height }
    }

    /// Float windows come in blocks of eight that start at multiples of eight of the volume, and so do tiles and batches.
    /// All sizes hold for any place.
    fn blocks(src: Shape, dst: Shape, radius: [usize; 3], needs: Needs, moments: usize) -> Job {
        let window = radius.map(|r| 2 * r + 1);
        let most = dst.map(|n| (n + BLOCK - 1).next_multiple_of(BLOCK));
        let tiles = dst[2].div_ceil(MAX_WIDTH).max(1);
        let width = (dst[2] + BLOCK - 1).div_ceil(tiles).next_multiple_of(BLOCK);
        let pitch = odd_lines(width + 2 * radius[2]);
        // Vectors start at multiples of eight of the tile.
        let narrow = odd_lines((width + 2 * radius[2]).min(src[2] + 2 * (BLOCK - 1)));
        // Groups along z are made anew by each batch.
        let batch = most[0].min(BLOCK * if window[0] < DEEP { 1 } else { 4 });
        let rows = (FLOAT_TILE_BYTES / (pitch * moments * batch)).saturating_sub(2 * radius[1]).max(FLOAT_MIN_ROWS);
        let tile = [most[1].min(rows.max(2 * radius[1]).next_multiple_of(BLOCK)), width];
        let height = tile[0] + 2 * radius[1];
        let (planes, row_block) = (block(window[0], batch), block(window[1], tile[0]));
        let rows = row_block * if window[1] < DEEP { 1 } else { LONG_ROWS.min(tile[0].div_ceil(row_block)) };
        let (at, skip, block) = ([0; 3], [0; 3], planes);
        Job { src, dst, at, skip, radius, window, needs, tile, batch, block, rows, row_block, pitch, narrow, height }
    }

    /// Starts `phase` outputs earlier.
    fn skipping(mut self, phase: [usize; 3]) -> Job {
        let (at, dst) = (self.at, self.dst);
        self.at = std::array::from_fn(|a| at[a] - phase[a] as isize);
        self.dst = std::array::from_fn(|a| dst[a] + phase[a]);
        Job { skip: phase, ..self }
    }

    /// Lines along axis `a` of windows of `blocks` blocks from output `start` on.
    pub fn axis(&self, a: usize, start: usize, blocks: usize) -> Axis {
        let first = self.at[a] + start as isize - self.radius[a] as isize;
        Axis { first, extent: self.src[a], window: self.window[a], blocks }
    }

    /// Most voxels in a window, and in its z-y section.
    pub fn counts(&self) -> (u64, u64) {
        let n: [u64; 3] = std::array::from_fn(|a| self.window[a].min(self.src[a]) as u64);
        (n[0] * n[1] * n[2], n[0] * n[1])
    }

    /// Voxels of output index `i` of axis `a` that exist in its window.
    pub fn count(&self, a: usize, i: usize) -> usize {
        let (c, r) = (self.at[a] + i as isize, self.radius[a] as isize);
        ((c + r + 1).min(self.src[a] as isize) - (c - r).max(0)).max(0) as usize
    }

    /// Elements from row to row of finished windows.
    pub fn out_pitch(&self) -> usize {
        self.tile[1].next_multiple_of(64)
    }

    /// Columns of a tile with its halo, in whole vectors: what lies between them and the pitch is never read.
    pub fn columns(&self) -> usize {
        (self.tile[1] + self.window[2] - 1).next_multiple_of(32)
    }

    /// Elements of a tile plane.
    pub fn plane(&self) -> usize {
        self.height * self.pitch
    }

    /// Elements of a plane of extremes: columns that exist, and of integers only the rows that do.
    pub fn narrow_plane(&self) -> usize {
        self.narrow * if self.needs.float { self.height } else { self.height.min(self.src[1]) }
    }
}

/// Output rows of integers that go through x and the estimators together, so that few calls are made: a multiple of every
/// block.
pub const ROWS: usize = 8;
/// Blocks of rows whose extremes along y are made together where windows are long: their planes come from far, and groups of
/// rows are read once. 2-core Zen 4 VM, AVX-512, 2026-11-27, min and max of u16, r=64, 256 x 256 planes: 5.8 ns per voxel with
/// 4 blocks, planes with columns that do not exist and trees along x; 3.6 with 16, planes without and doubling along x.
const LONG_ROWS: usize = 16;
/// Widest tile in x. 2-core Zen 4 VM, AVX-512, 2026-11-27, planes of 640 x 640, ns per voxel with two tiles of 320 and one of
/// 640: r=10, variance u16 2.82, 1.95; four moments u8 3.51, 2.53; cdf_power u16 2.33, 2.10; r=64, cdf_power u16 7.1, 4.6.
/// Floats with three tiles of 256 and one: variance f32, r=10, 7.9, 6.7; cdf_power f32, r=64, 17.9, 11.5.
const MAX_WIDTH: usize = 768;
/// Fewest rows of a tile (if there are as many). Planes of 640 x 640, cdf_power u16, r=10 as above: 2.10 with 38, 2.04 with 64.
const MIN_ROWS: usize = 64;
/// The same for floats, whose tiles keep the rows of the tile above.
const FLOAT_MIN_ROWS: usize = 32;
/// Rows of a tile in radii where windows are long, for at most so many rows: its halo of two radii goes through z as well.
/// 2-core Zen 4 VM, AVX-512, 2026-11-27, r=64, u16, ns per voxel with 2 and 4 radii: min and max of 256 x 256 planes 2.96, 2.66;
/// cdf_power of 640 x 640 planes 5.3, 4.6.
const TALL: usize = 4;
const MOST_TALL: usize = 256;
/// Bytes of batch planes to aim at. They share a 1 MiB L2 with the raw planes, but low tiles make many rows twice, and what
/// spills is read in order. 2-core Zen 4 VM, AVX-512, 2026-11-27, r=10, ns/voxel with 640 KiB, 1280 KiB and 2 MiB:
/// cdf_power u16 2.11, 1.98, 1.99; chebyshev u16 1.99, 1.84, 1.87; four moments u8 2.65, 2.50, 2.57.
const TILE_BYTES: usize = 1280 << 10;
/// The same for floats: 2-core Zen 4 VM, AVX-512, 2026-11-23, busy machine, cdf_power f32 11.7 with 640 KiB, 12.2 with 200 kB,
/// 13.2 with 1.3 MB.
const FLOAT_TILE_BYTES: usize = 640 << 10;

/// Parts as even as can be of at most `most`.
fn even(n: usize, most: usize) -> usize {
    n.div_ceil(n.div_ceil(most).max(1)).max(1)
}

/// The lines of one buffer row that a batch reads along z, copied side by side: planes lie a power of two apart in many
/// volumes, and then few cache sets hold all of a column. 256 x 256 planes of u8 and u16 ran as fast in place (2-core Zen 4
/// VM, AVX-512, 2026-11-23, cdf_power r=10); for floats, which stage in [`super::float`], it pays.
pub struct Stage {
    /// Planes of `src`, half-open.
    planes: (usize, usize),
    first: isize,
    pitch: usize,
}

impl Stage {
    /// For the batch that starts at output plane `z0`.
    pub fn new(job: &Job, size: usize, z0: usize) -> Stage {
        let first = job.at[0] + z0 as isize - job.radius[0] as isize;
        let end = (first + (job.batch + job.window[0] - 1) as isize).min(job.src[0] as isize);
        Stage { planes: (first.max(0) as usize, end as usize), first, pitch: Self::pitch(job, size) }
    }

    /// An odd number of cache lines.
    fn pitch(job: &Job, size: usize) -> usize {
        (((job.tile[1] + 2 * job.radius[2]) * size).div_ceil(64) | 1) * 64 / size
    }

    /// Elements of the buffer: none for windows so long that they are read in place.
    pub fn len(job: &Job, size: usize) -> usize {
        if job.window[0] < DEEP { (job.batch + job.window[0] - 1).min(job.src[0]) * Self::pitch(job, size) } else { 0 }
    }

    /// Copies the lines of buffer row `j` into `buffer`, if it holds them, and says where to read them.
    pub fn fill<'a, T: Voxel>(&self, tile: &Tile, src: View<'a, T>, j: usize, buffer: &'a mut [T]) -> (&'a [T], Lines) {
        let (y, x) = (tile.rows.2 + j - tile.rows.0, tile.cols.2);
        if buffer.is_empty() {
            let clip = (0, src.shape[0] as isize);
            return (src.data, Lines { base: y * src.row + x, pitch: src.plane, first: self.first, clip });
        }
        let cols = tile.cols.1 - tile.cols.0;
        for (i, z) in (self.planes.0..self.planes.1).enumerate() {
            buffer[i * self.pitch..][..cols].copy_from_slice(&src.row_at(z, y)[x..x + cols]);
            fetch_below(src, [z, y, x], cols);
        }
        let clip = (0, (self.planes.1 - self.planes.0) as isize);
        (buffer, Lines { base: 0, pitch: self.pitch, first: self.first - self.planes.0 as isize, clip })
    }
}

/// A multiple of 64 elements, odd in 64s: power-of-two pitches would map a column to few cache sets.
fn odd_lines(n: usize) -> usize {
    (n.div_ceil(64) | 1) * 64
}

/// Outputs made together by `extremes::extremes`: 1, 4 or 8, at most the window.
fn block(window: usize, outputs: usize) -> usize {
    match window {
        ..4 => 1,
        4..8 => 4,
        _ if outputs <= 4 => 4,
        _ => 8,
    }
}

/// The part of a tile's buffer that `src` covers along an axis: buffer indices `lo..hi`, the first being `src` index
/// `first`. `start` is the tile's first output index and `len` the buffer's extent.
fn covered(job: &Job, axis: usize, start: usize, len: usize) -> (usize, usize, usize) {
    let begin = job.at[axis] + start as isize - job.radius[axis] as isize;
    let lo = (-begin).max(0) as usize;
    let hi = ((job.src[axis] as isize - begin).max(0) as usize).min(len);
    (lo, hi.max(lo), (begin + lo as isize) as usize)
}

/// Where a tile lies.
pub struct Tile {
    /// First output row and column.
    pub y: usize,
    pub x: usize,
    /// Output rows and columns.
    pub size: [usize; 2],
    /// Rows of the buffer that `src` covers, and the first of them in `src`; columns likewise.
    pub rows: (usize, usize, usize),
    pub cols: (usize, usize, usize),
}

impl Tile {
    pub fn new(job: &Job, y: usize, x: usize) -> Tile {
        let size = [job.tile[0].min(job.dst[1] - y), job.tile[1].min(job.dst[2] - x)];
        let rows = covered(job, 1, y, size[0] + 2 * job.radius[1]);
        let cols = covered(job, 2, x, size[1] + 2 * job.radius[2]);
        Tile { y, x, size, rows, cols }
    }

    /// Every tile of a call.
    pub fn all(job: &Job) -> impl Iterator<Item = Tile> + '_ {
        let ys = (0..job.dst[1]).step_by(job.tile[0]);
        ys.flat_map(move |y| (0..job.dst[2]).step_by(job.tile[1]).map(move |x| Tile::new(job, y, x)))
    }

    /// Columns that exist.
    pub fn columns(&self) -> usize {
        self.cols.1 - self.cols.0
    }

    /// Lines of windows along y from output row `j` of the tile on, in a plane of the rows and columns that exist.
    pub fn lines(&self, job: &Job, j: usize) -> Lines {
        let clip = (0, (self.rows.1 - self.rows.0) as isize);
        Lines { base: 0, pitch: job.narrow, first: j as isize - self.rows.0 as isize, clip }
    }

    /// Lines of windows along z from the first output on, at buffer row `j`.
    pub fn column<T>(&self, job: &Job, src: View<T>, j: usize) -> Lines {
        let base = (self.rows.2 + j - self.rows.0) * src.row + self.cols.2;
        let first = job.at[0] - job.radius[0] as isize;
        Lines { base, pitch: src.plane, first, clip: (0, src.shape[0] as isize) }
    }

    /// Part of buffer row `j` that `src` covers, as element indices of a plane.
    pub fn span(&self, job: &Job, j: usize) -> std::ops::Range<usize> {
        j * job.pitch + self.cols.0..j * job.pitch + self.cols.1
    }
}

/// Cuts `len` elements off the front of a scratch slice, as [`scratch::cut`] does, and leaves the rest in `bytes`.
pub fn cut<'a, T: bytemuck::Pod>(bytes: &mut &'a mut [u8], len: usize) -> &'a mut [T] {
    let (part, rest) = scratch::cut(std::mem::take(bytes), len);
    *bytes = rest;
    part
}

/// The elements from `from` on; none of an empty slice.
pub fn tail<T>(slice: &[T], from: usize) -> &[T] {
    &slice[from.min(slice.len())..]
}

/// Bytes per voxel of the moments of a batch of planes.
pub fn batch_bytes(dtype: DType, needs: Needs) -> usize {
    let size = dtype.size();
    let sums = if dtype.is_float() { 8 * needs.mean as usize + 8 * needs.variance as usize } else { 0 };
    (2 * size * needs.extremes as usize + sums).max(1)
}

/// The same numbers as another type of the same size. Panics if the sizes differ.
pub fn bits<T: bytemuck::Pod, U: bytemuck::Pod>(data: &[U]) -> &[T] {
    assert_eq!(size_of::<T>(), size_of::<U>(), "types of one size");
    bytemuck::cast_slice(data)
}

/// Asks for the `cols` voxels below those at `at`, which the next line of a tile reads: lines of far planes are too short for
/// the CPU to foresee. 2-core Zen 4 VM, AVX-512, 2026-11-26, cdf_power
/// r=10 in ns per voxel without and with: u8 1.93, 1.84; u16 2.54, 2.43; f32 5.9, 5.7 (its mean 4.06, 3.54).
pub fn fetch_below<T: Voxel>(src: View<T>, [z, y, x]: [usize; 3], cols: usize) {
    if y + 1 < src.shape[1] {
        fetch(&src.row_at(z, y + 1)[x..x + cols]);
    }
}
