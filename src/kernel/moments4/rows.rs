//! From sums of powers to bounds of counts, a group of windows at a time.

use super::bounds::{WHOLE, bounds};
use super::sums::{COARSE, Code, Sums};
use crate::multiversion;
use crate::stage::Ties;

/// Windows of a group: enough for whole vectors, few enough for the L1 cache.
pub const GROUP: usize = 64;

/// Bounds of the numbers of voxels that an exact count would give.
#[derive(Clone, Copy)]
pub struct Group {
    pub n: [f64; GROUP],
    pub lower: [f64; GROUP],
    pub upper: [f64; GROUP],
    /// The window has one code or two, and then its counts are known but for voxels of different values that share the
    /// centre's code (1); else 0.
    pub known: [f64; GROUP],
}

impl Group {
    pub const NONE: Group = Group { n: [1.0; GROUP], lower: [0.0; GROUP], upper: [0.0; GROUP], known: [0.0; GROUP] };
}

/// Which count is asked for.
#[derive(Debug, Clone, Copy)]
pub struct Count {
    pub ties: Ties,
    /// Smaller codes are denser.
    pub flipped: bool,
}

multiversion! {
    /// Bounds of `GROUP` windows of which output `first` of the row is the first: `lines` as [`super::sums::sweep`] gives
    /// them, `w` columns to a window, `centres` the codes of the outputs (short at the end of the row). A window has `section`
    /// voxels in each of its `columns`, where none are missing (`M`).
    pub fn bound_group[T: Code, const C: usize, const M: bool](
        kind: Sums<C, M>, lines: &[i64], first: usize, w: usize, centres: &[T], columns: &[f64], section: f64,
        count: Count, group: &mut Group,
    ) -> () = bound_inner;
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn bound_inner<T: Code, const C: usize, const M: bool>(
    _: Sums<C, M>,
    lines: &[i64],
    first: usize,
    w: usize,
    centres: &[T],
    columns: &[f64],
    section: f64,
    count: Count,
    group: &mut Group,
) {
    let pitch = lines.len() / C;
    let mut z = [0i64; GROUP];
    z.iter_mut().zip(centres).for_each(|(z, c)| *z = c.centred() as i64);
    let mut sums = [[0i64; GROUP]; C];
    for (c, sums) in sums.iter_mut().enumerate() {
        let line = &lines[c * pitch..][..pitch];
        let (from, to) = (&line[first..][..GROUP], &line[first + w..][..GROUP]);
        for i in 0..GROUP {
            sums[i] = to[i].wrapping_sub(from[i]);
        }
    }
    let mut n = [1.0; GROUP];
    if M {
        n = sums[C - 1].map(|n| n as f64);
    } else {
        n.iter_mut().zip(columns).for_each(|(n, c)| *n = section * c);
    }
    let mut t = [[0.0; GROUP]; 4];
    for i in 0..GROUP {
        let s: [i64; C] = std::array::from_fn(|c| sums[c][i]);
        let about = about_centre::<C, M>(n[i], s, z[i]);
        (t[0][i], t[1][i], t[2][i], t[3][i]) = (about[0], about[1], about[2], about[3]);
    }
    for i in 0..GROUP {
        let (below, at_most) = bounds(n[i], [t[0][i], t[1][i], t[2][i], t[3][i]]);
        (group.lower[i], group.upper[i]) = (below, at_most);
    }
    for i in 0..GROUP {
        let (n, below, at_most) = (n[i], group.lower[i], group.upper[i]);
        // Seen from the other side.
        let (below, at_most) = if count.flipped { (n - at_most, n - below) } else { (below, at_most) };
        // The centre itself is one more voxel that is not above than are below.
        let (more, less) = if count.ties == Ties::Le { (1.0, 0.0) } else { (0.5, 0.5) };
        group.n[i] = n;
        group.lower[i] = below + more;
        group.upper[i] = at_most - less;
        // Of two codes the moments have no more rank than of two points.
        let few = t[2][i] * t[2][i] >= t[1][i] * t[3][i] * (1.0 - 1e-12);
        group.known[i] = few as u8 as f64;
    }
    for i in 0..GROUP {
        if group.known[i] == 0.0 {
            continue;
        }
        let whole = wrapped(n[i], std::array::from_fn::<i64, C, _>(|c| sums[c][i]), z[i]);
        group.known[i] = one_or_two(whole, [t[0][i], t[1][i], t[2][i], t[3][i]]) as u8 as f64;
    }
}

/// Sums of (code - centre)^k for k = 1 to 4 from sums of powers of codes, all of which wrap at 64 bits.
#[inline(always)]
fn wrapped<const C: usize>(n: f64, s: [i64; C], z: i64) -> [i64; 4] {
    // The low bits of the sum are the number: instruction sets of old have no other cast that is a vector's.
    let n = ((n + WHOLE).to_bits() as i64).wrapping_sub(WHOLE.to_bits() as i64);
    let less = |sum: i64, times: i64| sum.wrapping_sub(z.wrapping_mul(times));
    // Each line subtracts z from one more factor of the products.
    let (t1, u2, u3, u4) = (less(s[0], n), less(s[1], s[0]), less(s[2], s[1]), less(s[3], s[2]));
    let (t2, v3, v4) = (less(u2, t1), less(u3, u2), less(u4, u3));
    let (t3, w4) = (less(v3, t2), less(v4, v3));
    [t1, t2, t3, less(w4, t3)]
}

/// The same, each rounded once. What must fit: with n voxels, differences below 2^8 make sums of fourth powers below n 2^32;
/// below 2^16 those of squares are below n 2^32 and, where n < 2^15, those of cubes below 2^63. The rest is found with the
/// coarse sums.
#[inline(always)]
fn about_centre<const C: usize, const M: bool>(n: f64, s: [i64; C], z: i64) -> [f64; 4] {
    let coarse = C - 4 - M as usize;
    let exact = wrapped(n, s, z).map(|t| t as f64);
    if coarse == 0 {
        return exact;
    }
    let z = z as f64;
    let (s1, s2) = (s[0] as f64, s[1] as f64);
    let s3 = if coarse > 1 { unwrap(s[2] as f64, s[5] as f64 * (1u64 << COARSE[1]) as f64) } else { s[2] as f64 };
    let s4 = s[4] as f64 * (1u64 << COARSE[0]) as f64;
    let about3 = s3 - z * (3.0 * s2 - z * (3.0 * s1 - z * n));
    let about4 = s4 - z * (4.0 * s3 - z * (6.0 * s2 - z * (4.0 * s1 - z * n)));
    let t3 = if coarse > 1 { unwrap(exact[2], about3) } else { exact[2] };
    [exact[0], exact[1], t3, unwrap(exact[3], about4)]
}

/// Whether all x are 0 or one other number d: then d is the quotient of the first sums, and the sum of x^2 (x - d)^2 is 0. It is
/// nearly 0 by the rounded sums, and 0 by those that wrap.
fn one_or_two(whole: [i64; 4], sums: [f64; 4]) -> bool {
    // Differences of codes are below 2^16; so is this where it is right, and else it is anything.
    let d = (sums[1] / sums[0]).round_ties_even();
    let d = if d.abs() < 65536.0 { d } else { 0.0 };
    let nearly = sums[3] - d * (2.0 * sums[2] - d * sums[1]);
    let d = d as i64;
    let rest = whole[3].wrapping_sub(d.wrapping_mul(whole[2].wrapping_mul(2).wrapping_sub(d.wrapping_mul(whole[1]))));
    rest == 0 && nearly.abs() < 4_611_686_018_427_387_904.0
}

/// The number that wrapped to `low` (signed 64 bits, rounded), given to less than 2^62.
#[inline(always)]
fn unwrap(low: f64, about: f64) -> f64 {
    const WRAP: f64 = 18_446_744_073_709_551_616.0; // 2^64
    let times = ((about - low) * (1.0 / WRAP) + WHOLE) - WHOLE;
    low + times * WRAP
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::hostile::Noise;

    /// Sums about the centre against 128-bit integers, for windows that wrap and that do not.
    #[test]
    fn sums_about_the_centre_are_exact() {
        let mut noise = Noise(3);
        for case in 0..3000u32 {
            let count = [1, 5, 40, 3000][case as usize % 4];
            let weight = [1i128, 3, 700_000][case as usize / 4 % 3];
            let span = [2, 200, 65536][case as usize / 12 % 3];
            let base = noise.below(65537 - span) as i64 - 32768;
            let codes: Vec<i64> = (0..count).map(|_| base + noise.below(span) as i64).collect();
            let z = codes[noise.below(count)];
            let total = |f: &dyn Fn(i128) -> i128| codes.iter().map(|q| f(*q as i128)).sum::<i128>() * weight;
            let n = count as i128 * weight;
            let s = [
                total(&|q| q) as i64,
                total(&|q| q * q) as i64,
                total(&|q| q.pow(3)) as i64,
                total(&|q| q.pow(4)) as i64,
                total(&|q| q.pow(4) >> COARSE[0]) as i64,
                total(&|q| q.pow(3) >> COARSE[1]) as i64,
            ];
            let expect: Vec<f64> = (1..5).map(|k| total(&|q| (q - z as i128).pow(k)) as f64).collect();
            let close = |got: [f64; 4]| got.iter().zip(&expect).all(|(g, e)| (g - e).abs() <= e.abs() * 2f64.powi(-52));
            let mut kinds = codes.clone();
            kinds.sort_unstable();
            kinds.dedup();
            let few = one_or_two(wrapped(n as f64, s, z), about_centre::<6, false>(n as f64, s, z));
            assert_eq!(few, kinds.len() <= 2, "{case}");
            assert!(close(about_centre::<6, false>(n as f64, s, z)), "{case}");
            if n < 1 << 15 {
                let five = [s[0], s[1], s[2], s[3], s[4]];
                assert!(close(about_centre::<5, false>(n as f64, five, z)), "{case}");
            }
            if span <= 256 {
                // Bytes lie about the middle of theirs.
                let codes: Vec<i64> = codes.iter().map(|q| q - base - 128).collect();
                let s = [1, 2, 3, 4].map(|k| (codes.iter().map(|q| (*q as i128).pow(k)).sum::<i128>() * weight) as i64);
                assert!(close(about_centre::<4, false>(n as f64, s, z - base - 128)), "{case}");
            }
        }
    }
}
