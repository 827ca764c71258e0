//! Numbers that depend on a place alone, whatever the order of visits.

/// SplitMix64's finaliser: every bit of the result hangs on every bit of `h`.
pub fn mix(mut h: u64) -> u64 {
    h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    h ^ (h >> 31)
}
