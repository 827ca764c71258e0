//! Sums over windows of lines for a few outputs at a time, with the tree's first level kept in registers and L1.
//!
//! The order of additions is that of the radix-4 tree of [`super::merge`] for windows of one level: sums of four as
//! `(a + b) + (c + d)`, then those of a window from its start on, then single lines.

use super::lines::{Lines, tree_levels};
use super::merge::Pair;
use crate::grid::Voxel;
use crate::kernel::simd::Level;

/// Outputs made together.
pub const BLOCK: usize = 8;
/// Columns made together: a vector of f64.
const LANES: usize = 8;
/// Sums of four of a block: `BLOCK + 4 * (8 - 1)`.
const FOURS: usize = 36;

/// Windows that [`Columns::sums`] takes: those with one level of fours.
pub fn fits(w: usize) -> bool {
    tree_levels(w) == 1
}

/// Elements whose windows are summed.
pub trait Columns<A>: Sized {
    /// Whether [`Columns::sums`] does anything.
    const COLUMNS: bool = false;
    /// Sums over windows of `w` lines for `outputs <= BLOCK` consecutive outputs and `cols` columns; output `k` goes to
    /// `out[at.0 + k * at.1..]`. Lines outside the clip count as zeros. Returns false, with nothing done, for types
    /// without this form.
    #[allow(clippy::too_many_arguments)]
    fn sums(
        _level: Level,
        _src: &[Self],
        _lines: Lines,
        _w: usize,
        _outputs: usize,
        _cols: usize,
        _out: &mut [A],
        _at: (usize, usize),
    ) -> bool {
        false
    }
}

impl Columns<Pair> for f64 {}
impl Columns<Pair> for Pair {}

macro_rules! columns {
    ($($t:ident)*) => {$(
        impl Columns<f64> for $t {
            const COLUMNS: bool = true;
            fn sums(
                level: Level,
                src: &[$t],
                lines: Lines,
                w: usize,
                outputs: usize,
                cols: usize,
                out: &mut [f64],
                at: (usize, usize),
            ) -> bool {
                if fits(w) {
                    column_sums(level, src, lines, w, outputs, cols, out, at);
                }
                fits(w)
            }
        }
    )*};
}
columns!(f32 f64);

crate::multiversion! {
    fn column_sums[T: Voxel](
        src: &[T], lines: Lines, w: usize, outputs: usize, cols: usize, out: &mut [f64], at: (usize, usize)
    ) -> () = column_sums_inner;
}

#[inline(always)]
fn column_sums_inner<T: Voxel>(
    src: &[T],
    lines: Lines,
    w: usize,
    outputs: usize,
    cols: usize,
    out: &mut [f64],
    at: (usize, usize),
) {
    assert!(fits(w) && (1..=BLOCK).contains(&outputs));
    let count = outputs + w - 1;
    // Lines that exist, and where each starts.
    let exist = |i: isize| (i - lines.first).clamp(0, count as isize) as usize;
    let exist = (exist(lines.clip.0), exist(lines.clip.1));
    let mut starts = [0; BLOCK + 35];
    for (i, s) in starts[..count].iter_mut().enumerate() {
        *s = lines.base + (lines.first + i as isize).clamp(lines.clip.0, lines.clip.1 - 1) as usize * lines.pitch;
    }
    assert!(starts[count - 1] + cols <= src.len()); // starts grow
    assert!(at.0 + (outputs - 1) * at.1 + cols <= out.len());
    let starts = &starts[..count];
    if cols < LANES {
        for x in 0..cols {
            // SAFETY: starts and outputs were checked with `cols`.
            unsafe { chunk::<T, 1>(src, starts, exist, x, w, outputs, out, at) };
        }
        return;
    }
    let mut x = 0;
    loop {
        // SAFETY: as above, and `x + LANES <= cols`.
        unsafe { chunk::<T, LANES>(src, starts, exist, x, w, outputs, out, at) };
        if x + LANES >= cols {
            break;
        }
        x = (x + LANES).min(cols - LANES); // the last chunk writes some values of its neighbour again
    }
}

#[inline(always)]
fn add<const L: usize>(a: [f64; L], b: [f64; L]) -> [f64; L] {
    let mut s = a;
    for i in 0..L {
        s[i] += b[i];
    }
    s
}

/// # Safety
/// Every start and output line leaves room for `L` elements at `x`; `w` has one level, `outputs <= BLOCK`.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
unsafe fn chunk<T: Voxel, const L: usize>(
    src: &[T],
    starts: &[usize],
    exist: (usize, usize),
    x: usize,
    w: usize,
    outputs: usize,
    out: &mut [f64],
    at: (usize, usize),
) {
    let line = |i: usize| {
        let mut v = [0.0; L];
        if i >= exist.0 && i < exist.1 {
            // SAFETY: `i` is below the number of starts, and the start leaves room (the caller's promise).
            let from = unsafe {
                let start = *starts.get_unchecked(i) + x;
                src.get_unchecked(start..start + L)
            };
            for i in 0..L {
                v[i] = from[i].to_f64();
            }
        }
        v
    };
    let digit = w / 4;
    let mut fours = [[0.0; L]; FOURS];
    let (a, b) = (line(0), line(1));
    let mut last = line(2);
    let (mut two, mut next) = (add(a, b), add(b, last));
    for (i, four) in fours[..outputs + 4 * (digit - 1)].iter_mut().enumerate() {
        let v = line(i + 3);
        let pair = add(last, v);
        *four = add(two, pair);
        (two, next, last) = (next, pair, v);
    }
    for k in 0..outputs {
        let mut s = fours[k];
        if digit == 4 {
            s = add(add(s, fours[k + 4]), add(fours[k + 8], fours[k + 12]));
        } else {
            for j in 1..digit {
                s = add(s, fours[k + 4 * j]);
            }
        }
        for i in 4 * digit..w {
            s = add(s, line(k + i));
        }
        let start = at.0 + k * at.1 + x;
        // SAFETY: the caller's promise.
        unsafe { out.get_unchecked_mut(start..start + L) }.copy_from_slice(&s);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::window::lines::tree_sum;

    #[test]
    fn columns_equal_the_tree_bit_for_bit() {
        let src: Vec<f64> = (0..60 * 40u64).map(|i| 1e9 / (1 + i * i % 977) as f64).collect();
        for level in Level::available() {
            for w in (9..=35).step_by(2) {
                for cols in [1, 7, 8, 21, 40] {
                    for (first, clip) in [(3, (0, 60)), (-4, (0, 60)), (-30, (0, 4)), (20, (0, 22)), (2, (10, 13))] {
                        let lines = Lines { base: 0, pitch: 40, first, clip };
                        let mut out = vec![7.0; 8 * 45];
                        assert!(<f64 as Columns<f64>>::sums(level, &src, lines, w, 8, cols, &mut out, (3, 45)));
                        for x in 0..cols {
                            let at =
                                |i: isize| if (clip.0..clip.1).contains(&i) { src[i as usize * 40 + x] } else { 0.0 };
                            let column: Vec<f64> = (0..w + 7).map(|i| at(first + i as isize)).collect();
                            let (mut s, mut work) = (vec![0.0; 8], vec![0.0; 8 + w]);
                            tree_sum(level, &column, w, 1, &mut s, &mut work);
                            for k in 0..8 {
                                assert_eq!(
                                    out[3 + k * 45 + x].to_bits(),
                                    s[k].to_bits(),
                                    "{level:?} {w} {cols} {first} {clip:?}"
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}
