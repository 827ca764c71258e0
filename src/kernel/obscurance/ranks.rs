//! Ranks in the place of values. A sweep asks only which of two voxels is denser, so the rank of a value among those that
//! occur serves as well: what a table makes of 8- or 16-bit data is swept as fast as the data ([`Ranks`], known before a
//! voxel is read), and so are floats of few values, whatever made them ([`rank`], brick by brick).

use std::sync::Arc;

use super::keys::{Coded, Key};
use crate::grid::View;

/// Ranks of what a function makes of every value of an 8- or 16-bit type, by code: voxels are compared by the function's
/// values while only their own are read. There are never more ranks than values, so that they fit the type's keys.
#[derive(Debug, Clone, PartialEq)]
pub struct Ranks(Arc<[u16]>);

impl Ranks {
    /// `values[i]`: what the function makes of the type's least value + `i`; 256 or 65536 of them. `None` if one is NaN.
    ///
    /// Panics if there are as many values as no type has.
    pub fn new(values: &[f32]) -> Option<Ranks> {
        assert!([1 << 8, 1 << 16].contains(&values.len()), "{} values", values.len());
        if values.iter().any(|v| v.is_nan()) {
            return None;
        }
        let mut order: Vec<(u32, usize)> = values.iter().enumerate().map(|(i, v)| (v.code(), i)).collect();
        order.sort_unstable();
        let mut ranks = vec![0; values.len()];
        let mut rank = 0;
        for (at, &(value, index)) in order.iter().enumerate() {
            rank += u16::from(at > 0 && order[at - 1].0 != value);
            ranks[index] = rank;
        }
        Some(Ranks(ranks.into()))
    }

    /// Whether they are those of a type with so many values.
    pub(super) fn of<T>(&self) -> bool {
        self.0.len() == 1 << (8 * size_of::<T>())
    }

    #[inline(always)]
    pub(super) fn of_code<K: Key>(&self, code: K) -> K {
        K::of_rank(self.0[code.index()])
    }
}

/// Slots of the table of values, open addressed: four for each that it may hold.
const SLOTS: usize = 1024;
/// Most distinct values.
const MOST: usize = 256;
/// Marks an empty slot: a NaN, which is never entered.
const EMPTY: u32 = 0x7fc0_0000;

/// Distinct values, by their bits.
struct Distinct {
    bits: [u32; SLOTS],
    ranks: [u8; SLOTS],
    count: usize,
}

impl Distinct {
    fn new() -> Distinct {
        Distinct { bits: [EMPTY; SLOTS], ranks: [0; SLOTS], count: 0 }
    }

    /// The slot that holds the value, or the empty one where it belongs. There is always an empty one.
    #[inline(always)]
    fn slot(&self, bits: u32) -> usize {
        let mut slot = (bits.wrapping_mul(0x9e37_79b1) >> 22) as usize;
        while self.bits[slot] != bits && self.bits[slot] != EMPTY {
            slot = (slot + 1) % SLOTS;
        }
        slot
    }

    /// False if there are too many.
    #[inline(always)]
    fn enter(&mut self, bits: u32) -> bool {
        let slot = self.slot(bits);
        if self.bits[slot] == EMPTY {
            self.bits[slot] = bits;
            self.count += 1;
        }
        self.count <= MOST
    }

    /// Ranks by the order of the values.
    fn order(&mut self) {
        let mut used = [(0u32, 0usize); MOST];
        let slots = (0..SLOTS).filter(|&s| self.bits[s] != EMPTY);
        used.iter_mut().zip(slots).for_each(|(u, s)| *u = (f32::from_bits(self.bits[s]).code(), s));
        let used = &mut used[..self.count];
        used.sort_unstable();
        used.iter().enumerate().for_each(|(rank, (_, slot))| self.ranks[*slot] = rank as u8);
    }
}

/// Fills `out`, dense and as large as `src`, with ranks. False, with `out` undefined, if there are more than 256 distinct values
/// or a NaN; noise is found out within its first few hundred voxels.
pub(super) fn rank(src: View<f32>, out: &mut [u8]) -> bool {
    let [nz, ny, nx] = src.shape;
    let rows = || (0..nz).flat_map(|z| (0..ny).map(move |y| src.row_at(z, y)));
    let mut values = Distinct::new();
    let mut last = EMPTY;
    for row in rows() {
        for v in row {
            let bits = (v + 0.0).to_bits(); // -0 is 0
            if v.is_nan() {
                return false;
            }
            if bits != last {
                if !values.enter(bits) {
                    return false;
                }
                last = bits;
            }
        }
    }
    values.order();
    let (mut last, mut rank) = (EMPTY, 0);
    for (row, out) in rows().zip(out.chunks_exact_mut(nx.max(1))) {
        for (v, o) in row.iter().zip(out) {
            let bits = (v + 0.0).to_bits();
            if bits != last {
                (last, rank) = (bits, values.ranks[values.slot(bits)]);
            }
            *o = rank;
        }
    }
    true
}
