//! Adds the contributions of a row of answers to a row of sums.

use super::scan::Hit;
use super::sinks::Visit;
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

/// `sums[i] += table[answers[i]]` for both senses; an empty slice is a sense that is not swept.
pub(super) fn add<H: Hit>(level: Level, sums: &mut [u32], forward: &[H], backward: &[H], visit: &Visit) {
    #[cfg(target_arch = "x86_64")]
    if let (Level::Avx512, Some(f), Some(b)) = (level, H::as_bytes(forward), H::as_bytes(backward)) {
        // SAFETY: the level says that the CPU has AVX-512; a table has `reach + 1` entries.
        return unsafe {
            match visit.reach {
                0..64 => add_bytes::<1>(sums, f, b, visit.bytes),
                64..128 => add_bytes::<2>(sums, f, b, visit.bytes),
                _ => add_bytes::<4>(sums, f, b, visit.bytes),
            }
        };
    }
    let _ = level;
    for (answers, table) in [(forward, visit.tables[0]), (backward, visit.tables[1])] {
        for (sum, answer) in sums.iter_mut().zip(answers) {
            *sum += table[answer.steps()];
        }
    }
}

/// Looks up 64 answers at once in tables of `64 * REGISTERS` bytes, and widens.
///
/// # Safety
/// The CPU must have [`Level::Avx512`].
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,bmi1,bmi2,lzcnt,popcnt")]
unsafe fn add_bytes<const REGISTERS: usize>(sums: &mut [u32], forward: &[u8], backward: &[u8], tables: &ByteTables) {
    use std::arch::x86_64::*;
    let len = sums.len();
    assert!(len <= 64 && (forward.is_empty() || forward.len() == len));
    assert!(backward.is_empty() || backward.len() == len);
    let mask = u64::MAX >> (64 - len.max(1));
    let zero = _mm512_setzero_si512();
    // Interleaving works inside 128-bit lanes: lane L, bytes 4 g.. become 32-bit lanes 4 L.. of register g.
    let order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
    let mut out: [__m512i; 4] = std::array::from_fn(|g| {
        // SAFETY: masked to the elements of `sums`.
        unsafe { _mm512_maskz_loadu_epi32((mask >> (16 * g)) as u16, sums.as_ptr().wrapping_add(16 * g).cast()) }
    });
    for (answers, table) in [forward, backward].into_iter().zip(tables) {
        if answers.is_empty() {
            continue;
        }
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
        let wide = [
            _mm512_unpacklo_epi16(low, low2),
            _mm512_unpackhi_epi16(low, low2),
            _mm512_unpacklo_epi16(high, high2),
            _mm512_unpackhi_epi16(high, high2),
        ];
        for (out, wide) in out.iter_mut().zip(wide) {
            *out = _mm512_add_epi32(*out, wide);
        }
    }
    for (g, out) in out.into_iter().enumerate() {
        // SAFETY: masked to the elements of `sums`.
        unsafe {
            let to = sums.as_mut_ptr().wrapping_add(16 * g);
            _mm512_mask_storeu_epi32(to.cast(), (mask >> (16 * g)) as u16, out);
        }
    }
}
