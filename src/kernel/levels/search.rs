//! Codes of voxels by binary search in registers. With 32 levels at radius 10, where an output voxel needs about two codes: f32
//! compared with every level takes 3.4 ns per voxel, u16 through a table 1.5 and compared 1.7 (2-core Zen 4 VM, AVX-512,
//! 2026-11-26).

use super::MOST_LEVELS;
use crate::grid::Voxel;
use crate::kernel::simd::Level;

/// Writes how many of `levels` lie below each voxel of a row, in the order that `flipped` turns around; rubbish for NaN. Levels
/// ascend in that order. False, and nothing written, where there is no vector form.
pub(super) fn floats(level: Level, row: &[f32], levels: &[f32], flipped: bool, codes: &mut [u8]) -> bool {
    #[cfg(target_arch = "x86_64")]
    if level == Level::Avx512 {
        let turn = |v: f32| if flipped { -v } else { v };
        let mut table = [f32::INFINITY; MOST_LEVELS];
        table.iter_mut().zip(levels).for_each(|(t, l)| *t = turn(*l));
        let codes = &mut codes[..row.len()];
        // SAFETY: the level says that the CPU has AVX-512, and there is a code for every voxel.
        unsafe {
            if levels.len() > MOST_LEVELS / 2 {
                x86::floats::<true>(row, &table, flipped, codes);
            } else {
                x86::floats::<false>(row, &table, flipped, codes);
            }
        }
        return true;
    }
    let _ = (level, row, levels, flipped, codes);
    false
}

/// The same for words, whose order is that of `word ^ turn` as signed integers.
pub(super) fn words(level: Level, row: &[u16], levels: &[u16], turn: u16, codes: &mut [u8]) -> bool {
    #[cfg(target_arch = "x86_64")]
    if level == Level::Avx512 {
        let mut table = [i16::MAX; MOST_LEVELS];
        table.iter_mut().zip(levels).for_each(|(t, l)| *t = (l ^ turn) as i16);
        let codes = &mut codes[..row.len()];
        // SAFETY: the level says that the CPU has AVX-512, and there is a code for every voxel.
        unsafe {
            if levels.len() > MOST_LEVELS / 2 {
                x86::words::<true>(row, &table, turn, codes);
            } else {
                x86::words::<false>(row, &table, turn, codes);
            }
        }
        return true;
    }
    let _ = (level, row, levels, turn, codes);
    false
}

/// Writes `table[v ^ turn]` for each byte of a row: with u8 at radius 10, plain loads take 1 ns per output voxel of exact counts,
/// and this 0.1 (2-core Zen 4 VM, AVX-512, 2026-11-26).
pub(crate) fn bytes(level: Level, row: &[u8], table: &[u8; 256], turn: u8, codes: &mut [u8]) {
    #[cfg(target_arch = "x86_64")]
    if level == Level::Avx512 {
        // SAFETY: the level says that the CPU has AVX-512.
        return unsafe { x86::bytes(row, table, turn, codes) };
    }
    let _ = level;
    codes.iter_mut().zip(row).for_each(|(code, v)| *code = table[usize::from(v ^ turn)]);
}

/// A row of a type of 8 bits as bytes.
pub(crate) fn as_bytes<T: Voxel>(row: &[T]) -> Option<&[u8]> {
    (size_of::<T>() == 1).then(|| bytemuck::cast_slice(row))
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::MOST_LEVELS;

    /// # Safety
    /// The CPU must have AVX-512 with VBMI.
    #[target_feature(enable = "avx512f,avx512bw,avx512vbmi,bmi2")]
    pub unsafe fn bytes(row: &[u8], table: &[u8; 256], turn: u8, codes: &mut [u8]) {
        let turn = _mm512_set1_epi8(turn as i8);
        // SAFETY: the parts lie in the table; loads and stores are masked to chunks of the row and of the codes.
        unsafe {
            let parts: [__m512i; 4] = std::array::from_fn(|i| _mm512_loadu_si512(table.as_ptr().add(64 * i).cast()));
            for (row, codes) in row.chunks(64).zip(codes.chunks_mut(64)) {
                let lanes = u64::MAX >> (64 - row.len().min(codes.len()));
                let v = _mm512_xor_si512(_mm512_maskz_loadu_epi8(lanes, row.as_ptr().cast()), turn);
                let lower = _mm512_permutex2var_epi8(parts[0], v, parts[1]);
                let upper = _mm512_permutex2var_epi8(parts[2], v, parts[3]);
                let found = _mm512_mask_blend_epi8(_mm512_movepi8_mask(v), lower, upper);
                _mm512_mask_storeu_epi8(codes.as_mut_ptr().cast(), lanes, found);
            }
        }
    }

    /// `MORE`: there are more levels than the first half of the table holds.
    ///
    /// # Safety
    /// The CPU must have AVX-512, and `codes` be as long as `row`.
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
    pub unsafe fn floats<const MORE: bool>(row: &[f32], table: &[f32; MOST_LEVELS], flipped: bool, codes: &mut [u8]) {
        const HALF: usize = MOST_LEVELS / 2;
        let sign = _mm512_set1_epi32(if flipped { i32::MIN } else { 0 });
        // SAFETY: all loads lie in the table, and those of voxels are masked to the row, as are the codes.
        unsafe {
            let parts: [__m512; 4] = std::array::from_fn(|i| _mm512_loadu_ps(table.as_ptr().add(16 * i)));
            let middle = _mm512_set1_ps(table[HALF - 1]);
            for first in (0..row.len()).step_by(16) {
                let lanes = u16::MAX >> (16 - (row.len() - first).min(16));
                let v = _mm512_maskz_loadu_ps(lanes, row.as_ptr().add(first));
                let v = _mm512_castsi512_ps(_mm512_xor_si512(_mm512_castps_si512(v), sign));
                let upper = if MORE { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(middle, v) } else { 0 };
                let mut below = _mm512_setzero_si512();
                // Halves, and the last element that is left: 33 outcomes.
                for step in [16, 8, 4, 2, 1, 1] {
                    let at = _mm512_add_epi32(below, _mm512_set1_epi32(step - 1));
                    let mut probe = _mm512_permutex2var_ps(parts[0], at, parts[1]);
                    if MORE {
                        probe = _mm512_mask_blend_ps(upper, probe, _mm512_permutex2var_ps(parts[2], at, parts[3]));
                    }
                    let less = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(probe, v);
                    below = _mm512_mask_add_epi32(below, less, below, _mm512_set1_epi32(step));
                }
                let below = _mm512_mask_add_epi32(below, upper, below, _mm512_set1_epi32(HALF as i32));
                _mm512_mask_cvtepi32_storeu_epi8(codes.as_mut_ptr().add(first).cast(), lanes, below);
            }
        }
    }

    /// `MORE`: there are more levels than the first half of the table holds.
    ///
    /// # Safety
    /// The CPU must have AVX-512, and `codes` be as long as `row`.
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
    pub unsafe fn words<const MORE: bool>(row: &[u16], table: &[i16; MOST_LEVELS], turn: u16, codes: &mut [u8]) {
        let turn = _mm512_set1_epi16(turn as i16);
        // SAFETY: both loads lie in the table, and those of voxels are masked to the row, as are the codes.
        unsafe {
            let parts: [__m512i; 2] = std::array::from_fn(|i| _mm512_loadu_si512(table.as_ptr().add(32 * i).cast()));
            for first in (0..row.len()).step_by(32) {
                let lanes = u32::MAX >> (32 - (row.len() - first).min(32));
                let v = _mm512_xor_si512(_mm512_maskz_loadu_epi16(lanes, row.as_ptr().add(first).cast()), turn);
                let mut below = _mm512_setzero_si512();
                for step in [32, 16, 8, 4, 2, 1, 1].into_iter().skip(usize::from(!MORE)) {
                    let at = _mm512_add_epi16(below, _mm512_set1_epi16(step - 1));
                    let probe = if MORE {
                        _mm512_permutex2var_epi16(parts[0], at, parts[1])
                    } else {
                        _mm512_permutexvar_epi16(at, parts[0])
                    };
                    let less = _mm512_cmplt_epi16_mask(probe, v);
                    below = _mm512_mask_add_epi16(below, less, below, _mm512_set1_epi16(step));
                }
                _mm512_mask_cvtepi16_storeu_epi8(codes.as_mut_ptr().add(first).cast(), lanes, below);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::hostile::Noise;

    #[test]
    fn finds_as_many_levels_as_comparing_with_each() {
        let mut noise = Noise(11);
        for (case, count) in [0, 1, 2, 15, 16, 17, 31, 32, 33, 47, 63, 64].into_iter().enumerate() {
            let flipped = case % 2 == 1;
            let turn = |v: f32| if flipped { -v } else { v };
            let levels: Vec<f32> = (0..count).map(|k| turn(k as f32 * 3.0 - 20.0)).collect();
            let mut row: Vec<f32> = (0..101).map(|_| (noise.unit() * 260.0 - 40.0) as f32).collect();
            row.extend([f32::INFINITY, f32::NEG_INFINITY, 0.0, -0.0]);
            row.extend(&levels);
            let mut codes = vec![77; row.len()];
            if floats(Level::detect(), &row, &levels, flipped, &mut codes) {
                for (v, code) in row.iter().zip(codes) {
                    let expect = levels.iter().filter(|l| turn(**l) < turn(*v)).count();
                    assert_eq!(usize::from(code), expect, "{v} among {count} levels");
                }
            }
        }
    }

    #[test]
    fn looks_every_byte_up() {
        let table: [u8; 256] = std::array::from_fn(|i| (i * 167 + 13) as u8);
        let row: Vec<u8> = (0..=255).chain([7, 255, 128, 127, 0]).collect();
        for level in Level::available() {
            for turn in [0, 0xff, 0x80, 0x7f] {
                let mut codes = vec![77; row.len()];
                bytes(level, &row, &table, turn, &mut codes);
                assert!(row.iter().zip(&codes).all(|(v, code)| *code == table[usize::from(v ^ turn)]), "{level:?}");
            }
        }
    }

    #[test]
    fn finds_as_many_levels_of_words() {
        let mut noise = Noise(12);
        for (case, count) in [0, 1, 2, 31, 32, 33, 63, 64].into_iter().enumerate() {
            // Unsigned, signed, and both turned around.
            for turn in [0x8000, 0, 0x7fff, 0xffff] {
                let key = |v: u16| (v ^ turn) as i16;
                let mut levels: Vec<u16> = (0..count).map(|k| (k * 977 + case * 31) as u16 ^ 0x4000).collect();
                levels.sort_by_key(|v| key(*v));
                let mut row: Vec<u16> = (0..101).map(|_| noise.below(65536) as u16).collect();
                row.extend([0, 1, 0x7fff, 0x8000, 0xffff]);
                row.extend(&levels);
                let mut codes = vec![77; row.len()];
                if words(Level::detect(), &row, &levels, turn, &mut codes) {
                    for (v, code) in row.iter().zip(codes) {
                        let expect = levels.iter().filter(|l| key(**l) < key(*v)).count();
                        assert_eq!(usize::from(code), expect, "{v} among {count} levels, turned by {turn:#x}");
                    }
                }
            }
        }
    }
}
