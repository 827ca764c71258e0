//! 32 f32 at once on every instruction set, with the integer loads and bit operations that estimators need: one body of a
//! kernel, compiled for each by [`crate::on_singles`]. 32 lanes are two vectors or more everywhere, so the long chains of
//! two polynomials run side by side: as plain loops, one vector at a time, they waited for each other.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "x86_64")]
pub use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub use avx512::Avx512;

/// Lanes of an [`F32x32`].
pub const SINGLES: usize = 32;

/// 32 f32. All operations are IEEE and lane by lane, so every implementation gives the same bits.
///
/// The methods of an implementation may only be called where the CPU has its instruction set, which is why
/// [`crate::on_singles`] is the one place that names an implementation.
pub trait F32x32: Copy {
    /// One truth per lane.
    type Mask: Copy;
    /// 32 integers, whose arithmetic wraps.
    type Int: Copy;
    fn splat(v: f32) -> Self;
    /// # Safety
    /// 32 values can be read there; so for the loads below.
    unsafe fn load(from: *const f32) -> Self;
    /// Values XOR `flip`.
    ///
    /// # Safety
    /// As for [`F32x32::load`].
    unsafe fn load_u8(from: *const u8, flip: u8) -> Self::Int;
    /// Values XOR `flip`.
    ///
    /// # Safety
    /// As for [`F32x32::load`].
    unsafe fn load_u16(from: *const u16, flip: u16) -> Self::Int;
    /// # Safety
    /// As for [`F32x32::load`].
    unsafe fn load_u32(from: *const u32) -> Self::Int;
    fn less_int(a: Self::Int, b: Self::Int) -> Self::Int;
    fn times_int(a: Self::Int, b: Self::Int) -> Self::Int;
    /// Of signed values, rounded once.
    fn of_int(v: Self::Int) -> Self;
    /// # Safety
    /// 32 values can be written there.
    unsafe fn store(self, to: *mut f32);
    /// The lowest eight bits of every value.
    ///
    /// # Safety
    /// 32 codes can be written there.
    unsafe fn store_codes(self, to: *mut u8);
    fn plus(self, o: Self) -> Self;
    fn minus(self, o: Self) -> Self;
    fn times(self, o: Self) -> Self;
    fn over(self, o: Self) -> Self;
    fn root(self) -> Self;
    fn magnitude(self) -> Self;
    /// `self * b + c`, rounded once.
    fn fused(self, b: Self, c: Self) -> Self;
    /// `c - self * b`, rounded once.
    fn less(self, b: Self, c: Self) -> Self;
    /// `self` where it is greater than `o`, else `o`.
    fn greater(self, o: Self) -> Self;
    /// `self` where it is less than `o`, else `o`.
    fn lesser(self, o: Self) -> Self;
    fn is_below(self, o: Self) -> Self::Mask;
    fn equals(self, o: Self) -> Self::Mask;
    /// Sign bits.
    fn is_negative(self) -> Self::Mask;
    /// All bits are 0.
    fn is_blank(self) -> Self::Mask;
    fn all(mask: Self::Mask) -> bool;
    fn any(mask: Self::Mask) -> bool;
    fn pick(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// `x = 2^e (1 + f)` with `1 + f` in [2/3, 4/3), for normal `x > 0`: `[e, f]`.
    fn split(self) -> [Self; 2];
    /// The bits of `self` plus those of `z` shifted to the exponent, wrapping: `self * 2^n` where the low bits of `z` hold n.
    fn scaled(self, z: Self) -> Self;
}

/// Bits of 2/3, from which [`F32x32::split`] counts.
const TWO_THIRDS: u32 = 0x3f2a_aaab;
const FRACTION: u32 = 0x7f_ffff;

/// Any CPU.
#[derive(Clone, Copy)]
pub struct Plain([f32; SINGLES]);

impl Plain {
    #[inline(always)]
    fn zip(self, o: Plain, f: impl Fn(f32, f32) -> f32) -> Plain {
        Plain(std::array::from_fn(|i| f(self.0[i], o.0[i])))
    }
}

impl F32x32 for Plain {
    type Mask = [bool; SINGLES];
    type Int = [u32; SINGLES];
    #[inline(always)]
    fn splat(v: f32) -> Self {
        Plain([v; SINGLES])
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller's promise.
        Plain(unsafe { from.cast::<[f32; SINGLES]>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn load_u8(from: *const u8, flip: u8) -> [u32; SINGLES] {
        // SAFETY: the caller's promise.
        unsafe { from.cast::<[u8; SINGLES]>().read_unaligned() }.map(|v| (v ^ flip) as u32)
    }
    #[inline(always)]
    unsafe fn load_u16(from: *const u16, flip: u16) -> [u32; SINGLES] {
        // SAFETY: the caller's promise.
        unsafe { from.cast::<[u16; SINGLES]>().read_unaligned() }.map(|v| (v ^ flip) as u32)
    }
    #[inline(always)]
    unsafe fn load_u32(from: *const u32) -> [u32; SINGLES] {
        // SAFETY: the caller's promise.
        unsafe { from.cast::<[u32; SINGLES]>().read_unaligned() }
    }
    #[inline(always)]
    fn less_int(a: [u32; SINGLES], b: [u32; SINGLES]) -> [u32; SINGLES] {
        std::array::from_fn(|i| a[i].wrapping_sub(b[i]))
    }
    #[inline(always)]
    fn times_int(a: [u32; SINGLES], b: [u32; SINGLES]) -> [u32; SINGLES] {
        std::array::from_fn(|i| a[i].wrapping_mul(b[i]))
    }
    #[inline(always)]
    fn of_int(v: [u32; SINGLES]) -> Self {
        Plain(v.map(|v| v as i32 as f32))
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller's promise.
        unsafe { to.cast::<[f32; SINGLES]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    unsafe fn store_codes(self, to: *mut u8) {
        let codes = self.0.map(|v| v.to_bits() as u8);
        // SAFETY: the caller's promise.
        unsafe { to.cast::<[u8; SINGLES]>().write_unaligned(codes) }
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
    fn root(self) -> Self {
        Plain(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn magnitude(self) -> Self {
        Plain(self.0.map(f32::abs))
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
    fn greater(self, o: Self) -> Self {
        self.zip(o, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn lesser(self, o: Self) -> Self {
        self.zip(o, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn is_below(self, o: Self) -> [bool; SINGLES] {
        std::array::from_fn(|i| self.0[i] < o.0[i])
    }
    #[inline(always)]
    fn equals(self, o: Self) -> [bool; SINGLES] {
        std::array::from_fn(|i| self.0[i] == o.0[i])
    }
    #[inline(always)]
    fn is_negative(self) -> [bool; SINGLES] {
        self.0.map(f32::is_sign_negative)
    }
    #[inline(always)]
    fn is_blank(self) -> [bool; SINGLES] {
        self.0.map(|v| v.to_bits() == 0)
    }
    #[inline(always)]
    fn all(mask: [bool; SINGLES]) -> bool {
        mask == [true; SINGLES]
    }
    #[inline(always)]
    fn any(mask: [bool; SINGLES]) -> bool {
        mask != [false; SINGLES]
    }
    #[inline(always)]
    fn pick(mask: [bool; SINGLES], yes: Self, no: Self) -> Self {
        Plain(std::array::from_fn(|i| if mask[i] { yes.0[i] } else { no.0[i] }))
    }
    #[inline(always)]
    fn split(self) -> [Self; 2] {
        let bits = self.0.map(|v| v.to_bits().wrapping_sub(TWO_THIRDS));
        let fraction = |b: u32| f32::from_bits((b & FRACTION) + TWO_THIRDS) - 1.0;
        [Plain(bits.map(|b| ((b as i32) >> 23) as f32)), Plain(bits.map(fraction))]
    }
    #[inline(always)]
    fn scaled(self, z: Self) -> Self {
        self.zip(z, |p, z| f32::from_bits(p.to_bits().wrapping_add(z.to_bits() << 23)))
    }
}

/// [`crate::on_lanes`] with the lanes of this module.
#[macro_export]
macro_rules! on_singles {
    ($($what:tt)*) => { $crate::on_vectors! { singles $($what)* } };
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::Level;

    #[inline(always)]
    fn all_inner<V: F32x32, const K: usize>(a: &[f32; 96], codes: &[u16; 32], out: &mut Vec<u32>, low: &mut Vec<u8>) {
        let mut put = |v: V| {
            let mut row = [0.0f32; SINGLES];
            // SAFETY: 32 values.
            unsafe { v.store(row.as_mut_ptr()) };
            out.extend(row.map(f32::to_bits));
            let mut codes = [0u8; SINGLES];
            // SAFETY: 32 codes.
            unsafe { v.store_codes(codes.as_mut_ptr()) };
            low.extend(codes);
        };
        let bytes = codes.map(|c| c as u8);
        let words = codes.map(|c| c as u32 * 32_000);
        // SAFETY: 32 values each.
        unsafe {
            let [x, y, z] = [0, 32, 64].map(|i| V::load(a[i..].as_ptr()));
            let (i, j) = (V::load_u16(codes.as_ptr(), 0x8000), V::load_u8(bytes.as_ptr(), 0x80));
            let k = V::load_u32(words.as_ptr());
            let [e, f] = x.magnitude().plus(V::splat(1e-3)).split();
            let (below, equal) = (x.is_below(y), x.equals(x.greater(y)));
            let (negative, blank) = (x.is_negative(), x.is_blank());
            for v in [
                x.plus(y),
                x.minus(y),
                x.times(y),
                x.over(y),
                x.magnitude().root(),
                x.fused(y, z),
                x.less(y, z),
                x.greater(y),
                x.lesser(y),
                V::pick(below, x, y),
                V::pick(equal, x, y),
                V::pick(negative, x, y),
                V::pick(blank, x, y),
                V::of_int(i),
                V::of_int(j),
                V::of_int(V::less_int(i, V::times_int(j, k))),
                e,
                f,
                V::splat(1.25).scaled(V::of_int(j)),
            ] {
                put(v);
            }
            for (mask, any, all) in [(x.equals(x), true, true), (x.is_below(x), false, false), (below, true, false)] {
                assert_eq!((V::any(mask), V::all(mask)), (any, all));
            }
        }
    }

    crate::on_singles! { fn all[const K: usize](a: &[f32; 96], codes: &[u16; 32], out: &mut Vec<u32>, low: &mut Vec<u8>) = all_inner[K]; }

    #[test]
    fn every_level_gives_the_same_bits() {
        let mut a: [f32; 96] = std::array::from_fn(|i| ((i * 37 % 96) as f32 - 40.0) / 3.0);
        (a[3], a[4], a[5]) = (0.0, -0.0, 1e-30);
        let codes = std::array::from_fn(|i| (i * 2113 % 65_536) as u16);
        let mut first: Option<(Vec<u32>, Vec<u8>)> = None;
        for level in Level::available() {
            let (mut out, mut low) = (Vec::new(), Vec::new());
            all::<0>(level, &a, &codes, &mut out, &mut low);
            assert!(out.iter().zip(&low).all(|(v, low)| *v as u8 == *low), "{level:?}");
            assert_eq!(out[0], (a[0] + a[32]).to_bits());
            let power = f32::from_bits(out[16 * SINGLES + 7]).exp2() * (1.0 + f32::from_bits(out[17 * SINGLES + 7]));
            assert!((power - a[7].abs() - 1e-3).abs() < 1e-5);
            let all = (out, low);
            assert_eq!(first.get_or_insert_with(|| all.clone()), &all, "{level:?}");
        }
    }
}
