//! Floats of few values, which are swept as their ranks.

use super::*;
use crate::kernel::obscurance::ranks::rank;

/// An increasing value for each byte, infinities and a negative zero among them.
fn value(code: u8) -> f32 {
    match code {
        0 => f32::NEG_INFINITY,
        128 => -0.0,
        255 => f32::INFINITY,
        c => (c as f32 - 128.0).powi(3),
    }
}

fn codes(n: usize, seed: u64, most: u64) -> Vec<u8> {
    let mut noise = Noise(seed);
    (0..n).map(|_| (noise.next() % most) as u8).collect()
}

#[test]
fn ranks_order_values_as_they_are() {
    let codes = codes(7 * 5 * 33, 5, 256);
    let values: Vec<f32> = codes.iter().map(|c| value(*c)).collect();
    let mut ranks = vec![9; codes.len()];
    assert!(rank(View::dense(&values, [7, 5, 33]), &mut ranks));
    for (i, j) in (0..codes.len()).zip((0..codes.len()).cycle().skip(401)) {
        assert_eq!(codes[i].cmp(&codes[j]), ranks[i].cmp(&ranks[j]));
    }
    // 0 and -0 are one value; the lowest has rank 0.
    assert!(rank(View::dense(&[0.0, -0.0, 1.0], [1, 1, 3]), &mut ranks[..3]));
    assert_eq!(&ranks[..3], [0, 0, 1]);
    let many: Vec<f32> = (0..257).map(|i| i as f32).collect();
    assert!(rank(View::dense(&many[..256], [4, 8, 8]), &mut ranks[..256]) && ranks[255] == 255);
    assert!(!rank(View::dense(&many, [1, 1, 257]), &mut ranks[..257]));
    for nan in [f32::NAN, -f32::NAN, f32::from_bits(0x7f80_0001)] {
        assert!(!rank(View::dense(&[1.0, nan], [1, 1, 2]), &mut ranks[..2]));
        assert!(!rank(View::dense(&[nan, 1.0], [1, 1, 2]), &mut ranks[..2]));
    }
}

#[test]
fn few_floats_sweep_as_their_codes_do() {
    let region = Region::new([3, -4, 10], [24, 15, 80]);
    for (seed, flipped, most) in [(1, false, 256), (2, true, 7), (3, true, 256)] {
        let p = ObscuranceParams { flipped, max_distance: 9.0, ..params() };
        let data = codes(region.voxels(), seed, most);
        let floats: Vec<f32> = data.iter().map(|c| value(*c)).collect();
        let (byte, float) = (Field { region, data: &data[..] }, Field { region, data: &floats[..] });
        for level in Level::available() {
            let expected = sweep_part(level, &p, &byte, region, None, None).openness;
            assert_eq!(bits(&expected), bits(&sweep_part(level, &p, &float, region, None, None).openness), "{level:?}");
        }
    }
}
