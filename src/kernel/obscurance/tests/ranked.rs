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

/// What a table makes of the values of a type, from the least on: rising, falling, with plateaus, jumping, constant.
fn tables(n: usize) -> [Vec<f32>; 5] {
    let mut noise = Noise(9);
    let of = |f: &mut dyn FnMut(usize) -> f32| (0..n).map(f).collect::<Vec<f32>>();
    [
        of(&mut |i| (i as f32 - 100.0).powi(3)),
        of(&mut |i| if i == 0 { f32::INFINITY } else { -(i as f32) }),
        of(&mut |i| (i / 5 * 5) as f32 - 20.0),
        of(&mut |i| [0.0, -0.0, f32::NEG_INFINITY, 1e-40, i as f32][(noise.next() % 5) as usize]),
        of(&mut |_| 0.5),
    ]
}

fn of_floats(
    level: Level,
    p: &ObscuranceParams,
    field: &Field<f32>,
    out: Region,
    colour: Option<&[Vec<f32>; 3]>,
) -> Result {
    sweep_part(level, p, field, out, colour, None)
}

fn against_floats<T: Coded>(seed: u64)
where
    for<'a> AnyView<'a>: From<View<'a, T>>,
{
    let region = Region::new([3, -4, 10], [17, 9, 82]);
    let (least, _) = T::DTYPE.range();
    for (i, table) in tables(1 << (8 * size_of::<T>())).into_iter().enumerate() {
        let data = hostile::<T>(region.voxels(), seed + i as u64);
        let missing = [None, Some(0), Some(least as i64)][i % 3];
        let opacity = |v: &T| match missing {
            Some(m) if v.to_f64() == m as f64 => f32::NAN,
            _ => table[(v.to_f64() - least) as usize],
        };
        let floats: Vec<f32> = data.iter().map(opacity).collect();
        let (stored, float) = (Field { region, data: &data[..] }, Field { region, data: &floats[..] });
        let plain = ObscuranceParams { flipped: i % 2 == 1, max_distance: 21.0, ..params() };
        let p = ObscuranceParams { missing, ranks: Ranks::new(&table), ..plain.clone() };
        let out = Region::new([5, -4, 12], [11, 7, 80]);
        let want = expected(&plain, &float, out);
        let colour = [0, 1, 2].map(|c| floats.iter().map(|v| v.min(9.0) * c as f32).collect::<Vec<f32>>());
        for level in Level::available() {
            assert_eq!(bits(&sweep_part(level, &p, &stored, out, None, None).openness), bits(&want), "{i} {level:?}");
            let got = sweep_part(level, &p, &stored, out, Some(&colour), None);
            let floats = of_floats(level, &plain, &float, out, Some(&colour));
            for (got, want) in got.rgb.iter().zip(&floats.rgb) {
                assert_eq!(bits(got), bits(want), "{i} {level:?}");
            }
            assert_eq!(bits(&streamed::streamed(level, &p, &stored, out, None)), bits(&want), "{i} {level:?}");
        }
        assert_eq!(bits(&of_floats(Level::detect(), &plain, &float, out, None).openness), bits(&want), "{i}");
    }
}

#[test]
fn voxels_are_compared_by_what_a_table_makes_of_them() {
    against_floats::<u8>(61);
    against_floats::<i8>(62);
    against_floats::<u16>(63);
    against_floats::<i16>(64);
}

#[test]
fn tables_rank_every_value_in_the_order_of_what_they_make() {
    for n in [1 << 8, 1 << 16] {
        for table in tables(n) {
            let ranks = Ranks::new(&table).unwrap();
            let rank = |i: usize| ranks.of_code(i as u16);
            for (i, j) in (0..n).zip((0..n).cycle().skip(77)).chain((0..n).zip(1..n)) {
                assert_eq!(rank(i).cmp(&rank(j)), table[i].partial_cmp(&table[j]).unwrap(), "{i} {j}");
            }
        }
        let mut table = vec![1.0; n];
        table[n - 1] = f32::NAN;
        assert_eq!(Ranks::new(&table), None);
    }
}

#[test]
fn codes_for_other_devices_are_ranks() {
    let table: Vec<f32> = (0..256).map(|i| -(i as f32 / 2.0).floor()).collect();
    let p = ObscuranceParams { missing: Some(-5), ranks: Ranks::new(&table), ..params() };
    let voxels = [-128i8, -127, -126, -5, 127];
    let mut codes = [9; 5];
    let ends = Prepared::new(&p).codes(AnyView::I8(View::dense(&voxels, [1, 1, 5])), [0; 3], &mut codes);
    assert_eq!((codes, ends), ([127, 127, 126, 0, 0], (0, 127)));
    let low = Prepared::new(&ObscuranceParams { flipped: true, ..p });
    let ends = low.codes(AnyView::I8(View::dense(&voxels, [1, 1, 5])), [0; 3], &mut codes);
    assert_eq!((codes, ends), ([128, 128, 129, 0, 255], (128, 255)));
}
