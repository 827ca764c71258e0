//! Voxels of wide types as codes of 16 bits whose order never contradicts theirs, so that bounds of counts of codes are bounds
//! of counts of voxels.

use crate::grid::{View, ViewMut, Voxel};
use crate::kernel::levels::Levels;
use crate::multiversion;

/// Code of a voxel that is missing.
pub const GONE: u16 = u16::MAX;
/// Values that get a code of their own.
const ATOMS: usize = 16;

/// Equal steps between two ends, the same for the whole volume; beyond them voxels have the first or last code. Values that
/// many voxels share (a background) have codes to themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct Codes {
    /// A power of two that keeps differences finite and normal.
    unit: f64,
    /// In units.
    from: f64,
    per_step: f64,
    last: f64,
    atoms: [f64; ATOMS],
    count: usize,
}

impl Codes {
    /// From levels of the whole volume, in the order of stored values. Twice the span of all but the outermost levels is left
    /// on each side of it where there are values: a few outliers must not cost the others their resolution.
    pub fn new(levels: &Levels) -> Codes {
        let at = &levels.at;
        let (first, last) = (at.first().copied().unwrap_or(0.0), at.last().copied().unwrap_or(0.0));
        let inner = if at.len() >= 8 { (at[1], at[at.len() - 2]) } else { (first, last) };
        let inner = if inner.0 < inner.1 { inner } else { (first, last) };
        // Half of a difference is finite.
        let small = inner.1.abs().max(inner.0.abs()) < 1e-150;
        let unit = if small { f64::from_bits((1023 + 500) << 52) } else { 0.25 };
        let (low, high) = (inner.0 * unit, inner.1 * unit);
        let span = high - low;
        let from = (first * unit).max(low - 2.0 * span);
        let to = (last * unit).min(high + 2.0 * span);
        let mut atoms = [0.0; ATOMS];
        let heavy = (0..at.len()).filter(|&k| levels.step.get(k) == Some(&true)).map(|k| at[k]);
        let count = atoms.iter_mut().zip(heavy).map(|(a, v)| *a = v).count();
        let last = f64::from(GONE - 1) - 2.0 * count as f64;
        let per_step = if to > from { last / (to - from) } else { 0.0 };
        Codes { unit, from, per_step, last, atoms, count }
    }

    /// Code of a voxel. Every step of it keeps the order: products and sums are rounded monotonically, NaN (0 times an
    /// infinite rate, at the first end only) is the least, and an atom lifts itself by one and all above it by two.
    #[inline(always)]
    pub fn of(&self, v: f64) -> u16 {
        if v.is_nan() {
            return GONE;
        }
        let atoms = self.atoms[..self.count].iter();
        let lift: u16 = atoms.map(|a| (v >= *a) as u16 + (v > *a) as u16).sum();
        self.linear(v) + lift
    }

    #[inline(always)]
    fn linear(&self, v: f64) -> u16 {
        let step = (v * self.unit - self.from) * self.per_step;
        let step = if step > 0.0 { step } else { 0.0 };
        (if step < self.last { step } else { self.last }) as u16
    }

    /// Whether no other value has the code of this one.
    pub fn alone(&self, v: f64) -> bool {
        self.atoms[..self.count].contains(&v)
    }
}

multiversion! {
    /// Codes of a row; whether any voxel is missing.
    fn encode[T: Voxel](row: &[T], missing: Option<T>, codes: &Codes, out: &mut [u16]) -> bool = encode_inner;
}

#[inline(always)]
#[allow(clippy::eq_op)]
fn encode_inner<T: Voxel>(row: &[T], missing: Option<T>, codes: &Codes, out: &mut [u16]) -> bool {
    for (o, v) in out.iter_mut().zip(row) {
        *o = codes.linear(v.to_f64());
    }
    for atom in &codes.atoms[..codes.count] {
        for (o, v) in out.iter_mut().zip(row) {
            let v = v.to_f64();
            *o = o.wrapping_add((v >= *atom) as u16 + (v > *atom) as u16);
        }
    }
    let mut any = false;
    for (o, v) in out.iter_mut().zip(row) {
        // NaN is unequal to itself.
        let gone = *v != *v || missing == Some(*v);
        any |= gone;
        *o = if gone { GONE } else { *o };
    }
    any
}

/// Codes of a box; whether any voxel is missing.
pub fn encode_all<T: Voxel>(
    level: crate::kernel::simd::Level,
    src: View<T>,
    missing: Option<T>,
    codes: &Codes,
    mut out: ViewMut<u16>,
) -> bool {
    let mut any = false;
    for (z, y) in (0..src.shape[0]).flat_map(|z| (0..src.shape[1]).map(move |y| (z, y))) {
        any |= encode(level, src.row_at(z, y), missing, codes, out.row_at(z, y));
    }
    any
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::Level;

    fn levels(at: &[f64], heavy: &[f64]) -> Levels {
        Levels::even(at.to_vec(), at.iter().map(|v| heavy.contains(v)).collect())
    }

    #[test]
    fn the_order_is_kept_over_the_whole_range_of_f64() {
        let tiny = f64::from_bits(1);
        let ends = [
            levels(&[], &[]),
            levels(&[3.0], &[3.0]),
            levels(&[-f64::MAX, f64::MAX], &[]),
            levels(&[0.0, tiny, 3.0 * tiny, 5.0 * tiny, 6.0 * tiny, 7.0 * tiny, 8.0 * tiny, 9.0 * tiny], &[tiny]),
            levels(&[-1e30, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 1e300], &[0.0, 2.0]),
            levels(&[1e6, 1e6 + 1.0, 1e6 + 2.0, 1e6 + 3.0, 1e6 + 4.0, 1e6 + 5.0, 1e6 + 6.0, 1e6 + 7.0], &[1e6 + 3.0]),
        ];
        for levels in &ends {
            let codes = Codes::new(levels);
            let mut values = vec![f64::NEG_INFINITY, -f64::MAX, -0.0, 0.0, f64::MIN_POSITIVE, f64::MAX, f64::INFINITY];
            for v in levels.at.iter().flat_map(|v| [*v, -*v, v * 1.5, v / 3.0, v + 0.3]) {
                values.extend([v, v.next_up(), v.next_down()]);
            }
            values.sort_by(f64::total_cmp);
            let found: Vec<u16> = values.iter().map(|v| codes.of(*v)).collect();
            assert!(found.is_sorted() && found.iter().all(|c| *c < GONE), "{levels:?}: {found:?}");
            for atom in levels.at.iter().zip(&levels.step).filter(|(_, s)| **s).map(|(v, _)| *v) {
                assert!(codes.alone(atom));
                let same = values.iter().filter(|v| codes.of(**v) == codes.of(atom));
                assert!(same.into_iter().all(|v| *v == atom), "{atom} shares its code");
            }
            let mut rows = vec![0; values.len() + 1];
            values.push(f64::NAN);
            for level in Level::available() {
                assert!(encode(level, &values, None, &codes, &mut rows));
                assert_eq!(rows, values.iter().map(|v| codes.of(*v)).collect::<Vec<_>>(), "{level:?}");
            }
        }
    }

    #[test]
    fn outliers_leave_the_others_their_resolution() {
        let at: Vec<f64> =
            (0..64).map(|k| [-1e30, 100.0 + k as f64, 1e30][(k > 0) as usize + (k == 63) as usize]).collect();
        let codes = Codes::new(&levels(&at, &[]));
        assert!(codes.of(150.0) - codes.of(149.0) > 200);
        assert_eq!((codes.of(-1e30), codes.of(1e30)), (0, GONE - 1));
    }
}
