//! Instruction sets, chosen at run time: one portable binary.
//!
//! Results never depend on the level: fused multiply-adds are written as `mul_add`, which a CPU without them computes
//! in software, and no kernel lets the compiler reorder float arithmetic.

/// Instruction sets with kernels of their own, least first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Level {
    /// What every x86-64 (and any other architecture) has.
    Baseline,
    /// AVX2 with FMA, BMI1, BMI2, LZCNT and POPCNT.
    Avx2,
    /// AVX-512 F, BW, DQ, VL and VBMI.
    Avx512,
}

impl Level {
    /// The best level of this CPU.
    pub fn detect() -> Level {
        #[cfg(target_arch = "x86_64")]
        {
            // All that the functions of a level are compiled for: a hypervisor may hide some of it.
            let avx2 = is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2")
                && is_x86_feature_detected!("lzcnt")
                && is_x86_feature_detected!("popcnt");
            let avx512 = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512vbmi");
            if avx2 && avx512 {
                return Level::Avx512;
            }
            if avx2 {
                return Level::Avx2;
            }
        }
        Level::Baseline
    }

    /// Every level that this CPU can run, least first.
    pub fn available() -> Vec<Level> {
        [Level::Baseline, Level::Avx2, Level::Avx512].into_iter().filter(|l| *l <= Level::detect()).collect()
    }
}

/// Asks for the cache lines of a row that is read or written soon, and that the CPU cannot foresee.
#[inline(always)]
pub fn fetch<T>(row: &[T]) {
    #[cfg(target_arch = "x86_64")]
    for line in row.chunks((64 / size_of::<T>()).max(1)) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint, which touches nothing, and every x86-64 has it.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(line.as_ptr().cast()) };
    }
    let _ = row;
}

/// Makes `fn name(level, args..)`, which runs the `#[inline(always)]` function `inner(args..)` compiled for that level:
/// `multiversion! { pub fn name['a, T: Voxel](src: &'a [T], dst: &mut [T]) -> () = inner; }` (the brackets hold the
/// generics and may be empty). The caller promises that the CPU has the level, which [`Level::detect`] and
/// [`Level::available`] see to.
#[macro_export]
macro_rules! multiversion {
    ($(#[$meta:meta])* $vis:vis fn $name:ident [$($gen:tt)*] ($($arg:ident : $ty:ty),* $(,)?) -> $ret:ty = $inner:path;) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name<$($gen)*>(level: $crate::kernel::simd::Level, $($arg: $ty),*) -> $ret {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
                #[allow(clippy::too_many_arguments)]
                fn avx512<$($gen)*>($($arg: $ty),*) -> $ret { $inner($($arg),*) }
                #[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
                #[allow(clippy::too_many_arguments)]
                fn avx2<$($gen)*>($($arg: $ty),*) -> $ret { $inner($($arg),*) }
                match level {
                    // SAFETY: a `Level` above `Baseline` comes from `detect` or `available`, which asked the CPU.
                    $crate::kernel::simd::Level::Avx512 => return unsafe { avx512($($arg),*) },
                    // SAFETY: as above.
                    $crate::kernel::simd::Level::Avx2 => return unsafe { avx2($($arg),*) },
                    $crate::kernel::simd::Level::Baseline => {}
                }
            }
            let _ = level;
            $inner($($arg),*)
        }
    };
}
