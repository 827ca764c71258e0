//! Arrays between stages to output types.

use super::simd::Level;
use crate::grid::{AnyView, AnyViewMut, DType, Voxel};
use crate::with_view;

/// How a channel's values become an output type.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mapping {
    /// Integer outputs: values `lo` and `hi` map to 0 and the type's maximum (computed in f64, round half even,
    /// saturating between the two; of single floats in [0, 1] as [`unit_code`] says); `None` keeps values (round half even, saturating to the type). Float outputs always
    /// keep values.
    pub range: Option<[f64; 2]>,
    /// Integer outputs: the stored code that NaN becomes.
    pub fill: f64,
}

impl Mapping {
    /// Values as they are.
    pub const KEEP: Mapping = Mapping { range: None, fill: 0.0 };

    /// Whether it is that of openness.
    pub fn is_unit(&self) -> bool {
        self.range == Some([0.0, 1.0])
    }
}

/// Converts voxel by voxel on the best instruction set of this CPU. Panics if the shapes differ.
pub fn convert(src: AnyView, mapping: Mapping, dst: AnyViewMut) {
    convert_at(Level::detect(), src, mapping, dst)
}

/// Converts voxel by voxel. Panics if the shapes differ.
pub fn convert_at(level: Level, src: AnyView, mapping: Mapping, mut dst: AnyViewMut) {
    assert_eq!(src.shape(), dst.shape(), "conversion keeps the shape");
    let [nz, ny, _] = src.shape();
    let rows = (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y)));
    let fill = |dtype| Linear::new(mapping, dtype).fill;
    let in_unit = mapping.is_unit();
    match (src, &mut dst) {
        (AnyView::F32(s), AnyViewMut::U8(d)) if in_unit => {
            let fill = fill(DType::U8);
            rows.for_each(|(z, y)| unit(level, s.row_at(z, y), 255.0, fill, d.row_at(z, y)));
        }
        (AnyView::F32(s), AnyViewMut::U16(d)) if in_unit => {
            let fill = fill(DType::U16);
            rows.for_each(|(z, y)| unit(level, s.row_at(z, y), 65535.0, fill, d.row_at(z, y)));
        }
        (src, dst) => with_view!(AnyView, src, s => with_view!(AnyViewMut, dst, d => {
            for (z, y) in rows {
                convert_row(level, s.row_at(z, y), mapping, d.row_at(z, y));
            }
        })),
    }
}

/// Converts one row, single floats in [0, 1] excepted. Panics if the lengths differ.
pub fn convert_row<S: Voxel, D: Output>(level: Level, src: &[S], mapping: Mapping, dst: &mut [D]) {
    assert_eq!(src.len(), dst.len());
    if D::DTYPE.is_float() || (S::DTYPE == D::DTYPE && mapping.range.is_none()) {
        cast(level, src, dst)
    } else {
        quantise(level, src, Linear::new(mapping, D::DTYPE), dst)
    }
}

/// `code = clamp((v * half - lo) / width * top, low, high)` before rounding: the formula as it is written down, so that a
/// value half way between two codes goes where anyone who recomputes it puts it. (A single factor `top / width` moved 45
/// of [0, 50] from 229.5 to just below.)
#[derive(Debug, Clone, Copy)]
pub struct Linear {
    /// 0.5 where `hi - lo` would overflow, else 1.
    pub half: f64,
    pub lo: f64,
    pub width: f64,
    pub top: f64,
    pub low: f64,
    pub high: f64,
    /// What NaN becomes, inside the type's range.
    pub fill: f64,
}

impl Linear {
    /// Of a type of integers.
    pub fn new(mapping: Mapping, dtype: DType) -> Linear {
        let (least, high) = dtype.range();
        let fill = if mapping.fill.is_nan() { 0.0 } else { mapping.fill.clamp(least, high) };
        match mapping.range {
            None => Linear { half: 1.0, lo: 0.0, width: 1.0, top: 1.0, low: least, high, fill },
            Some([lo, hi]) => {
                let half = if (hi - lo).is_finite() { 1.0 } else { 0.5 };
                Linear { half, lo: lo * half, width: hi * half - lo * half, top: high, low: 0.0, high, fill }
            }
        }
    }
}

/// A type that can be stored.
pub trait Output: Voxel {
    /// The low bits as this type (integers; two's complement).
    fn from_low_bits(bits: u64) -> Self;
    /// The value rounded to this type (floats).
    fn from_value(v: f64) -> Self;
}

macro_rules! output {
    ($($t:ty)*) => {$(
        impl Output for $t {
            #[inline(always)]
            fn from_low_bits(bits: u64) -> Self { bits as $t }
            #[inline(always)]
            fn from_value(v: f64) -> Self { v as $t }
        }
    )*};
}
output!(u8 i8 u16 i16 u32 i32 f32 f64);

/// 1.5 * 2^52: adding it rounds a number below 2^51 to an integer, ties to even, and leaves it in the low bits. Cutting
/// it out of there takes 0.20 ns per voxel from f32 to u8, against 0.27 by a conversion to i32 (AVX-512, 2-core Zen 4 VM,
/// 2026-11-23; memcpy of the f32: 0.08 in the cache, 0.33 in memory).
const ROUNDER: f64 = 6755399441055744.0;

#[inline(always)]
fn quantise_inner<S: Voxel, D: Output>(src: &[S], map: Linear, dst: &mut [D]) {
    // The usual case, [0, 1] or no range, without the parts that do nothing to it.
    if map.half == 1.0 && map.lo == 0.0 && map.width == 1.0 {
        quantise_loop(src, Linear { half: 1.0, lo: 0.0, width: 1.0, ..map }, dst)
    } else {
        quantise_loop(src, map, dst)
    }
}

#[inline(always)]
fn quantise_loop<S: Voxel, D: Output>(src: &[S], map: Linear, dst: &mut [D]) {
    let Linear { half, lo, width, top, low, high, fill } = map;
    for (d, s) in dst.iter_mut().zip(src) {
        let v = s.to_f64();
        let t = (v * half - lo) / width * top;
        // Written as compares, not `clamp`, so that they become one instruction each; NaN becomes `low`.
        let t = if t > low { t } else { low };
        let t = if t < high { t } else { high };
        let t = if v.is_nan() { fill } else { t };
        *d = D::from_low_bits((t + ROUNDER).to_bits());
    }
}

/// Round half even of `top o` for `o` in [0, 1] and integers of up to 16 bits: 2^23 leaves the integer in the low bits, and single
/// floats of openness need no f64 on the way. The product is rounded to f32 before: a share that lies half way between two codes,
/// as 1/6 of 255, is seldom an f32, but the product of the nearest one is the half again, and goes to the even code.
#[inline(always)]
pub fn unit_code(o: f32, top: f32) -> u32 {
    (o * top + 8_388_608.0).to_bits() & 0xffff
}

#[inline(always)]
fn unit_inner<D: Output>(src: &[f32], top: f32, fill: f64, dst: &mut [D]) {
    let fill = (fill + ROUNDER).to_bits() as u32;
    for (d, s) in dst.iter_mut().zip(src) {
        // NaN becomes 0 here.
        let v = if *s > 0.0 { *s } else { 0.0 };
        let v = if v < 1.0 { v } else { 1.0 };
        *d = D::from_low_bits(if s.is_nan() { fill } else { unit_code(v, top) } as u64);
    }
}

#[inline(always)]
fn cast_inner<S: Voxel, D: Output>(src: &[S], dst: &mut [D]) {
    for (d, s) in dst.iter_mut().zip(src) {
        *d = D::from_value(s.to_f64());
    }
}

crate::multiversion! {
    fn quantise[S: Voxel, D: Output](src: &[S], map: Linear, dst: &mut [D]) -> () = quantise_inner;
}
crate::multiversion! {
    /// [`quantise`] of single floats in [0, 1] to integers of up to 16 bits, of which `top` is the largest.
    fn unit[D: Output](src: &[f32], top: f32, fill: f64, dst: &mut [D]) -> () = unit_inner;
}
crate::multiversion! {
    fn cast[S: Voxel, D: Output](src: &[S], dst: &mut [D]) -> () = cast_inner;
}

/// One value by the words of [`Mapping`], for checking [`convert`]; `single`: it was an f32.
#[cfg(test)]
fn reference<D: Voxel>(v: f64, single: bool, mapping: Mapping) -> D {
    if D::DTYPE.is_float() {
        return D::from_f64(v);
    }
    if v.is_nan() {
        return D::from_f64(mapping.fill);
    }
    match mapping.range {
        None => D::from_f64(v),
        Some([lo, hi]) => {
            let max = D::DTYPE.range().1;
            if single && mapping.is_unit() && max <= 65535.0 {
                return D::from_f64((v.clamp(0.0, 1.0) as f32 * max as f32) as f64);
            }
            D::from_f64(((v - lo) / (hi - lo) * max).clamp(0.0, max))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::Voxels;
    use crate::grid::{View, ViewMut};

    fn hostile(dtype: DType, n: usize) -> Voxels {
        let (lo, hi) = dtype.range();
        let mut values =
            vec![0.0, -0.0, 1.0, 0.5, 1.5, 2.5, -0.5, 254.5, 255.0, 65534.5, lo, hi, 1e-300, 0.1, 127.0, -1.0];
        if dtype.is_float() {
            values.extend([f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e30, -1e30, 4294967295.5, 2147483646.5]);
        }
        let mut state = 1u64;
        let mut v = Voxels::zeroed(dtype, n);
        crate::with_voxels!(&mut v, v => for (i, d) in v.iter_mut().enumerate() {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let random = (state >> 40) as f64 / 256.0 - 1000.0;
            *d = Voxel::from_f64(if i < values.len() { values[i] } else { random });
        });
        v
    }

    #[test]
    fn every_pair_of_types_equals_the_reference_at_every_level() {
        let shape = [3, 5, 37];
        let n = shape.iter().product();
        let mappings = [
            Mapping { range: None, fill: 7.0 },
            Mapping { range: Some([0.0, 1.0]), fill: 0.0 },
            Mapping { range: Some([-3.25, 1000.5]), fill: 255.0 },
        ];
        for from in DType::ALL {
            let src = hostile(from, n);
            for to in DType::ALL {
                for mapping in mappings {
                    for level in Level::available() {
                        let mut dst = Voxels::zeroed(to, n);
                        convert_at(level, src.view(shape), mapping, dst.view_mut(shape));
                        let mut want = Voxels::zeroed(to, n);
                        crate::with_voxels!(&mut want, w => for (i, w) in w.iter_mut().enumerate() {
                            *w = reference(src.at(i), from == DType::F32, mapping);
                        });
                        assert_eq!(dst.as_bytes(), want.as_bytes(), "{from} -> {to}, {mapping:?}, {level:?}");
                    }
                }
            }
        }
    }

    fn codes_of(values: &[f32], dtype: DType) -> Vec<u32> {
        let (shape, unit) = ([1, 1, values.len()], Mapping { range: Some([0.0, 1.0]), fill: 0.0 });
        let mut codes = Voxels::zeroed(dtype, values.len());
        convert(AnyView::F32(View::dense(values, shape)), unit, codes.view_mut(shape));
        (0..values.len()).map(|i| codes.at(i) as u32).collect()
    }

    /// The f32 next to every half code goes to the even code, and its neighbours, which the half is not, to their own.
    #[test]
    fn openness_half_way_between_two_codes_goes_to_the_even_one() {
        for (dtype, top) in [(DType::U8, 255u32), (DType::U16, 65535)] {
            let half = |code: u32| ((code as f64 + 0.5) / top as f64) as f32;
            let next = |v: f32, by: i32| f32::from_bits(v.to_bits().wrapping_add_signed(by));
            let values: Vec<f32> = (0..top).flat_map(|c| [half(c), next(half(c), 2), next(half(c), -2)]).collect();
            let codes = codes_of(&values, dtype);
            for (code, three) in (0..top).zip(codes.as_chunks::<3>().0) {
                assert_eq!(*three, [code + code % 2, code + 1, code], "{code} and a half of {top}");
            }
        }
        // Shares of windows with an even number of voxels.
        let shares = [[1.0, 6.0], [3.0, 10.0], [33.0, 34.0], [1.0, 2.0], [1.0, 1.0], [0.0, 9.0]];
        let shares = shares.map(|[k, n]: [f64; 2]| (k / n) as f32);
        assert_eq!(codes_of(&shares, DType::U8), [42, 76, 248, 128, 255, 0]);
    }

    #[test]
    fn a_value_half_way_between_two_codes_goes_to_the_even_one() {
        let mapping = Mapping { range: Some([0.0, 50.0]), fill: 0.0 };
        let mut codes = [0u8; 3];
        convert_row(Level::detect(), &[45u8, 5, 15], mapping, &mut codes);
        assert_eq!(codes, [230, 26, 76], "229.5, 25.5 and 76.5");
    }

    #[test]
    fn a_range_wider_than_f64_still_maps_its_middle_to_the_middle() {
        let mapping = Mapping { range: Some([-1.7e308, 1.7e308]), fill: 0.0 };
        let mut codes = [9u8; 4];
        let values = [-1.7e308, 0.0, 1.7e308, f64::NEG_INFINITY];
        convert_row(Level::Baseline, &values, mapping, &mut codes);
        assert_eq!(codes, [0, 128, 255, 0]);
    }

    #[test]
    fn strided_views_convert_only_their_rows() {
        let src: Vec<f32> = (0..60).map(|i| i as f32).collect();
        let mut dst = vec![200u8; 60];
        let (shape, plane, row) = ([2, 2, 3], 30, 5);
        convert(
            AnyView::F32(View::strided(&src, shape, plane, row)),
            Mapping::KEEP,
            AnyViewMut::U8(ViewMut::strided(&mut dst, shape, plane, row)),
        );
        let inside = |i: usize| i % 30 < 10 && i % 5 < 3;
        assert!((0..60).all(|i| dst[i] == if inside(i) { i as u8 } else { 200 }));
    }
}
