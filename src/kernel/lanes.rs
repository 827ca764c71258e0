//! Eight f64 at once on every instruction set: one body of a kernel, compiled for each by [`crate::on_lanes`]. Compilers
//! do vectorise loops over `[f64; 8]`, but not a block of a hundred values that live in registers.

/// Lanes of a [`F64x8`].
pub const LANES: usize = 8;

/// Eight f64. All operations are IEEE and lane by lane, so every implementation gives the same bits.
///
/// The methods of an implementation may only be called where the CPU has its instruction set, which is why
/// [`crate::on_lanes`] is the one place that names an implementation.
pub trait F64x8: Copy {
    fn splat(v: f64) -> Self;
    /// # Safety
    /// Eight values can be read there.
    unsafe fn load(from: *const f64) -> Self;
    /// # Safety
    /// Eight values can be read there.
    unsafe fn load_f32(from: *const f32) -> Self;
    /// # Safety
    /// Eight values can be written there.
    unsafe fn store(self, to: *mut f64);
    fn plus(self, o: Self) -> Self;
    fn minus(self, o: Self) -> Self;
    fn times(self, o: Self) -> Self;
    fn over(self, o: Self) -> Self;
    /// `self * b + c`, rounded once.
    fn fused(self, b: Self, c: Self) -> Self;
    /// `c - self * b`, rounded once.
    fn less(self, b: Self, c: Self) -> Self;
    /// `self` where `sign > 0`, else 0.
    fn where_positive(self, sign: Self) -> Self;
    /// `self` where `sign > 0`, else `other`.
    fn choose(self, sign: Self, other: Self) -> Self;
    /// Whether every lane is above 0.
    fn all_positive(self) -> bool;
    /// `self`, or 0 where it is NaN; and 1 or 0 accordingly.
    fn present(self) -> [Self; 2];
    /// Rows become columns.
    fn turn(rows: [Self; 8]) -> [Self; 8];
}

/// Any CPU.
#[derive(Clone, Copy)]
pub struct Plain([f64; LANES]);

impl Plain {
    #[inline(always)]
    fn zip(self, o: Plain, f: impl Fn(f64, f64) -> f64) -> Plain {
        Plain(std::array::from_fn(|i| f(self.0[i], o.0[i])))
    }
}

impl F64x8 for Plain {
    #[inline(always)]
    fn splat(v: f64) -> Self {
        Plain([v; LANES])
    }
    #[inline(always)]
    unsafe fn load(from: *const f64) -> Self {
        // SAFETY: the caller's promise.
        Plain(unsafe { from.cast::<[f64; LANES]>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn load_f32(from: *const f32) -> Self {
        // SAFETY: the caller's promise.
        Plain(unsafe { from.cast::<[f32; LANES]>().read_unaligned() }.map(f64::from))
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f64) {
        // SAFETY: the caller's promise.
        unsafe { to.cast::<[f64; LANES]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    fn plus(self, o: Self) -> Self {
        self.zip(o, |a, b| a + b)
    }
    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        self.zip(o, |a, b| a - b)
    }
    #[inline(always)]
    fn times(self, o: Self) -> Self {
        self.zip(o, |a, b| a * b)
    }
    #[inline(always)]
    fn over(self, o: Self) -> Self {
        self.zip(o, |a, b| a / b)
    }
    #[inline(always)]
    fn fused(self, b: Self, c: Self) -> Self {
        Plain(std::array::from_fn(|i| self.0[i].mul_add(b.0[i], c.0[i])))
    }
    #[inline(always)]
    fn less(self, b: Self, c: Self) -> Self {
        Plain(std::array::from_fn(|i| (-self.0[i]).mul_add(b.0[i], c.0[i])))
    }
    #[inline(always)]
    fn where_positive(self, sign: Self) -> Self {
        self.zip(sign, |v, s| if s > 0.0 { v } else { 0.0 })
    }
    #[inline(always)]
    fn choose(self, sign: Self, other: Self) -> Self {
        Plain(std::array::from_fn(|i| if sign.0[i] > 0.0 { self.0[i] } else { other.0[i] }))
    }
    #[inline(always)]
    fn all_positive(self) -> bool {
        self.0.iter().all(|v| *v > 0.0)
    }
    #[inline(always)]
    fn present(self) -> [Self; 2] {
        let there = self.0.map(|v| !v.is_nan());
        let pick = |v: [f64; LANES]| Plain(std::array::from_fn(|i| if there[i] { v[i] } else { 0.0 }));
        [pick(self.0), pick([1.0; LANES])]
    }
    #[inline(always)]
    fn turn(rows: [Self; 8]) -> [Self; 8] {
        std::array::from_fn(|i| Plain(std::array::from_fn(|j| rows[j].0[i])))
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::F64x8;

    /// AVX2 and FMA.
    #[derive(Clone, Copy)]
    pub struct Avx2([__m256d; 2]);

    /// AVX-512 F.
    #[derive(Clone, Copy)]
    pub struct Avx512(__m512d);

    // SAFETY of every `unsafe` block below: the type's methods are called only where the CPU has its instruction set (the
    // trait's condition); pointers are the caller's promise.
    impl F64x8 for Avx512 {
        #[inline(always)]
        fn splat(v: f64) -> Self {
            Avx512(unsafe { _mm512_set1_pd(v) })
        }
        #[inline(always)]
        unsafe fn load(from: *const f64) -> Self {
            Avx512(unsafe { _mm512_loadu_pd(from) })
        }
        #[inline(always)]
        unsafe fn load_f32(from: *const f32) -> Self {
            Avx512(unsafe { _mm512_cvtps_pd(_mm256_loadu_ps(from)) })
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut f64) {
            unsafe { _mm512_storeu_pd(to, self.0) }
        }
        #[inline(always)]
        fn plus(self, o: Self) -> Self {
            Avx512(unsafe { _mm512_add_pd(self.0, o.0) })
        }
        #[inline(always)]
        fn minus(self, o: Self) -> Self {
            Avx512(unsafe { _mm512_sub_pd(self.0, o.0) })
        }
        #[inline(always)]
        fn times(self, o: Self) -> Self {
            Avx512(unsafe { _mm512_mul_pd(self.0, o.0) })
        }
        #[inline(always)]
        fn over(self, o: Self) -> Self {
            Avx512(unsafe { _mm512_div_pd(self.0, o.0) })
        }
        #[inline(always)]
        fn fused(self, b: Self, c: Self) -> Self {
            Avx512(unsafe { _mm512_fmadd_pd(self.0, b.0, c.0) })
        }
        #[inline(always)]
        fn less(self, b: Self, c: Self) -> Self {
            Avx512(unsafe { _mm512_fnmadd_pd(self.0, b.0, c.0) })
        }
        #[inline(always)]
        fn where_positive(self, sign: Self) -> Self {
            let mask = unsafe { _mm512_cmp_pd_mask::<_CMP_GT_OQ>(sign.0, _mm512_setzero_pd()) };
            Avx512(unsafe { _mm512_maskz_mov_pd(mask, self.0) })
        }
        #[inline(always)]
        fn choose(self, sign: Self, other: Self) -> Self {
            let mask = unsafe { _mm512_cmp_pd_mask::<_CMP_GT_OQ>(sign.0, _mm512_setzero_pd()) };
            Avx512(unsafe { _mm512_mask_mov_pd(other.0, mask, self.0) })
        }
        #[inline(always)]
        fn all_positive(self) -> bool {
            unsafe { _mm512_cmp_pd_mask::<_CMP_GT_OQ>(self.0, _mm512_setzero_pd()) == 0xff }
        }
        #[inline(always)]
        fn present(self) -> [Self; 2] {
            let there = unsafe { _mm512_cmp_pd_mask::<_CMP_ORD_Q>(self.0, self.0) };
            unsafe {
                [Avx512(_mm512_maskz_mov_pd(there, self.0)), Avx512(_mm512_maskz_mov_pd(there, _mm512_set1_pd(1.0)))]
            }
        }
        /// Three rounds, each of which rotates the address of a value (3 bits of row, 3 of column) by one.
        #[inline(always)]
        fn turn(rows: [Self; 8]) -> [Self; 8] {
            let (low, high) =
                unsafe { (_mm512_set_epi64(11, 3, 10, 2, 9, 1, 8, 0), _mm512_set_epi64(15, 7, 14, 6, 13, 5, 12, 4)) };
            let mut t = rows;
            for _ in 0..3 {
                let from = t;
                for i in 0..4 {
                    let (a, b) = (from[i].0, from[i + 4].0);
                    t[2 * i] = Avx512(unsafe { _mm512_permutex2var_pd(a, low, b) });
                    t[2 * i + 1] = Avx512(unsafe { _mm512_permutex2var_pd(a, high, b) });
                }
            }
            t
        }
    }

    /// An operation on both halves. Macros and functions, never closures: the compiler must inline all of it.
    macro_rules! halves {
        ($op:ident, $($operand:expr),*) => {
            unsafe { Avx2([$op($($operand.0[0]),*), $op($($operand.0[1]),*)]) }
        };
    }

    #[inline(always)]
    unsafe fn positive(v: __m256d, sign: __m256d) -> __m256d {
        unsafe { _mm256_and_pd(v, _mm256_cmp_pd::<_CMP_GT_OQ>(sign, _mm256_setzero_pd())) }
    }

    #[inline(always)]
    unsafe fn chosen(v: __m256d, sign: __m256d, other: __m256d) -> __m256d {
        unsafe { _mm256_blendv_pd(other, v, _mm256_cmp_pd::<_CMP_GT_OQ>(sign, _mm256_setzero_pd())) }
    }

    #[inline(always)]
    unsafe fn positives(v: __m256d) -> i32 {
        unsafe { _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_GT_OQ>(v, _mm256_setzero_pd())) }
    }

    #[inline(always)]
    unsafe fn ordered(v: __m256d, with: __m256d) -> __m256d {
        unsafe { _mm256_and_pd(v, _mm256_cmp_pd::<_CMP_ORD_Q>(with, with)) }
    }

    /// Transposes half `half` of four rows.
    #[inline(always)]
    unsafe fn quarter(rows: &[Avx2; 8], row: usize, half: usize) -> [__m256d; 4] {
        unsafe {
            let [p, q] = [rows[row].0[half], rows[row + 1].0[half]];
            let [r, s] = [rows[row + 2].0[half], rows[row + 3].0[half]];
            let (a, b) = (_mm256_unpacklo_pd(p, q), _mm256_unpackhi_pd(p, q));
            let (c, d) = (_mm256_unpacklo_pd(r, s), _mm256_unpackhi_pd(r, s));
            [
                _mm256_permute2f128_pd::<0x20>(a, c),
                _mm256_permute2f128_pd::<0x20>(b, d),
                _mm256_permute2f128_pd::<0x31>(a, c),
                _mm256_permute2f128_pd::<0x31>(b, d),
            ]
        }
    }

    impl F64x8 for Avx2 {
        #[inline(always)]
        fn splat(v: f64) -> Self {
            Avx2([unsafe { _mm256_set1_pd(v) }; 2])
        }
        #[inline(always)]
        unsafe fn load(from: *const f64) -> Self {
            Avx2(unsafe { [_mm256_loadu_pd(from), _mm256_loadu_pd(from.add(4))] })
        }
        #[inline(always)]
        unsafe fn load_f32(from: *const f32) -> Self {
            Avx2(unsafe { [_mm256_cvtps_pd(_mm_loadu_ps(from)), _mm256_cvtps_pd(_mm_loadu_ps(from.add(4)))] })
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut f64) {
            unsafe {
                _mm256_storeu_pd(to, self.0[0]);
                _mm256_storeu_pd(to.add(4), self.0[1]);
            }
        }
        #[inline(always)]
        fn plus(self, o: Self) -> Self {
            halves!(_mm256_add_pd, self, o)
        }
        #[inline(always)]
        fn minus(self, o: Self) -> Self {
            halves!(_mm256_sub_pd, self, o)
        }
        #[inline(always)]
        fn times(self, o: Self) -> Self {
            halves!(_mm256_mul_pd, self, o)
        }
        #[inline(always)]
        fn over(self, o: Self) -> Self {
            halves!(_mm256_div_pd, self, o)
        }
        #[inline(always)]
        fn fused(self, b: Self, c: Self) -> Self {
            halves!(_mm256_fmadd_pd, self, b, c)
        }
        #[inline(always)]
        fn less(self, b: Self, c: Self) -> Self {
            halves!(_mm256_fnmadd_pd, self, b, c)
        }
        #[inline(always)]
        fn where_positive(self, sign: Self) -> Self {
            halves!(positive, self, sign)
        }
        #[inline(always)]
        fn choose(self, sign: Self, other: Self) -> Self {
            halves!(chosen, self, sign, other)
        }
        #[inline(always)]
        fn all_positive(self) -> bool {
            unsafe { positives(self.0[0]) & positives(self.0[1]) == 0xf }
        }
        #[inline(always)]
        fn present(self) -> [Self; 2] {
            let one = Self::splat(1.0);
            [halves!(ordered, self, self), halves!(ordered, one, self)]
        }
        /// Four blocks of 4 x 4.
        #[inline(always)]
        fn turn(rows: [Self; 8]) -> [Self; 8] {
            let rows = &rows;
            let [a, b, c, d] =
                unsafe { [quarter(rows, 0, 0), quarter(rows, 4, 0), quarter(rows, 0, 1), quarter(rows, 4, 1)] };
            let [e, f, g, h] = [[a[0], b[0]], [a[1], b[1]], [a[2], b[2]], [a[3], b[3]]];
            let [i, j, k, l] = [[c[0], d[0]], [c[1], d[1]], [c[2], d[2]], [c[3], d[3]]];
            [Avx2(e), Avx2(f), Avx2(g), Avx2(h), Avx2(i), Avx2(j), Avx2(k), Avx2(l)]
        }
    }
}

/// Makes `fn name(level, args..)`, which runs the `#[inline(always)]` function `inner::<V, _>(args..)` with the lanes of
/// that level, as [`crate::multiversion`] does for plain loops.
#[macro_export]
macro_rules! on_lanes {
    ($($what:tt)*) => { $crate::on_vectors! { lanes $($what)* } };
}

/// [`crate::on_lanes`] for the implementations (`Plain`, `Avx2`, `Avx512`) of a module of `kernel`.
#[macro_export]
macro_rules! on_vectors {
    ($module:ident $(#[$meta:meta])* $vis:vis fn $name:ident [$($gen:tt)*] ($($arg:ident : $ty:ty),* $(,)?) = $inner:ident [$($pass:tt)*];) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name<$($gen)*>(level: $crate::kernel::simd::Level, $($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            {
                use $crate::kernel::{$module, simd::Level};
                #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
                #[allow(clippy::too_many_arguments)]
                fn avx512<$($gen)*>($($arg: $ty),*) { $inner::<$module::Avx512, $($pass)*>($($arg),*) }
                #[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
                #[allow(clippy::too_many_arguments)]
                fn avx2<$($gen)*>($($arg: $ty),*) { $inner::<$module::Avx2, $($pass)*>($($arg),*) }
                match level {
                    // SAFETY: a `Level` above `Baseline` comes from `detect` or `available`, which asked the CPU.
                    Level::Avx512 => return unsafe { avx512::<$($pass)*>($($arg),*) },
                    // SAFETY: as above.
                    Level::Avx2 => return unsafe { avx2::<$($pass)*>($($arg),*) },
                    Level::Baseline => {}
                }
            }
            let _ = level;
            $inner::<$crate::kernel::$module::Plain, $($pass)*>($($arg),*)
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::Level;

    /// Every operation on two rows of eight, and a transposition.
    #[inline(always)]
    fn all_inner<V: F64x8, const K: usize>(a: &[f64; 64], out: &mut Vec<f64>) {
        let mut put = |v: V| {
            let mut row = [0.0; 8];
            // SAFETY: eight values.
            unsafe { v.store(row.as_mut_ptr()) };
            out.extend(row);
        };
        // SAFETY: eight rows of eight.
        let rows: [V; 8] = std::array::from_fn(|i| unsafe { V::load(a[8 * i..].as_ptr()) });
        let [x, y, z, ..] = rows;
        let two = V::splat(2.0);
        [x.plus(y), x.minus(y), x.times(y), x.over(y), x.fused(y, z), x.less(y, z), x.where_positive(y), x.times(two)]
            .into_iter()
            .chain(V::turn(rows))
            .chain(y.present())
            .chain([x.choose(y, z), V::splat(x.all_positive().into()), V::splat(two.all_positive().into())])
            .for_each(&mut put);
        let single: [f32; 8] = std::array::from_fn(|i| i as f32 / 3.0);
        // SAFETY: eight values.
        put(unsafe { V::load_f32(single.as_ptr()) });
    }

    crate::on_lanes! { fn all[const K: usize](a: &[f64; 64], out: &mut Vec<f64>) = all_inner[K]; }

    #[test]
    fn every_level_gives_the_same_bits_and_turns() {
        let mut a: [f64; 64] = std::array::from_fn(|i| (i as f64 - 20.0) / 3.0);
        (a[9], a[10]) = (f64::NAN, f64::INFINITY);
        let mut first: Option<Vec<u64>> = None;
        for level in Level::available() {
            let mut out = Vec::new();
            all::<0>(level, &a, &mut out);
            assert!((0..64).all(|i| out[64 + i].to_bits() == a[i % 8 * 8 + i / 8].to_bits()));
            let bits: Vec<u64> = out.iter().map(|v| if v.is_nan() { 1 } else { v.to_bits() }).collect();
            assert_eq!(first.get_or_insert_with(|| bits.clone()), &bits, "{level:?}");
        }
    }
}
