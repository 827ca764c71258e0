//! Sheets turned so that lines are contiguous, and answers turned back, by AVX-512.
//!
//! Four pieces of 16 bytes, a quarter of a register each, come from rows that stand a quarter of a block apart; turning
//! the squares inside the quarters by rounds of interleaving then leaves whole lines in registers: one shuffle and one
//! load per 64 bytes and round, no shuffle across quarters. 2-core Zen 4 VM, AVX-512, 2026-11-26: see
//! benches/results/obscurance.md.

use std::arch::x86_64::*;

use super::keys::LANES;

/// `[f(0), f(1), ..]` in straight code: loops over arrays of registers end up in memory.
macro_rules! each {
    ([$($n:literal)*] $i:ident => $e:expr) => { [$({ const $i: usize = $n; $e }),*] };
}
pub(super) use each;

/// One round of turning a square of [`GROUP`] elements: each rotates the address (row, column) by one bit.
macro_rules! round {
    ($lo:ident, $hi:ident, $t:ident, [$($i:literal $j:literal)*]) => { [$($lo($t[$i], $t[$j]), $hi($t[$i], $t[$j])),*] };
}

/// A register whose quarters hold the 16 bytes at four places.
///
/// # Safety
/// The places are readable; the CPU has AVX-512.
#[target_feature(enable = "avx512f")]
#[inline]
unsafe fn quarters(at: [*const u8; 4]) -> __m512i {
    // SAFETY: the caller's promise.
    unsafe {
        let [a, b, c, d] = at.map(|p| _mm_loadu_si128(p.cast()));
        let v = _mm512_broadcast_i32x4(a);
        let v = _mm512_mask_broadcast_i32x4(v, 0x00f0, b);
        let v = _mm512_mask_broadcast_i32x4(v, 0x0f00, c);
        _mm512_mask_broadcast_i32x4(v, 0xf000, d)
    }
}

macro_rules! turn {
    ($name:ident, $size:literal, group $group:tt, [$($n:literal)*], rounds $(($lo:ident $hi:ident $pairs:tt))*) => {
        /// Turns 64 bytes of each of 64 lines: row `i` starts at `data + rows[i] * size`, and line `l` is written to
        /// `lines + l * stride` (bytes).
        ///
        /// # Safety
        /// 64 elements at every row, 64 bytes at every line; the CPU has AVX-512.
        #[target_feature(enable = "avx512f,avx512bw")]
        unsafe fn $name(data: *const u8, rows: &[usize; LANES], lines: *mut u8, stride: usize) {
            const GROUP: usize = $group;
            for chunk in 0..LANES / GROUP {
                // SAFETY: pieces of the rows and of the lines.
                unsafe {
                    let t = each!([$($n)*] I => quarters([0, 1, 2, 3].map(|g| {
                        data.add(rows[g * GROUP + I] * $size + chunk * 16)
                    })));
                    $(let t = round!($lo, $hi, t, $pairs);)*
                    let to = lines.add(chunk * GROUP * stride);
                    each!([$($n)*] I => _mm512_storeu_si512(to.add(I * stride).cast(), t[I]));
                }
            }
        }
    };
}

turn!(turn_1, 1, group 16, [0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15], rounds
    (_mm512_unpacklo_epi8 _mm512_unpackhi_epi8 [0 8 1 9 2 10 3 11 4 12 5 13 6 14 7 15])
    (_mm512_unpacklo_epi8 _mm512_unpackhi_epi8 [0 8 1 9 2 10 3 11 4 12 5 13 6 14 7 15])
    (_mm512_unpacklo_epi8 _mm512_unpackhi_epi8 [0 8 1 9 2 10 3 11 4 12 5 13 6 14 7 15])
    (_mm512_unpacklo_epi8 _mm512_unpackhi_epi8 [0 8 1 9 2 10 3 11 4 12 5 13 6 14 7 15]));
turn!(turn_2, 2, group 8, [0 1 2 3 4 5 6 7], rounds
    (_mm512_unpacklo_epi16 _mm512_unpackhi_epi16 [0 4 1 5 2 6 3 7])
    (_mm512_unpacklo_epi16 _mm512_unpackhi_epi16 [0 4 1 5 2 6 3 7])
    (_mm512_unpacklo_epi16 _mm512_unpackhi_epi16 [0 4 1 5 2 6 3 7]));
turn!(turn_4, 4, group 4, [0 1 2 3], rounds
    (_mm512_unpacklo_epi32 _mm512_unpackhi_epi32 [0 2 1 3])
    (_mm512_unpacklo_epi32 _mm512_unpackhi_epi32 [0 2 1 3]));
turn!(turn_8, 8, group 2, [0 1], rounds
    (_mm512_unpacklo_epi64 _mm512_unpackhi_epi64 [0 1]));

/// Turns one block of a sheet of keys of `size` bytes: `64 / size` rows of 64 keys, `rows[i]` keys into `data`, become
/// 64 bytes of each of 64 lines, `stride` bytes apart.
///
/// # Safety
/// 64 keys at every row, 64 bytes at every line; the CPU has AVX-512.
#[target_feature(enable = "avx512f,avx512bw")]
pub(super) unsafe fn turn(size: usize, data: *const u8, rows: &[usize; LANES], lines: *mut u8, stride: usize) {
    // SAFETY: the caller's promise.
    unsafe {
        match size {
            1 => turn_1(data, rows, lines, stride),
            2 => turn_2(data, rows, lines, stride),
            4 => turn_4(data, rows, lines, stride),
            _ => turn_8(data, rows, lines, stride),
        }
    }
}

/// Turns answers `[line][query]` (64 rows of `stride` bytes) into rows of 64 lines per query.
///
/// # Safety
/// `stride` at least `count` rounded up to 64; the CPU has AVX-512.
#[target_feature(enable = "avx512f,avx512bw")]
pub(super) unsafe fn turn_back(answers: *const u8, stride: usize, count: usize, hits: &mut [u8]) {
    assert!(hits.len() >= count * LANES);
    let rows: [usize; LANES] = std::array::from_fn(|line| line * stride);
    let (whole, part) = (count / 64 * 64, count % 64);
    for block in (0..whole).step_by(64) {
        // SAFETY: 64 queries of 64 lines; `hits` has a row for each.
        unsafe { turn_1(answers.add(block), &rows, hits.as_mut_ptr().add(block * LANES), LANES) };
    }
    if part > 0 {
        let mut last = [0; 64 * LANES];
        // SAFETY: `stride` is long enough for a whole block.
        unsafe { turn_1(answers.add(whole), &rows, last.as_mut_ptr(), LANES) };
        hits[whole * LANES..count * LANES].copy_from_slice(&last[..part * LANES]);
    }
}
