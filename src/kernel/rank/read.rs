//! What the sums of [`sweep`](crate::kernel::levels::sums::sweep) say about the centres of one group of codes.

use crate::kernel::levels::sums::{NEVER, RUN, Row, Sum, Windows};
use crate::kernel::simd::Level;

/// Most thresholds of a tile.
pub(super) const MOST: usize = 256;

/// Codes whose voxels are counted in one sweep.
pub(super) struct Group {
    pub code: u8,
    pub codes: u8,
    /// Threshold of the first lane; the others follow.
    pub first: u8,
    /// The last lane counts all voxels but missing ones.
    pub gaps: bool,
    /// Voxels below the centre are counted as well.
    pub mid: bool,
}

/// A bit for each centre of a row.
pub(super) type Mask = [u64; RUN / 64];

/// From the first bit to the last.
pub(super) fn extent(mask: Mask) -> std::ops::Range<usize> {
    let words = || mask.into_iter().enumerate().filter(|(_, bits)| *bits != 0);
    let first = words().next().map_or(0, |(i, bits)| 64 * i + bits.trailing_zeros() as usize);
    first..words().next_back().map_or(0, |(i, bits)| 64 * (i + 1) - bits.leading_zeros() as usize)
}

impl Group {
    pub fn lanes<const L: usize>(&self) -> [u8; L] {
        let last = if self.gaps { NEVER - 1 } else { NEVER };
        std::array::from_fn(|k| match self.gaps && k == L - 1 {
            true => last,
            false => self.first.saturating_add(k as u8).min(last),
        })
    }

    /// Which centres of a row are of the group.
    pub fn members(&self, level: Level, centres: &[u8]) -> Mask {
        assert!(centres.len() <= RUN);
        #[cfg(target_arch = "x86_64")]
        if level == Level::Avx512 {
            // SAFETY: the level says that the CPU has AVX-512.
            return unsafe { x86::members(centres, self.code, self.codes) };
        }
        let _ = level;
        let mut mask = Mask::default();
        for (x, centre) in centres.iter().enumerate() {
            mask[x / 64] |= u64::from(centre.wrapping_sub(self.code) < self.codes) << (x % 64);
        }
        mask
    }
}

/// Places of the sums of a row's centres at the ends and starts of their windows, and the counts between them; room for a vector
/// more, so that whole ones can be written.
pub(super) struct Places {
    ends: [u32; RUN + 16],
    starts: [u32; RUN + 16],
    counted: [u32; RUN + 16],
}

impl Places {
    pub fn new() -> Places {
        Places { ends: [0; RUN + 16], starts: [0; RUN + 16], counted: [0; RUN + 16] }
    }
}

/// A row of centres, and what its windows are counted by.
pub(super) struct Counting<'a, S, const L: usize> {
    pub centres: &'a [u8],
    pub row: Row<'a, S, L>,
    pub windows: &'a Windows,
    /// Rows of each window.
    pub rows: u32,
    pub group: &'a Group,
}

impl<S: Sum, const L: usize> Counting<'_, S, L> {
    /// Places of the centres of the group.
    fn members(&self, level: Level) -> impl Iterator<Item = usize> {
        self.group.members(level, self.centres).into_iter().enumerate().flat_map(|(i, mut bits)| {
            std::iter::from_fn(move || {
                let bit = (bits != 0).then(|| bits.trailing_zeros() as usize)?;
                bits &= bits - 1;
                Some(64 * i + bit)
            })
        })
    }

    /// Voxels not above centre `x`, with `ties = "mid"` plus those below it, and the size of the window (twice); `alone`: the
    /// code stands for one value. Where it does not, all of its voxels count as not above.
    #[inline(always)]
    fn count(&self, x: usize, alone: bool) -> (u32, u32) {
        let (columns, code, group) = (self.windows.of(x), self.centres[x], self.group);
        let lane = usize::from(code.wrapping_sub(group.first)) % L;
        let counted = self.row.count(&columns, lane);
        let size = if group.gaps { self.row.count(&columns, L - 1) } else { self.rows * columns.len() as u32 };
        if !group.mid {
            return (counted, size);
        }
        let below = match code {
            _ if !alone => counted,
            0 => 0,
            _ => self.row.count(&columns, (lane + L - 1) % L),
        };
        (counted + below, 2 * size)
    }

    /// Openness of the centres of the group.
    pub fn openness(&self, level: Level, places: &mut Places, out: &mut [f32]) {
        #[cfg(target_arch = "x86_64")]
        if let (Level::Avx512, false, false, Some(sums)) =
            (level, self.group.gaps, self.group.mid, S::words(self.row.sums.as_flattened()))
        {
            assert!(out.len() >= self.centres.len() && self.centres.len() <= RUN && L.is_power_of_two());
            // SAFETY: the level says that the CPU has AVX-512; lengths were checked.
            return unsafe { x86::openness::<L>(self.centres, self.group, sums, self.windows, self.rows, places, out) };
        }
        let _ = places;
        for x in self.members(level) {
            let (counted, size) = self.count(x, true);
            out[x] = quotient(counted, size);
        }
    }

    /// Counts of the centres of the group; `single` says whether a code stands for one value.
    pub fn counts(&self, level: Level, single: &[bool; MOST], counted: &mut [u32], sizes: &mut [u32]) {
        for x in self.members(level) {
            (counted[x], sizes[x]) = self.count(x, single[usize::from(self.centres[x])]);
        }
    }
}

/// The quotient of two integers below 2^53, rounded to f64 and then to f32 as if at once (see `Counts::openness`).
#[inline(always)]
pub(super) fn quotient(counted: u32, size: u32) -> f32 {
    (f64::from(counted) / f64::from(size)) as f32
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Group, Mask, Places, RUN, Windows};

    /// # Safety
    /// The CPU must have AVX-512.
    #[target_feature(enable = "avx512f,avx512bw,bmi2")]
    pub unsafe fn members(centres: &[u8], code: u8, codes: u8) -> Mask {
        let (code, codes) = (_mm512_set1_epi8(code as i8), _mm512_set1_epi8(codes as i8));
        let mut mask = Mask::default();
        for (mask, centres) in mask.iter_mut().zip(centres.chunks(64)) {
            let lanes = u64::MAX >> (64 - centres.len());
            // SAFETY: the load is masked to the chunk, which is not empty.
            let centres = unsafe { _mm512_maskz_loadu_epi8(lanes, centres.as_ptr().cast()) };
            *mask = _mm512_mask_cmplt_epu8_mask(lanes, _mm512_sub_epi8(centres, code), codes);
        }
        mask
    }

    /// Openness of the centres of a group that has neither gaps nor `ties = "mid"`: the places of their sums, packed, what lies
    /// there, and quotients where the centres are. Counts below 2^16 are f32, and their quotient is rounded once. At radius 10
    /// this takes 1.8 ns per voxel, one centre after the other 3.6 (2-core Zen 4 VM, AVX-512, 2026-11-27).
    ///
    /// # Safety
    /// The CPU must have AVX-512; at most RUN centres, as many elements of `out`, and `L` a power of two.
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,bmi1,bmi2,popcnt")]
    pub unsafe fn openness<const L: usize>(
        centres: &[u8],
        group: &Group,
        sums: &[u16],
        windows: &Windows,
        rows: u32,
        places: &mut Places,
        out: &mut [f32],
    ) {
        const CHUNKS: usize = RUN / 16;
        let Places { ends, starts, counted } = places;
        let mut masks = [0; CHUNKS];
        let (mut n, mut last) = (0, _mm512_setzero_si512());
        let (code, codes) = (_mm_set1_epi8(group.code as i8), _mm_set1_epi8(group.codes as i8));
        let lane_of = _mm512_set1_epi32(L as i32 - 1);
        for (i, chunk) in centres.chunks(16).enumerate() {
            let lanes = u16::MAX >> (16 - chunk.len());
            // SAFETY: loads of centres are masked to the chunk, those of windows lie within RUN elements; n + 16 places are there,
            // as at most 16 were written for each chunk before.
            unsafe {
                let own = _mm_maskz_loadu_epi8(lanes, chunk.as_ptr().cast());
                let mask = _mm_mask_cmplt_epu8_mask(lanes, _mm_sub_epi8(own, code), codes);
                masks[i] = mask;
                if mask == 0 {
                    continue;
                }
                let first = _mm_set1_epi8(group.first as i8);
                let lane = _mm512_and_si512(_mm512_cvtepu8_epi32(_mm_sub_epi8(own, first)), lane_of);
                let place = |columns: &[u32; RUN]| {
                    let columns = _mm512_loadu_si512(columns.as_ptr().add(16 * i).cast());
                    let place = _mm512_mullo_epi32(columns, _mm512_set1_epi32(L as i32));
                    _mm512_maskz_compress_epi32(mask, _mm512_add_epi32(place, lane))
                };
                let (end, start) = (place(&windows.end), place(&windows.start));
                last = _mm512_max_epu32(last, _mm512_max_epu32(end, start));
                _mm512_storeu_si512(ends.as_mut_ptr().add(n).cast(), end);
                _mm512_storeu_si512(starts.as_mut_ptr().add(n).cast(), start);
                n += mask.count_ones() as usize;
            }
        }
        if n == 0 {
            return;
        }
        let last = _mm512_reduce_max_epu32(last) as usize;
        assert!(last < sums.len(), "sum {last} of {}", sums.len());
        for ((counted, end), start) in counted.iter_mut().zip(ends).zip(starts).take(n) {
            // SAFETY: no place is beyond the last, which was checked.
            let pair = unsafe { [end, start].map(|at| *sums.get_unchecked(*at as usize)) };
            *counted = u32::from(pair[0].wrapping_sub(pair[1]));
        }
        let rows = _mm512_set1_epi32(rows as i32);
        let mut n = 0;
        for (i, mask) in masks.into_iter().enumerate().filter(|(_, mask)| *mask != 0) {
            // SAFETY: as above; the store is masked to centres.
            unsafe {
                let [end, start] =
                    [&windows.end, &windows.start].map(|c| _mm512_loadu_si512(c.as_ptr().add(16 * i).cast()));
                let size = _mm512_mullo_epi32(_mm512_sub_epi32(end, start), rows);
                let own = _mm512_maskz_expand_epi32(mask, _mm512_loadu_si512(counted.as_ptr().add(n).cast()));
                let open = _mm512_div_ps(_mm512_cvtepi32_ps(own), _mm512_cvtepi32_ps(size));
                _mm512_mask_storeu_ps(out.as_mut_ptr().add(16 * i), mask, open);
            }
            n += mask.count_ones() as usize;
        }
    }
}
