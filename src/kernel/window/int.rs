//! Integer volumes: exact sums of unsigned codes, running along z and y, running or by a tree along x ([`super::slide`]).
//!
//! Widths (n voxels in a window, m in its z-y section, w along z; codes up to T, squares up to T^2): a sum type serves
//! an axis where the largest final value fits, since wrapped intermediate values cancel. [`run`] is instantiated per
//! type by [`dispatch`], which checks the bounds.

use super::emit::{Emit, IntRows};
use super::estimate::{self, Acc, Code, RowSum, Width};
use super::int_extremes::Extremes;
use super::lines::{Add, Coding, Op};
use super::plan::{Job, ROWS, Tile, cut};
use super::running::Sums;
use super::slide::Slide;
use crate::brick::scratch::padded;
use crate::grid::View;
use crate::kernel::simd::Level;

/// Sum types of the three axes for S1 and S2 (`go!(T, Z1, Y1, X1, Z2, Y2, X2, ..)`), the narrowest that fit.
macro_rules! with_widths {
    (u8, $job:expr, $go:ident!($($rest:tt)*)) => {{
        let fits = Fits::of::<u8>($job);
        if !fits.narrow {
            $go!(u8, u64, u64, u64, u64, u64, u64, $($rest)*)
        } else if fits.squares {
            $go!(u8, u16, u32, u32, u32, u32, u32, $($rest)*)
        } else {
            $go!(u8, u16, u32, u32, u32, u32, u64, $($rest)*)
        }
    }};
    (u16, $job:expr, $go:ident!($($rest:tt)*)) => {{
        let fits = Fits::of::<u16>($job);
        if fits.window {
            $go!(u16, u32, u32, u32, u64, u64, u64, $($rest)*)
        } else if fits.section {
            $go!(u16, u32, u32, u64, u64, u64, u64, $($rest)*)
        } else {
            $go!(u16, u64, u64, u64, u64, u64, u64, $($rest)*)
        }
    }};
    (u32, $job:expr, $go:ident!($($rest:tt)*)) => {{
        Fits::of::<u32>($job);
        $go!(u32, u64, u64, u64, u128, u128, u128, $($rest)*)
    }};
}

/// Which sums fit. n < 2^31 is asserted, so u64 holds S1 of every type (2^63), S2 of 8 and 16-bit codes (2^63), and
/// u128 the rest.
struct Fits {
    /// S1 of a window, and of its section, in u32.
    window: bool,
    section: bool,
    /// S2 of a window in u32.
    squares: bool,
    /// S1 along z in u16, of the window in u32; S2 of the section in u32.
    narrow: bool,
}

impl Fits {
    fn of<T: Code>(job: &Job) -> Fits {
        let (n, m) = job.counts();
        let w = job.window[0].min(job.src[0]) as u64;
        assert!(n < 1 << 31, "windows of {n} voxels");
        let top = T::TOP as u128;
        let fits = |count: u64, most: u128, bits: u32| (count as u128) * most < 1u128 << bits;
        let (window, section) = (fits(n, top, 32), fits(m, top, 32));
        let narrow = fits(w, top, 16) && window && fits(m, top * top, 32);
        Fits { window, section, squares: fits(n, top * top, 32), narrow }
    }
}

/// What a run needs besides the voxels.
pub struct Setup<'a, T> {
    pub job: &'a Job,
    pub level: Level,
    pub flip: T,
    /// Code of missing voxels.
    pub missing: Option<T>,
}

/// Runs every tile of a call over codes of type `T` (`flip` turns stored bits into codes).
pub trait Dispatch: Code {
    fn run(src: View<Self>, setup: &Setup<Self>, emit: &mut Emit, scratch: &mut [u8]);
    fn bytes(job: &Job, masked: bool) -> usize;
}

macro_rules! go {
    ($t:ident, $z1:ty, $y1:ty, $x1:ty, $z2:ty, $y2:ty, $x2:ty, $src:ident, $setup:ident, $emit:ident, $scratch:ident) => {
        if $setup.missing.is_some() {
            run::<$t, $z1, $y1, $x1, $z2, $y2, $x2, true>($src, $setup, $emit, $scratch)
        } else {
            run::<$t, $z1, $y1, $x1, $z2, $y2, $x2, false>($src, $setup, $emit, $scratch)
        }
    };
}
macro_rules! bytes {
    ($t:ident, $z1:ty, $y1:ty, $x1:ty, $z2:ty, $y2:ty, $x2:ty, $job:ident, $masked:ident) => {
        if $masked {
            buffer_bytes::<$t, $z1, $y1, $x1, $z2, $y2, $x2, true>($job)
        } else {
            buffer_bytes::<$t, $z1, $y1, $x1, $z2, $y2, $x2, false>($job)
        }
    };
}
macro_rules! dispatch {
    ($($t:ident)*) => {$(
        impl Dispatch for $t {
            fn run(src: View<$t>, setup: &Setup<$t>, emit: &mut Emit, scratch: &mut [u8]) {
                with_widths!($t, setup.job, go!(src, setup, emit, scratch))
            }
            fn bytes(job: &Job, masked: bool) -> usize {
                with_widths!($t, job, bytes!(job, masked))
            }
        }
    )*};
}
dispatch!(u8 u16 u32);

fn buffer_bytes<T, Z1, Y1, X1, Z2, Y2, X2, const M: bool>(job: &Job) -> usize
where
    T: Code,
    Z1: Acc,
    Y1: Acc + From<Z1>,
    X1: Acc + From<Y1> + Slide<Z1, Y1>,
    Z2: Acc,
    Y2: Acc + From<Z2>,
    X2: Acc + From<Y2> + Slide<Z2, Y2>,
    Add: Op<X1> + Op<X2>,
{
    Extremes::<T>::bytes(job) + Sums::<Z1, Y1, X1, Z2, Y2, X2, M>::bytes(job) + Counts::bytes(job)
}

/// Voxels in the windows of a block of rows, and their reciprocals where they are wanted.
struct Counts<'a> {
    /// Voxels that exist along x for each column.
    columns: &'a mut [u32],
    n: &'a mut [u32],
    inverse: &'a mut [f64],
    /// The section of every row of the block that `n` was made for.
    made: [usize; ROWS],
}

impl<'a> Counts<'a> {
    fn cut(job: &Job, bytes: &mut &'a mut [u8]) -> Self {
        let len = ROWS * job.out_pitch();
        Counts { columns: cut(bytes, job.tile[1]), n: cut(bytes, len), inverse: cut(bytes, len), made: [0; ROWS] }
    }

    fn bytes(job: &Job) -> usize {
        let len = ROWS * job.out_pitch();
        padded::<u32>(job.tile[1]) + padded::<u32>(len) + padded::<f64>(len)
    }

    fn begin_tile(&mut self, job: &Job, tile: &Tile) {
        for (i, c) in self.columns[..tile.size[1]].iter_mut().enumerate() {
            *c = job.count(2, tile.x + i) as u32;
        }
        self.made = [0; ROWS];
    }

    /// For rows whose windows have a section of `section(k)` voxels; returns the elements from row to row, 0 where all rows
    /// have the same counts, which then stay in the first-level cache.
    fn make(&mut self, level: Level, job: &Job, rows: usize, divides: bool, section: impl Fn(usize) -> usize) -> usize {
        let alike = (1..rows).all(|k| section(k) == section(0));
        for k in 0..if alike { 1 } else { rows } {
            let section = section(k);
            if section == self.made[k] {
                continue;
            }
            self.made[k] = section;
            let part = k * job.out_pitch()..k * job.out_pitch() + job.tile[1];
            self.n[part.clone()].iter_mut().zip(&*self.columns).for_each(|(n, c)| *n = section as u32 * c);
            if divides {
                estimate::inverse_row(level, &self.n[part.clone()], &mut self.inverse[part]);
            }
        }
        if alike { 0 } else { job.out_pitch() }
    }
}

fn run<T, Z1, Y1, X1, Z2, Y2, X2, const M: bool>(
    src: View<T>,
    setup: &Setup<T>,
    emit: &mut Emit,
    mut scratch: &mut [u8],
) where
    T: Code,
    Z1: Acc + From<T>,
    Y1: Acc + From<Z1>,
    X1: RowSum + From<Y1> + Slide<Z1, Y1>,
    Z2: Acc + From<T::Square>,
    Y2: Acc + From<Z2>,
    X2: Acc + From<Y2> + Slide<Z2, Y2>,
    Add: Op<X1> + Op<X2>,
{
    let Setup { job, level, flip, missing } = *setup;
    let mut extremes = Extremes::<T>::cut(job, &mut scratch);
    let mut sums = Sums::<Z1, Y1, X1, Z2, Y2, X2, M>::cut(job, &mut scratch);
    let mut counts = Counts::cut(job, &mut scratch);
    let coding = Coding { flip, missing: missing.unwrap_or_default() };
    let (most, divides) = (job.counts().0, emit.divides());
    let width = Width::of(most, T::TOP);
    let at = job.at.map(|v| v as usize); // no output is skipped
    let (reach, first) = (job.radius[0], at[0]);
    for tile in Tile::all(job) {
        counts.begin_tile(job, &tile);
        extremes.begin_tile(&tile);
        sums.begin_tile();
        // The window of the plane before the first output; each output then adds one plane and drops one.
        for z in (first as isize - 1 - reach as isize).max(0) as usize..(first + reach).min(job.src[0]) {
            sums.slide_in(level, job, &tile, src, coding, [Some(z), None]);
        }
        for z in 0..job.dst[0] {
            if job.needs.extremes && z % job.batch == 0 {
                extremes.planes::<M>(level, job, &tile, src, coding, z);
            }
            let new = Some(first + z + reach).filter(|z| *z < job.src[0]);
            let old = (first + z).checked_sub(reach + 1);
            sums.slide_in(level, job, &tile, src, coding, [new, old]);
            sums.begin_rows(level, job);
            let section = job.count(0, z);
            for j in (0..tile.size[0]).step_by(ROWS) {
                let rows = ROWS.min(tile.size[0] - j);
                if job.needs.extremes {
                    extremes.finish_rows(level, job, &tile, [z % job.batch, j], rows);
                }
                sums.finish_rows(level, job, j, rows);
                let n_pitch = if M {
                    if divides {
                        estimate::inverse_row(level, sums.count.out, counts.inverse);
                    }
                    job.out_pitch()
                } else {
                    counts.make(level, job, rows, divides, |k| section * job.count(1, tile.y + j + k))
                };
                let [cz, cy] = [at[0] + z, at[1] + tile.y + j];
                let centre = cz * src.plane + cy * src.row + at[2] + tile.x;
                let windows = IntRows {
                    v: &src.data[centre..centre + (rows - 1) * src.row + tile.size[1]],
                    v_pitch: src.row,
                    lo: extremes.out_lo,
                    hi: extremes.out_hi,
                    s1: sums.s1.out,
                    s2: sums.s2.out,
                    n: if M { sums.count.out } else { counts.n },
                    inverse: counts.inverse,
                    n_pitch,
                    pitch: job.out_pitch(),
                    rows,
                    len: tile.size[1],
                    most,
                    width,
                };
                emit.int_rows(setup, windows, [z, tile.y + j, tile.x]);
            }
        }
    }
}
