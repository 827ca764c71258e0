//! Adds the contributions of a strip of answers to sums.

use super::keys::LANES;
use super::scan::Hit;
use super::sinks::{Piece, Strip, Visit};
use crate::kernel::simd::Level;

/// `[sense][byte][answer]`, least byte first.
pub(super) type ByteTables = [[[u8; 256]; 3]; 2];

/// Splits contributions into bytes; answers from 256 on are left out.
pub(super) fn split(tables: [&[u32]; 2], bytes: &mut ByteTables) {
    for (table, bytes) in tables.into_iter().zip(bytes) {
        for (answer, value) in table.iter().take(256).enumerate() {
            (0..3).for_each(|b| bytes[b][answer] = (value >> (8 * b)) as u8);
        }
    }
}

/// Where the sums of a piece start, given the strides of rows and planes of the tile.
#[inline(always)]
pub(super) fn start([row, plane]: [usize; 2], strip: &Strip, piece: &Piece) -> usize {
    let (a, b) = (strip.axis, 1 - strip.axis);
    let (along, across) = if a == 0 { (plane, row) } else { (row, plane) };
    let from = |at: i64, axis: usize| (at - strip.tile.lo[axis]) as usize;
    from(piece.along, a) * along + from(piece.across, b) * across + from(piece.from, 2)
}

/// Adds the contributions of both senses to the sums of a tile in its frame; an empty slice of answers is
/// a sense that is not swept.
pub(super) fn add<H: Hit>(
    level: Level,
    sums: &mut [u32],
    strides: [usize; 2],
    forward: &[H],
    backward: &[H],
    visit: &Visit,
    strip: &Strip,
) {
    #[cfg(target_arch = "x86_64")]
    if let (Level::Avx512, Some(f), Some(b)) = (level, H::as_bytes(forward), H::as_bytes(backward)) {
        // SAFETY: the level says that the CPU has AVX-512; a table has `reach + 1` entries.
        return unsafe {
            match visit.reach {
                0..64 => add_bytes::<1>(sums, strides, f, b, visit, strip),
                64..128 => add_bytes::<2>(sums, strides, f, b, visit, strip),
                _ => add_bytes::<4>(sums, strides, f, b, visit, strip),
            }
        };
    }
    let _ = level;
    for piece in strip.pieces(visit) {
        let sums = &mut sums[start(strides, strip, &piece)..][..piece.answers.len()];
        for (answers, table) in [(forward, visit.tables[0]), (backward, visit.tables[1])] {
            if answers.is_empty() {
                continue;
            }
            for (sum, answer) in sums.iter_mut().zip(&answers[piece.answers.clone()]) {
                *sum += table[answer.steps()];
            }
        }
    }
}

/// Looks up 64 answers at once in tables of `64 * REGISTERS` bytes, and widens.
///
/// # Safety
/// The CPU must have [`Level::Avx512`].
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
unsafe fn add_bytes<const REGISTERS: usize>(
    sums: &mut [u32],
    strides: [usize; 2],
    forward: &[u8],
    backward: &[u8],
    visit: &Visit,
    strip: &Strip,
) {
    use std::arch::x86_64::*;
    let zero = _mm512_setzero_si512();
    // Interleaving works inside 128-bit lanes: lane L, bytes 4 g.. become 32-bit lanes 4 L.. of register g.
    let order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
    for piece in strip.pieces(visit) {
        let (from, len) = (piece.answers.start, piece.answers.len());
        let sums = &mut sums[start(strides, strip, &piece)..][..len];
        assert!(len <= LANES);
        let mask = u64::MAX >> (64 - len.max(1));
        let whole = len == LANES;
        let mut out: [__m512i; 4] = [zero; 4];
        for (g, out) in out.iter_mut().enumerate() {
            let at = sums.as_ptr().wrapping_add(16 * g);
            // SAFETY: all 64 sums, or masked to those that are there.
            *out = unsafe {
                if whole {
                    _mm512_loadu_epi32(at.cast())
                } else {
                    _mm512_maskz_loadu_epi32((mask >> (16 * g)) as u16, at.cast())
                }
            };
        }
        for (answers, table) in [forward, backward].into_iter().zip(visit.bytes) {
            if answers.is_empty() {
                continue;
            }
            let answers = &answers[from..][..len];
            // SAFETY: masked to the elements of `answers`.
            let index = unsafe { _mm512_maskz_loadu_epi8(mask, answers.as_ptr().cast()) };
            let index = _mm512_permutexvar_epi32(order, index);
            let high = _mm512_movepi8_mask(index);
            let [b0, b1, b2]: [__m512i; 3] = std::array::from_fn(|b| {
                // SAFETY: tables have 256 bytes.
                let part = |r: usize| unsafe { _mm512_loadu_si512(table[b].as_ptr().add(64 * r).cast()) };
                match REGISTERS {
                    1 => _mm512_permutexvar_epi8(index, part(0)),
                    2 => _mm512_permutex2var_epi8(part(0), index, part(1)),
                    _ => {
                        let low = _mm512_permutex2var_epi8(part(0), index, part(1));
                        _mm512_mask_blend_epi8(high, low, _mm512_permutex2var_epi8(part(2), index, part(3)))
                    }
                }
            });
            let (low, high) = (_mm512_unpacklo_epi8(b0, b1), _mm512_unpackhi_epi8(b0, b1));
            let (low2, high2) = (_mm512_unpacklo_epi8(b2, zero), _mm512_unpackhi_epi8(b2, zero));
            out[0] = _mm512_add_epi32(out[0], _mm512_unpacklo_epi16(low, low2));
            out[1] = _mm512_add_epi32(out[1], _mm512_unpackhi_epi16(low, low2));
            out[2] = _mm512_add_epi32(out[2], _mm512_unpacklo_epi16(high, high2));
            out[3] = _mm512_add_epi32(out[3], _mm512_unpackhi_epi16(high, high2));
        }
        for (g, out) in out.into_iter().enumerate() {
            let to = sums.as_mut_ptr().wrapping_add(16 * g);
            // SAFETY: all 64 sums, or masked to those that are there.
            unsafe {
                if whole {
                    _mm512_storeu_epi32(to.cast(), out)
                } else {
                    _mm512_mask_storeu_epi32(to.cast(), (mask >> (16 * g)) as u16, out)
                }
            }
        }
    }
}
