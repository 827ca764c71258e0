//! What a change of the input must do to the result.

use super::*;

#[test]
fn increasing_maps_change_nothing_and_negation_equals_flipping() {
    let region = Region::whole([11, 12, 20]);
    let data = mixed(region, 21);
    let plain = bits(&sweep(&params(), &Field { data: &data, region }));
    let mapped: Vec<f64> = data.iter().map(|&v| (v as f64 * 0.2).exp() - 1e9).collect();
    assert_eq!(bits(&sweep(&params(), &Field { data: &mapped, region })), plain);
    let negative: Vec<i16> = data.iter().map(|&v| -(v as i16)).collect();
    let flipped = ObscuranceParams { flipped: true, ..params() };
    assert_eq!(bits(&sweep(&flipped, &Field { data: &negative, region })), plain);
}

#[test]
fn cyclic_permutation_of_the_axes_permutes_the_result() {
    for directions in [42, 162] {
        let n = 23;
        let region = Region::whole([n; 3]);
        let data = mixed(region, 33);
        let p = ObscuranceParams { directions, max_distance: 12.0, ..params() };
        let index = |[z, y, x]: [i64; 3]| ((z * n as i64 + y) * n as i64 + x) as usize;
        let turned: Vec<u8> = region.iter().map(|[z, y, x]| data[index([y, x, z])]).collect();
        let a = sweep(&p, &Field { data: &data, region });
        let b = sweep(&p, &Field { data: &turned, region });
        for [z, y, x] in region.iter() {
            assert_eq!(b[index([z, y, x])].to_bits(), a[index([y, x, z])].to_bits());
        }
    }
}

/// A flip about the origin turns the lines over with the volume: `D(-k) = -D(k)`, since no slope of these sets but 0 and 1 is
/// rational.
#[test]
fn flips_about_the_origin_of_the_lines_flip_the_result() {
    let region = Region { lo: [2, -5, 7], hi: [13, 7, 40] };
    let data = mixed(region, 51);
    for directions in [12, 42, 162] {
        let p = ObscuranceParams { directions, max_distance: 9.0, ..params() };
        let plain = sweep(&p, &Field { data: &data, region });
        assert!(plain.iter().any(|v| *v < 0.9));
        for axes in 1..8 {
            let turn = |q: [i64; 3]| std::array::from_fn(|a| if axes >> a & 1 == 1 { -q[a] } else { q[a] });
            let [lo, hi] = [region.lo, region.hi.map(|h| h - 1)].map(turn);
            let turned = Region {
                lo: std::array::from_fn(|a| i64::min(lo[a], hi[a])),
                hi: std::array::from_fn(|a| i64::max(lo[a], hi[a]) + 1),
            };
            let place = Field { data: &data, region };
            let flipped: Vec<u8> = turned.iter().map(|q| data[place.index(turn(q)).unwrap()]).collect();
            let got = sweep(&p, &Field { data: &flipped, region: turned });
            for (q, v) in turned.iter().zip(got) {
                assert_eq!(v.to_bits(), plain[place.index(turn(q)).unwrap()].to_bits(), "{directions} {axes} {q:?}");
            }
        }
    }
}

#[test]
fn a_longer_reach_never_opens() {
    let region = Region::whole([14, 15, 33]);
    let data = mixed(region, 40);
    for rho in [Rho::Step, Rho::Linear, Rho::Exponential, Rho::Sqrt] {
        let mut last = vec![1f32; data.len()];
        for max_distance in [0.5, 1.0, 2.0, 5.5, 11.0, 30.0] {
            let p = ObscuranceParams { rho, max_distance, ..params() };
            let next = sweep(&p, &Field { data: &data, region });
            assert!(next.iter().zip(&last).all(|(n, l)| n <= l), "{rho:?} {max_distance}");
            last = next;
        }
        assert!(last.iter().any(|v| *v < 0.9));
    }
}

#[test]
fn tables_that_end_with_the_volume_give_the_same_bits() {
    for shape in [[1, 2, 300], [200, 1, 1], [1, 150, 1], [5, 40, 3], [17, 16, 18]] {
        let region = Region::whole(shape);
        let data = mixed(region, 60);
        let sweep = |prepared: &Prepared| {
            let mut openness = vec![-1f32; data.len()];
            let mut scratch = Scratch::new();
            let io = ObscuranceIo {
                colour: None,
                normal: None,
                needed: None,
                openness: Some(AnyViewMut::F32(ViewMut::dense(&mut openness, shape))),
                rgb: None,
            };
            let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
            prepared.sweep(AnyView::U8(View::dense(&data, shape)), region, region, io, &mut cx);
            bits(&openness)
        };
        for max_distance in [1.0, 4.0, 90.0, 1e4] {
            let p = ObscuranceParams { max_distance, spacing: [2.0, 1.0, 1.5], ..params() };
            assert!(sweep(&Prepared::within(&p, shape)) == sweep(&Prepared::new(&p)), "{shape:?} {max_distance}");
        }
        let endless = Prepared::within(&ObscuranceParams { max_distance: 1e300, ..params() }, shape);
        let most = shape.into_iter().max().unwrap();
        assert!(endless.reach().into_iter().all(|r| r <= most), "{:?}", endless.reach());
    }
}
