//! The sweep against the definition, closed forms, and what must not change it.

use super::keys::LANES;
use super::reference::{Field, missing, obscurance, occluder};
use super::*;
use crate::brick::Scratch;
use crate::grid::Voxel;
use crate::stage::directions;

mod masked;
mod metamorphic;
mod ranked;
mod streamed;

fn params() -> ObscuranceParams {
    ObscuranceParams {
        directions: 42,
        set: DirectionSet::Icosahedron,
        weights: DirectionWeights::Uniform,
        rho: Rho::Sqrt,
        max_distance: 6.0,
        spacing: [1.0; 3],
        flipped: false,
        missing: None,
        ambient: [1.0; 3],
        ranks: None,
    }
}

/// A small generator of repeatable noise.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 >> 11
    }
    fn unit(&mut self) -> f64 {
        (self.next() % (1 << 40)) as f64 / (1u64 << 40) as f64
    }
}

struct Result {
    openness: Vec<f32>,
    rgb: [Vec<f32>; 3],
}

fn interleave(c: &[Vec<f32>; 3]) -> Vec<[f32; 4]> {
    (0..c[0].len()).map(|i| [c[0][i], c[1][i], c[2][i], f32::NAN]).collect()
}

/// Sweeps `out` of a volume, giving the kernel only the halo that it asks for.
fn sweep_part<T: Voxel>(
    level: Level,
    p: &ObscuranceParams,
    field: &Field<T>,
    out: Region,
    colour: Option<&[Vec<f32>; 3]>,
    gradient: Option<&[Vec<f32>; 3]>,
) -> Result
where
    for<'a> AnyView<'a>: From<View<'a, T>>,
{
    let prepared = Prepared::new(p);
    let src_box = out.grow(prepared.reach()).clip(&field.region);
    let part = |data: &[f32], r: Region| -> Vec<f32> { r.iter().map(|q| data[field.index(q).unwrap()]).collect() };
    let src: Vec<T> = src_box.iter().map(|q| field.data[field.index(q).unwrap()]).collect();
    let colours = colour.map(|c| interleave(&[0, 1, 2].map(|k| part(&c[k], src_box))));
    let normals = gradient.map(|c| [0, 1, 2].map(|k| part(&c[k], out)));
    let (n, shape) = (out.voxels(), out.shape());
    let mut openness = vec![-1f32; n];
    let mut rgb = [0, 1, 2].map(|_| vec![-1f32; n]);
    let mut scratch = Scratch::new();
    let asked = prepared.scratch_bytes(T::DTYPE, src_box.shape(), shape, colour.is_some(), gradient.is_some());
    let io = ObscuranceIo {
        colour: colours.as_ref().map(|c| View::dense(&c[..], src_box.shape())),
        normal: normals.as_ref().map(|c| [0, 1, 2].map(|k| View::dense(&c[k], shape))),
        needed: None,
        openness: Some(AnyViewMut::F32(ViewMut::dense(&mut openness, shape))),
        rgb: colour.is_some().then(|| rgb.each_mut().map(|v| AnyViewMut::F32(ViewMut::dense(v, shape)))),
    };
    let view = AnyView::from(View::dense(&src, src_box.shape()));
    prepared.sweep(view, src_box, out, io, &mut Context { level, scratch: &mut scratch });
    assert!(scratch.bytes() <= asked.next_multiple_of(64), "{} bytes taken, {asked} promised", scratch.bytes());
    Result { openness, rgb }
}

macro_rules! from_view {
    ($($t:ty => $v:ident;)*) => {$(impl<'a> From<View<'a, $t>> for AnyView<'a> {
        fn from(v: View<'a, $t>) -> Self { AnyView::$v(v) }
    })*};
}
from_view! { u8 => U8; i8 => I8; u16 => U16; i16 => I16; u32 => U32; i32 => I32; f32 => F32; f64 => F64; }

fn sweep<T: Voxel>(p: &ObscuranceParams, field: &Field<T>) -> Vec<f32>
where
    for<'a> AnyView<'a>: From<View<'a, T>>,
{
    sweep_part(Level::detect(), p, field, field.region, None, None).openness
}

fn bits(v: &[f32]) -> Bits {
    Bits(v.iter().map(|v| v.to_bits()).collect())
}

/// Bits of floats; shows only how many there are.
#[derive(PartialEq)]
struct Bits(Vec<u32>);

impl std::fmt::Debug for Bits {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        write!(f, "{} floats", self.0.len())
    }
}

#[test]
fn every_search_finds_the_next_greater_key() {
    fn check<K: Key>(of: impl Fn(u64) -> K) {
        let mut noise = Noise(77);
        for (planes, from, to, reach) in [
            (1, 0, 1, 0),
            (1, 0, 1, 1),
            (5, 0, 5, 4),
            (70, 3, 70, 64),
            (200, 64, 130, 63),
            (256, 0, 256, 255),
            (300, 100, 101, 150),
            (333, 17, 290, 40),
            (700, 0, 600, 255),
            (700, 30, 700, 699),
            (600, 0, 600, 256),
            (600, 70, 500, 260),
            (400, 0, 400, 254),
        ] {
            let modulus = [3, 40, 1 << 20][(planes + reach) % 3];
            let mut sheet: Vec<K> = (0..planes * LANES).map(|_| of(noise.next() % modulus)).collect();
            for lane in 0..8 {
                // Falling, rising and constant lines.
                let slope = |i: usize| [i as u64, (planes - i) as u64, 9][lane % 3];
                (0..planes).for_each(|i| sheet[i * LANES + 8 * lane] = of(slope(i)));
            }
            let key = |plane: usize, lane: usize| sheet[plane * LANES + lane];
            let naive = |plane: usize, lane: usize, ahead: bool| {
                let at = |j: usize| if ahead { plane + j } else { plane.wrapping_sub(j) };
                let mut free = (1..=reach).take_while(|&j| at(j) < planes && key(at(j), lane) <= key(plane, lane));
                let steps = free.by_ref().count();
                if steps < reach && at(steps + 1) < planes { steps } else { reach }
            };
            let starts: Vec<usize> = (1..=planes).map(|i| i * LANES).collect();
            let data = [vec![K::ZERO; LANES], sheet.clone()].concat();
            let place = super::scan::Sheet { data: &data, planes: &starts };
            let mut stack = vec![0; planes];
            let mut rows = sheet.clone();
            let spans = [[0, (to - from) as u32]; LANES];
            let mut scratch = Scratch::new();
            #[cfg(target_arch = "x86_64")]
            let turned = scratch.take(super::wide::scratch_bytes(planes, to - from, size_of::<K>()));
            #[cfg(not(target_arch = "x86_64"))]
            let turned = scratch.take(0);
            for level in Level::available() {
                let mut hits = [0, 1].map(|_| vec![u32::MAX; (to - from) * LANES]);
                if reach <= 255 {
                    let mut bytes = hits.each_ref().map(|h| vec![7u8; h.len()]);
                    let [f, b] = bytes.each_mut();
                    super::scan::both(level, place, &spans, from..to, reach, [f, b], &mut rows, &mut stack, turned);
                    for (h, b) in hits.iter_mut().zip(&bytes) {
                        h.iter_mut().zip(b).for_each(|(h, b)| *h = *b as u32);
                    }
                } else {
                    let [f, b] = hits.each_mut();
                    super::scan::both(level, place, &spans, from..to, reach, [f, b], &mut rows, &mut stack, turned);
                }
                for (ahead, hits) in [true, false].into_iter().zip(&hits) {
                    for (i, &got) in hits.iter().enumerate() {
                        let (plane, lane) = (from + i / LANES, i % LANES);
                        let want = naive(plane, lane, ahead);
                        let what = (size_of::<K>(), level, planes, from, to, reach, ahead, plane, lane);
                        assert_eq!(got as usize, want, "{what:?}");
                    }
                }
            }
        }
    }
    check::<u8>(|v| v as u8);
    check::<u16>(|v| v as u16);
    check::<u32>(|v| (v as u32) << 8);
    check::<u64>(|v| v << 30);
}

/// What the fixed-point sum of the reference's hits must give, bit for bit.
fn expected<T: Voxel>(p: &ObscuranceParams, field: &Field<T>, out: Region) -> Vec<f32> {
    let (families, total) = lines::families(p, [usize::MAX; 3]);
    let one = |at: [i64; 3]| {
        if missing(field.data[field.index(at).unwrap()], p) {
            return f32::NAN;
        }
        let mut sum = 0u64;
        for family in &families {
            for sense in family.senses.iter().flatten() {
                let hit = occluder(field, p, sense.direction, at);
                let planes = hit.map(|(q, _)| q[family.axis].abs_diff(at[family.axis]) as usize);
                sum += sense.table[planes.map_or(family.reach, |j| j - 1)] as u64;
            }
        }
        (sum as f64 / total as f64) as f32
    };
    out.iter().map(one).collect()
}

/// Values with ties, extremes and, for floats, NaN, infinities and both zeros.
fn hostile<T: Voxel>(n: usize, seed: u64) -> Vec<T> {
    let mut noise = Noise(seed);
    let (lo, hi) = T::DTYPE.range();
    let one = |k: u64| match k % 12 {
        0 => lo,
        1 => hi,
        2 if T::DTYPE.is_float() => f64::NAN,
        3 if T::DTYPE.is_float() => f64::INFINITY,
        4 if T::DTYPE.is_float() => f64::NEG_INFINITY,
        5 if T::DTYPE.is_float() => -0.0,
        6 => 0.0,
        k if lo < 0.0 => (k as f64 - 9.0) * 1.5,
        k => k as f64,
    };
    (0..n).map(|_| T::from_f64(one(noise.next() >> 3))).collect()
}

fn against_definition<T: Voxel>(seed: u64)
where
    for<'a> AnyView<'a>: From<View<'a, T>>,
{
    let cases = [
        ([7, 9, 70], [1.0, 1.0, 1.0], 5.0),
        ([12, 5, 9], [2.0, 1.0, 0.7], 9.0),
        ([3, 17, 4], [0.3, 1.1, 0.5], 40.0),
        ([1, 1, 13], [1.0, 1.0, 1.0], 300.0),
        ([1, 6, 1], [1.0, 3.0, 1.0], 2.5),
    ];
    for (i, (shape, spacing, max_distance)) in cases.into_iter().enumerate() {
        let region = Region::whole(shape).shift([5, -3, 1000].map(|s| s * i as i64));
        let data = hostile::<T>(region.voxels(), seed + i as u64);
        let field = Field { data: &data, region };
        let rho = [Rho::Sqrt, Rho::Step, Rho::Linear, Rho::Exponential, Rho::Sqrt][i];
        let set = if i % 2 == 0 { DirectionSet::Icosahedron } else { DirectionSet::Fibonacci };
        let weights = if i == 2 { DirectionWeights::Voronoi } else { DirectionWeights::Uniform };
        let count = [42, 17, 12, 162, 10][i];
        let missing = if i == 1 { Some(0) } else { None };
        let p = ObscuranceParams {
            spacing,
            max_distance,
            rho,
            set,
            weights,
            missing,
            directions: if i == 3 { 162 } else { count },
            flipped: i % 2 == 1,
            ..params()
        };
        let want = expected(&p, &field, region);
        for level in Level::available() {
            let got = sweep_part(level, &p, &field, region, None, None).openness;
            assert_eq!(bits(&got), bits(&want), "{} {shape:?} {level:?}", T::DTYPE);
        }
        for (at, got) in region.iter().zip(&want).step_by(7) {
            let formula = obscurance(&field, &p, None, None, at).0;
            assert!((*got as f64 - formula).abs() < 1e-6 || got.is_nan() && formula.is_nan(), "{got} {formula}");
        }
    }
}

#[test]
fn every_dtype_finds_the_occluders_of_the_definition_bit_for_bit() {
    against_definition::<u8>(11);
    against_definition::<i8>(12);
    against_definition::<u16>(13);
    against_definition::<i16>(14);
    against_definition::<u32>(15);
    against_definition::<i32>(16);
    against_definition::<f32>(17);
    against_definition::<f64>(18);
}

/// Smooth and noisy values, so that occluders stand at all distances.
fn mixed(region: Region, seed: u64) -> Vec<u8> {
    let mut noise = Noise(seed);
    region
        .iter()
        .map(|[z, y, x]| {
            let wave = (z as f64 * 0.11).sin() + (y as f64 * 0.07).cos() + (x as f64 * 0.05).sin();
            let spike = if noise.next().is_multiple_of(97) { 60.0 } else { 0.0 };
            (100.0 + 30.0 * wave + spike + 3.0 * noise.unit()) as u8
        })
        .collect()
}

#[test]
fn long_reach_takes_every_path_to_the_same_answer() {
    let region = Region::new([-4, 3, 7], [-1, 6, 420]);
    let bytes = mixed(region, 3);
    // Long enough for answers beyond a byte, and, for wide keys, for the stack.
    for max_distance in [60.0, 64.0, 100.0, 130.0, 255.0, 256.0, 390.0] {
        let p = ObscuranceParams { max_distance, directions: 12, set: DirectionSet::Fibonacci, ..params() };
        let want = expected(&p, &Field { data: &bytes, region }, region);
        let wide: Vec<u16> = bytes.iter().map(|&v| v as u16 * 100).collect();
        let float: Vec<f32> = bytes.iter().map(|&v| v as f32 - 3.5).collect();
        let double: Vec<f64> = bytes.iter().map(|&v| v as f64 * 1e-9).collect();
        for level in Level::available() {
            let run = |v: Vec<f32>| assert_eq!(bits(&v), bits(&want), "{level:?} {max_distance}");
            run(sweep_part(level, &p, &Field { data: &bytes, region }, region, None, None).openness);
            run(sweep_part(level, &p, &Field { data: &wide, region }, region, None, None).openness);
            run(sweep_part(level, &p, &Field { data: &float, region }, region, None, None).openness);
            run(sweep_part(level, &p, &Field { data: &double, region }, region, None, None).openness);
        }
    }
}

#[test]
fn one_bright_voxel_very_far_is_seen_by_the_stack() {
    let region = Region::whole([1, 1, 3000]);
    let mut data: Vec<u8> = (0..3000).map(|i| (i % 7) as u8).collect();
    data[2500] = 200;
    let p = ObscuranceParams { max_distance: 1e9, ..params() };
    let field = Field { data: &data, region };
    assert_eq!(bits(&sweep(&p, &field)), bits(&expected(&p, &field, region)));
}

#[test]
fn bricks_never_show() {
    let region = Region::whole([37, 45, 150]).shift([100, -20, 3]);
    let data = mixed(region, 5);
    let field = Field { data: &data, region };
    let mut noise = Noise(9);
    let colour = [0, 1, 2].map(|_| (0..data.len()).map(|_| noise.unit() as f32).collect::<Vec<f32>>());
    let gradient = [0, 1, 2].map(|_| (0..data.len()).map(|_| noise.unit() as f32 - 0.5).collect::<Vec<f32>>());
    for (spacing, weighted) in [([1.0; 3], false), ([1.3, 1.0, 0.6], true)] {
        let p = ObscuranceParams { spacing, max_distance: 9.0, ambient: [0.3, 0.6, 1.7], ..params() };
        let gradient = weighted.then_some(&gradient);
        let whole = sweep_part(Level::detect(), &p, &field, region, Some(&colour), gradient);
        let bricks = [
            Region::new([100, -20, 3], [101, -19, 4]),
            Region::new([110, -7, 40], [130, 20, 128]),
            Region::new([103, -20, 80], [137, -3, 153]),
        ];
        for brick in bricks {
            let part = sweep_part(Level::Baseline, &p, &field, brick, Some(&colour), gradient);
            let at: Vec<usize> = brick.iter().map(|q| field.index(q).unwrap()).collect();
            let of = |v: &[f32]| Bits(at.iter().map(|&i| v[i].to_bits()).collect());
            assert_eq!(bits(&part.openness), of(&whole.openness));
            (0..3).for_each(|c| assert_eq!(bits(&part.rgb[c]), of(&whole.rgb[c])));
        }
    }
}

#[test]
fn colour_and_normals_follow_the_formula() {
    let region = Region::whole([6, 7, 9]).shift([3, 3, 3]);
    let mut data: Vec<f32> = mixed(region, 7).iter().map(|&v| v as f32).collect();
    data[50] = f32::NAN;
    data[51] = f32::INFINITY;
    let field = Field { data: &data, region };
    let mut noise = Noise(4);
    let colour = [0, 1, 2].map(|_| (0..data.len()).map(|_| 2.0 * noise.unit() as f32).collect::<Vec<f32>>());
    let mut gradient = [0, 1, 2].map(|_| (0..data.len()).map(|_| noise.unit() as f32 - 0.5).collect::<Vec<f32>>());
    for c in &mut gradient {
        c[0] = 0.0;
        c[1] = f32::NAN;
    }
    let near = |a: f32, b: f64| (a as f64 - b).abs() < 1e-6 * b.abs().max(1.0) || a.is_nan() && b.is_nan();
    for weighted in [false, true] {
        for flipped in [false, true] {
            let p = ObscuranceParams {
                spacing: [1.0, 0.8, 1.7],
                max_distance: 4.0,
                ambient: [0.2, 0.5, 1.0],
                flipped,
                weights: DirectionWeights::Voronoi,
                ..params()
            };
            let part = weighted.then_some(&gradient);
            let got = sweep_part(Level::detect(), &p, &field, region, Some(&colour), part);
            for (i, at) in region.iter().enumerate() {
                let g = part.map(|g| [0, 1, 2].map(|c| g[c][i]));
                let (open, rgb) = obscurance(&field, &p, Some(&colour), g, at);
                assert!(near(got.openness[i], open), "{at:?}: {} is not {open}", got.openness[i]);
                (0..3).for_each(|c| assert!(near(got.rgb[c][i], rgb[c]), "{at:?}: {} {}", got.rgb[c][i], rgb[c]));
            }
        }
    }
}

#[test]
fn flat_bricks_are_open_and_see_the_ambient_colour() {
    let region = Region::whole([5, 6, 70]);
    let mut data = vec![7u16; region.voxels()];
    data[3] = 9; // missing: neither occludes nor counts
    let p = ObscuranceParams { missing: Some(9), max_distance: 6.5, ambient: [0.3, 0.7, 0.1], ..params() };
    let colour = [0, 1, 2].map(|_| vec![0f32; data.len()]);
    let got = sweep_part(Level::detect(), &p, &Field { data: &data, region }, region, Some(&colour), None);
    data[200] = 8; // not flat: the voxels that do not see it must have the same bits
    let other = sweep_part(Level::detect(), &p, &Field { data: &data, region }, region, Some(&colour), None);
    assert!(got.openness[3].is_nan() && got.rgb[0][3].is_nan());
    assert!(got.openness.iter().enumerate().all(|(i, &v)| v == 1.0 || i == 3));
    assert!(other.openness.iter().any(|&v| v < 1.0));
    for i in (0..data.len()).filter(|&i| other.openness[i] == 1.0) {
        (0..3).for_each(|c| assert_eq!(got.rgb[c][i].to_bits(), other.rgb[c][i].to_bits()));
        assert!((got.rgb[0][i] - 0.3).abs() < 1e-6);
    }
}

/// A wall at distance h = a dmax, seen from the open side (background, closed forms).
#[test]
fn infinite_wall_has_its_closed_form() {
    let (dmax, distance) = (24.0, 6);
    let n = 60i64;
    let region = Region::new([-n, -n, 0], [n, n, 30]);
    let data: Vec<u8> = region.iter().map(|[_, _, x]| u8::from(x >= 20)).collect();
    let out = Region::new([0, 0, 20 - distance], [6, 6, 20 - distance + 1]);
    let closed = |rho: Rho, a: f64| match rho {
        Rho::Step => 1.0 - (1.0 - a) / 2.0,
        Rho::Linear => 1.0 - ((1.0 - a) + a * a.ln()) / 2.0,
        Rho::Sqrt => 1.0 - (1.0 - a.sqrt()).powi(2) / 2.0,
        Rho::Exponential => {
            // Mean of exp(-d / dmax) over directions of cosine a / t: a / 2 times the integral of exp(-t) / t^2 dt.
            let steps = 20_000;
            let at = |i: i32| a + (i as f64 + 0.5) / steps as f64 * (1.0 - a);
            let sum: f64 = (0..steps).map(at).map(|t| (-t).exp() / (t * t)).sum();
            1.0 - a / 2.0 * sum * (1.0 - a) / steps as f64
        }
    };
    for rho in [Rho::Step, Rho::Linear, Rho::Exponential, Rho::Sqrt] {
        let p =
            ObscuranceParams { rho, max_distance: dmax, set: DirectionSet::Fibonacci, directions: 2000, ..params() };
        let got = sweep_part(Level::detect(), &p, &Field { data: &data, region }, out, None, None).openness;
        let mean = got.iter().map(|&v| v as f64).sum::<f64>() / got.len() as f64;
        // A line that is not dominated by x enters the wall's first plane half a voxel early on average, as
        // displacements are rounded; one that is dominated by x does not.
        let (near, far) = (closed(rho, (distance as f64 - 0.5) / dmax), closed(rho, distance as f64 / dmax));
        assert!(near - 1e-3 < mean && mean < far + 1e-3, "{rho:?}: {mean}, closed forms {near} {far}");
    }
}

#[test]
fn sums_of_thousands_of_directions_fit() {
    let region = Region::whole([3, 3, 3]);
    let data = vec![1u8; 27];
    for directions in [1, 2, 4095, 4096, 9000] {
        let p = ObscuranceParams { directions, set: DirectionSet::Fibonacci, ..params() };
        let (families, total) = lines::families(&p, [usize::MAX; 3]);
        assert!(total < 1 << 32);
        assert_eq!(families.iter().flat_map(|f| f.senses.iter().flatten()).count(), directions);
        assert_eq!(directions::directions(p.set, directions).len(), directions);
        assert!(sweep(&p, &Field { data: &data, region }).iter().all(|v| *v == 1.0));
    }
}
