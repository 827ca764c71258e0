//! Visiting orders.

/// Interleaves the low 21 bits of z, y and x (x lowest): sorting by it visits cells along a Morton curve, which keeps
/// neighbours close in time, so that halos are still in the cache and parents complete early.
pub fn morton([z, y, x]: [i64; 3]) -> u64 {
    let spread = |v: i64| {
        let mut v = v as u64 & 0x1f_ffff;
        v = (v | v << 32) & 0x1f_0000_0000_ffff;
        v = (v | v << 16) & 0x1f_0000_ff00_00ff;
        v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
        v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
        (v | v << 2) & 0x1249_2492_4924_9249
    };
    spread(z) << 2 | spread(y) << 1 | spread(x)
}

#[cfg(test)]
mod tests {
    use super::morton;

    #[test]
    fn eight_children_are_consecutive() {
        let codes: Vec<u64> = (0..8).map(|i| morton([2 + (i >> 2 & 1), 4 + (i >> 1 & 1), 6 + (i & 1)])).collect();
        assert!(codes.windows(2).all(|w| w[1] == w[0] + 1));
    }
}
