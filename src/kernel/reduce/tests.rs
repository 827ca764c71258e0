use super::*;
use crate::brick::{Scratch, Voxels};
use crate::grid::Voxel;
use crate::grid::{DType, ViewMut};

const ALL: [bool; 3] = [true; 3];

struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 33) as f64 / (1u64 << 31) as f64
    }
}

/// A level-0 volume with what the tests need.
struct Case {
    shape: Shape,
    value: Voxels,
    mean: Voxels,
    needed: Option<Vec<u8>>,
}

impl Case {
    fn random(shape: Shape, dtype: DType, nan: f64, excluded: f64, seed: u64) -> Case {
        let n = shape.iter().product();
        let mut random = Random(seed);
        let mut of = |dtype: DType, offset: f64, nan: f64| {
            let mut v = Voxels::zeroed(dtype, n);
            crate::with_voxels!(&mut v, v => for d in v.iter_mut() {
                let bad = dtype.is_float() && random.next() < nan;
                *d = Voxel::from_f64(if bad { f64::NAN } else { offset + 200.0 * random.next() });
            });
            v
        };
        let (value, mean) = (of(dtype, 3.0, nan), of(dtype.result(), 1e6, nan));
        // Excluded in blobs, so that whole cells, whole rows and single voxels are.
        let [_, ny, nx] = shape;
        let mut blob = |i: usize| {
            let (z, y, x) = (i / (ny * nx), i / nx % ny, i % nx);
            let mut cell = Random(seed ^ ((((z / 4) << 40) | ((y / 4) << 20) | (x / 8)) as u64 + 1));
            cell.next();
            u8::from(!(cell.next() < excluded || random.next() < excluded * 0.2))
        };
        let needed = (excluded > 0.0).then(|| (0..n).map(&mut blob).collect());
        Case { shape, value, mean, needed }
    }

    fn level0(&self) -> Level0<'_> {
        Level0 {
            value: self.value.view(self.shape),
            mean: Some(self.mean.view(self.shape)),
            needed: self.needed.as_ref().map(|m| View::dense(m, self.shape)),
        }
    }

    /// The part of the case inside a box.
    fn part(&self, lo: [usize; 3], shape: Shape) -> Case {
        let indices: Vec<usize> = (0..shape[0])
            .flat_map(|z| (0..shape[1]).flat_map(move |y| (0..shape[2]).map(move |x| [z, y, x])))
            .map(|i| ((lo[0] + i[0]) * self.shape[1] + lo[1] + i[1]) * self.shape[2] + lo[2] + i[2])
            .collect();
        let cut = |v: &Voxels| {
            let mut out = Voxels::zeroed(v.dtype(), indices.len());
            let size = v.dtype().size();
            let bytes = out.as_bytes_mut();
            for (i, &j) in indices.iter().enumerate() {
                bytes[i * size..(i + 1) * size].copy_from_slice(&v.as_bytes()[j * size..(j + 1) * size]);
            }
            out
        };
        let needed = self.needed.as_ref().map(|m| indices.iter().map(|&j| m[j]).collect());
        Case { shape, value: cut(&self.value), mean: cut(&self.mean), needed }
    }

    /// The definition: collect the voxels that count, then reduce them.
    fn reference(&self, kind: Reduce, std: bool, factor: [usize; 3], cell: [usize; 3]) -> f64 {
        let mut voxels = Vec::new();
        let span = |a: usize| cell[a] * factor[a]..((cell[a] + 1) * factor[a]).min(self.shape[a]);
        for (z, y, x) in span(0).flat_map(|z| span(1).flat_map(move |y| span(2).map(move |x| (z, y, x)))) {
            let i = (z * self.shape[1] + y) * self.shape[2] + x;
            voxels.push((self.value.at(i), self.mean.at(i), self.needed.as_ref().is_none_or(|m| m[i] != 0)));
        }
        if voxels.iter().any(|v| v.2) {
            voxels.retain(|v| v.2);
        }
        voxels.retain(|v| !(v.0.is_nan() || kind == Reduce::Moments && v.1.is_nan()));
        let n = voxels.len() as f64;
        let average = |f: &dyn Fn(&(f64, f64, bool)) -> f64| voxels.iter().map(f).sum::<f64>() / n;
        match kind {
            Reduce::Mean => average(&|v| v.0),
            Reduce::Min => voxels.iter().map(|v| v.0).fold(f64::NAN, f64::min),
            Reduce::Max => voxels.iter().map(|v| v.0).fold(f64::NAN, f64::max),
            Reduce::Stride => unreachable!("checked by its own test"),
            Reduce::Moments => {
                let mean = average(&|v| v.1);
                let within = average(&|v| if std { v.0 * v.0 } else { v.0 });
                let variance = within + average(&|v| (v.1 - mean) * (v.1 - mean));
                if std { variance.sqrt() } else { variance }
            }
        }
    }
}

/// The chain of levels for the halvings named, all cells of each.
fn chain(case: &Case, kind: Reduce, std: bool, steps: &[[bool; 3]], level: Level) -> Vec<Cells> {
    let mut scratch = Scratch::new();
    let mut cx = Context { level, scratch: &mut scratch };
    let mut levels = vec![Cells::default()];
    levels[0].first(kind, std, case.level0(), steps[0], &mut cx);
    for &halve in &steps[1..] {
        let mut next = Cells::default();
        next.next_from(levels.last().unwrap(), halve, &mut cx);
        levels.push(next);
    }
    levels
}

fn indices(shape: Shape) -> impl Iterator<Item = [usize; 3]> {
    (0..shape[0]).flat_map(move |z| (0..shape[1]).flat_map(move |y| (0..shape[2]).map(move |x| [z, y, x])))
}

fn close(a: f64, b: f64) -> bool {
    a == b || (a.is_nan() && b.is_nan()) || (a - b).abs() <= 1e-11 * a.abs().max(b.abs())
}

#[test]
fn every_kind_equals_brute_force_at_every_level() {
    let steps = [ALL, [false, true, true], ALL];
    let kinds = [
        (Reduce::Mean, false),
        (Reduce::Min, false),
        (Reduce::Max, false),
        (Reduce::Moments, false),
        (Reduce::Moments, true),
    ];
    for (shape, dtype) in [
        ([9, 11, 37], DType::F32),
        ([1, 5, 300], DType::U8),
        ([7, 1, 2], DType::F64),
        ([8, 8, 16], DType::U16),
        ([3, 3, 3], DType::I32),
        ([1, 1, 1], DType::F32),
        ([5, 6, 7], DType::I8),
    ] {
        for (nan, excluded) in [(0.0, 0.0), (0.1, 0.0), (0.9, 0.0), (0.0, 0.4), (0.2, 0.4), (1.0, 0.0), (0.0, 1.0)] {
            let case = Case::random(shape, dtype, nan, excluded, 1 + shape[2] as u64);
            for (kind, std) in kinds {
                for cells in chain(&case, kind, std, &steps, Level::detect()) {
                    for i in indices(cells.shape) {
                        let want = case.reference(kind, std, cells.factor, i);
                        assert!(
                            close(cells.at(i), want),
                            "{kind:?} {shape:?} {dtype} {nan} {excluded} {i:?}: {} {want}",
                            cells.at(i)
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn bits_are_the_same_at_every_level_of_instructions() {
    for kind in [Reduce::Mean, Reduce::Min, Reduce::Max, Reduce::Stride, Reduce::Moments] {
        for (nan, excluded) in [(0.0, 0.0), (0.1, 0.3), (0.003, 0.0)] {
            let case = Case::random([5, 7, 131], DType::F32, nan, excluded, 5);
            let want = chain(&case, kind, false, &[ALL, ALL], Level::Baseline);
            for level in Level::available() {
                assert_eq!(bits(&chain(&case, kind, false, &[ALL, ALL], level)), bits(&want), "{kind:?} {level:?}");
            }
        }
    }
}

fn bits(levels: &[Cells]) -> Vec<u64> {
    levels.iter().flat_map(|c| indices(c.shape).map(|i| c.at(i).to_bits())).collect()
}

#[test]
fn bricks_give_the_same_bits_as_the_whole() {
    let steps = [ALL, ALL];
    for kind in [Reduce::Mean, Reduce::Min, Reduce::Max, Reduce::Stride, Reduce::Moments] {
        for (nan, excluded) in [(0.0, 0.0), (0.02, 0.0), (0.0, 0.3), (0.05, 0.3)] {
            let case = Case::random([11, 13, 30], DType::F32, nan, excluded, 9);
            let whole = chain(&case, kind, false, &steps, Level::detect());
            for brick in [[4, 4, 4], [8, 4, 12], [4, 12, 32]] {
                let mut joined = [Cells::default(), Cells::default()];
                joined.iter_mut().zip(&whole).for_each(|(j, w)| j.prepare(kind, false, w.factor, w.extent));
                for b in indices(std::array::from_fn(|a| case.shape[a].div_ceil(brick[a]))) {
                    let lo: [usize; 3] = std::array::from_fn(|a| b[a] * brick[a]);
                    let part = case.part(lo, std::array::from_fn(|a| brick[a].min(case.shape[a] - lo[a])));
                    for (cells, joined) in chain(&part, kind, false, &steps, Level::detect()).iter().zip(&mut joined) {
                        joined.paste(cells, std::array::from_fn(|a| lo[a] / cells.factor[a]));
                    }
                }
                assert_eq!(bits(&joined), bits(&whole), "{kind:?} {brick:?} {nan} {excluded}");
                // What is stored comes back, and the next level made from joined parts is the same, too.
                let mut scratch = Scratch::new();
                let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
                let (mut numbers, mut loaded) = (Vec::new(), Cells::default());
                joined[1].store(&mut numbers);
                assert_eq!(numbers.len() * 8, joined[1].value.len() * bytes_per_cell(kind));
                loaded.load(kind, false, whole[1].factor, whole[1].extent, &numbers);
                let (mut a, mut b) = (Cells::default(), Cells::default());
                a.next_from(&loaded, ALL, &mut cx);
                b.next_from(&whole[1], ALL, &mut cx);
                assert_eq!(bits(&[a]), bits(&[b]));
            }
        }
    }
}

#[test]
fn stride_takes_the_first_voxel_that_counts() {
    let values: Vec<f32> = (0..3 * 5 * 7).map(|i| i as f32).collect();
    let shape = [3, 5, 7];
    let plain = Case { shape, value: Voxels::F32(values.clone()), mean: Voxels::F32(values.clone()), needed: None };
    for cells in chain(&plain, Reduce::Stride, false, &[ALL, ALL], Level::detect()) {
        for i in indices(cells.shape) {
            let v: [usize; 3] = std::array::from_fn(|a| i[a] * cells.factor[a]);
            assert_eq!(cells.at(i), ((v[0] * 5 + v[1]) * 7 + v[2]) as f64);
        }
    }
    let mut holes = values.clone();
    holes[0] = f32::NAN;
    let mut needed = vec![1; 105];
    needed[1] = 0;
    let case = Case { shape, value: Voxels::F32(holes), mean: Voxels::F32(values), needed: Some(needed) };
    let levels = chain(&case, Reduce::Stride, false, &[ALL], Level::detect());
    assert_eq!(levels[0].at([0; 3]), 7.0, "NaN at 0, excluded at 1: the next row's first");
}

#[test]
fn excluded_voxels_enter_only_where_nothing_else_is() {
    let fill = 1.0f32;
    let value = Voxels::F32(vec![fill, fill, 0.25, fill, 0.5, f32::NAN, f32::NAN, fill]);
    let case = Case { shape: [1, 1, 8], mean: value.clone(), value, needed: Some(vec![0, 0, 1, 0, 1, 1, 1, 0]) };
    let levels = chain(&case, Reduce::Mean, false, &[[false, false, true]; 3], Level::detect());
    let of = |l: usize, x| levels[l].at([0, 0, x]);
    assert_eq!([of(0, 0), of(0, 1), of(0, 2)], [1.0, 0.25, 0.5]);
    assert!(of(0, 3).is_nan(), "it covers a needed voxel, which is not valid");
    assert_eq!([of(1, 0), of(1, 1), of(2, 0)], [0.25, 0.5, 0.375]);
}

#[test]
fn a_negative_fill_of_a_standard_deviation_stays_negative() {
    let value = Voxels::F32(vec![-7.0, -7.0, -7.0, 2.0, -7.0, -7.0]);
    for needed in [[0, 0, 0, 1, 0, 0], [0; 6]] {
        let case = Case { shape: [1, 1, 6], mean: value.clone(), value: value.clone(), needed: Some(needed.to_vec()) };
        let levels = chain(&case, Reduce::Moments, true, &[[false, false, true]; 3], Level::detect());
        let of = |l: usize, x| levels[l].at([0, 0, x]);
        assert_eq!([of(0, 0), of(0, 2), of(1, 1)], [-7.0; 3]);
        if needed[3] == 1 {
            assert_eq!([of(0, 1), of(1, 0), of(2, 0)], [2.0; 3]);
        }
    }
}

#[test]
fn weighted_means_of_all_levels_equal_the_mean_of_level_0() {
    let case = Case::random([13, 21, 35], DType::U8, 0.0, 0.0, 3);
    let total: f64 = (0..case.value.len()).map(|i| case.value.at(i)).sum();
    for cells in chain(&case, Reduce::Mean, false, &[ALL; 5], Level::detect()) {
        let sum: f64 = indices(cells.shape).map(|i| cells.at(i) * cells.count(i)).sum();
        let count: f64 = indices(cells.shape).map(|i| cells.count(i)).sum();
        assert_eq!(count, case.value.len() as f64);
        assert!(close(sum, total), "{sum} {total}");
    }
}

#[test]
fn a_point_source_keeps_its_centroid_in_physical_units() {
    let shape = [16, 16, 32];
    let mut field = vec![0.0f32; 16 * 16 * 32];
    // Two equal points, so that the centroid is not at a cell's centre by chance; all levels cover them by whole cells.
    for [z, y, x] in [[8, 5, 16], [8, 5, 17], [9, 5, 16], [9, 5, 17], [8, 4, 16], [8, 4, 17], [9, 4, 16], [9, 4, 17]] {
        field[(z * 16 + y) * 32 + x] = 1.0;
    }
    let (spacing, origin) = ([1.0, 0.7, 0.6], [5.0, -3.0, 0.25]);
    let pyramid = crate::store::Pyramid::new(shape, spacing, origin, [64; 3], Some(2), false);
    let value = Voxels::F32(field.clone());
    let case = Case { shape, mean: value.clone(), value, needed: None };
    let cells = chain(&case, Reduce::Mean, false, &[pyramid.levels[1].halved], Level::detect());
    let centroid = |shape: Shape, at: &dyn Fn([usize; 3]) -> f64, scale: [f64; 3], shift: [f64; 3]| {
        let mass: f64 = indices(shape).map(at).sum();
        let along = |a: usize| indices(shape).map(|i| at(i) * (shift[a] + scale[a] * i[a] as f64)).sum::<f64>() / mass;
        [along(0), along(1), along(2)]
    };
    let fine = centroid(shape, &|i| field[(i[0] * 16 + i[1]) * 32 + i[2]] as f64, spacing, origin);
    let level = &pyramid.levels[1];
    let coarse = centroid(level.shape, &|i| cells[0].at(i), level.scale, level.translation);
    assert!((0..3).all(|a| (fine[a] - coarse[a]).abs() < 1e-12), "{fine:?} {coarse:?}");
}

#[test]
fn moments_of_a_large_offset_keep_their_digits() {
    // Means 1e6 + small: variance of means is 0.25 exactly; E[v^2] - E[v]^2 in f64 would lose 4 digits, in f32 all.
    let n = 64 * 4 * 4;
    let mean: Vec<f64> = (0..n).map(|i| 1e6 + (i % 2) as f64).collect();
    let case = Case { shape: [4, 4, 64], value: Voxels::F64(vec![0.125; n]), mean: Voxels::F64(mean), needed: None };
    for cells in chain(&case, Reduce::Moments, false, &[ALL; 4], Level::detect()) {
        assert!(indices(cells.shape).all(|i| cells.at(i) == 0.375));
    }
    let flat = Case { mean: Voxels::F64(vec![1e6 + 0.1; n]), ..case };
    for cells in chain(&flat, Reduce::Moments, false, &[ALL; 4], Level::detect()) {
        assert!(indices(cells.shape).all(|i| cells.at(i) == 0.125), "equal means have no variance between them");
    }
}

#[test]
fn infinities_stay_in_their_cells_and_make_no_count() {
    let mut v = vec![1.0f32; 16];
    (v[0], v[1], v[4]) = (f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY);
    let value = Voxels::F32(v);
    let case = Case { shape: [1, 1, 16], mean: value.clone(), value, needed: None };
    let levels = chain(&case, Reduce::Mean, false, &[ALL, ALL], Level::detect());
    assert!(levels[0].at([0, 0, 0]).is_nan());
    assert_eq!(levels[0].at([0, 0, 2]), f64::INFINITY);
    assert_eq!((levels[0].at([0, 0, 1]), levels[1].at([0, 0, 3])), (1.0, 1.0));
}

#[test]
fn written_cells_are_rounded_once_and_cut_to_the_box() {
    let case = Case::random([6, 10, 22], DType::U16, 0.0, 0.0, 4);
    let cells = &chain(&case, Reduce::Mean, false, &[ALL], Level::detect())[0];
    let (lo, shape) = ([1, 2, 3], [2, 3, 7]);
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let (mut codes, mut floats) = (vec![0u8; 42], vec![0f32; 42]);
    let range = Mapping { range: Some([0.0, 203.0]), fill: 0.0 };
    cells.write(lo, range, AnyViewMut::U8(ViewMut::dense(&mut codes, shape)), &mut cx);
    cells.write(lo, Mapping::KEEP, AnyViewMut::F32(ViewMut::dense(&mut floats, shape)), &mut cx);
    for (i, at) in indices(shape).enumerate() {
        let v = cells.at(std::array::from_fn(|a| lo[a] + at[a]));
        assert_eq!(floats[i], v as f32);
        assert_eq!(codes[i] as f64, (v * (255.0 / 203.0)).round_ties_even());
    }
}

#[test]
fn buffers_are_reused() {
    let case = Case::random([8, 8, 8], DType::F32, 0.0, 0.0, 1);
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let mut cells = Cells::default();
    cells.first(Reduce::Mean, false, case.level0(), ALL, &mut cx);
    let (held, at) = (cells.capacity_bytes(), cells.value.as_ptr());
    cells.first(Reduce::Mean, false, case.part([0; 3], [4, 8, 8]).level0(), ALL, &mut cx);
    assert_eq!((cells.capacity_bytes(), cells.value.as_ptr()), (held, at));
    assert_eq!(cells.shape, [2, 4, 4]);
}

#[test]
fn cells_of_one_value_are_those_of_its_voxels() {
    let (mut scratch, level) = (Scratch::new(), Level::detect());
    let mut cx = Context { level, scratch: &mut scratch };
    let values = [
        (DType::U8, 7.0),
        (DType::F32, 0.1f32 as f64),
        (DType::F32, -0.0),
        (DType::I32, -2147483647.0),
        (DType::F32, f64::NAN),
        (DType::F64, f64::NAN),
        (DType::F64, 0.0),
    ];
    for shape in [[8, 8, 8], [13, 9, 21], [1, 1, 1], [5, 1, 40]] {
        for ((dtype, v), kind) in values.iter().flat_map(|v| KINDS.map(|k| (*v, k))) {
            for excluded in [false, true] {
                let mut voxels = Voxels::zeroed(dtype, shape.iter().product());
                crate::with_voxels!(&mut voxels, w => w.fill(Voxel::from_f64(v)));
                let mask = vec![0; shape.iter().product()];
                let needed = excluded.then(|| View::dense(&mask, shape));
                let src = Level0 { value: voxels.view(shape), mean: None, needed };
                let (mut made, mut next, mut short) = (Cells::default(), Cells::default(), Cells::default());
                made.first(kind, false, src, ALL, &mut cx);
                for k in 1..4 {
                    short.uniform(kind, [1 << k; 3], shape, v, excluded);
                    let (mut a, mut b) = (Vec::new(), Vec::new());
                    made.store(&mut a);
                    short.store(&mut b);
                    let bits = |v: &[f64]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                    assert_eq!(bits(&a), bits(&b), "{shape:?} {dtype} {v} {kind:?} {excluded} level {k}");
                    next.next_from(&made, ALL, &mut cx);
                    std::mem::swap(&mut made, &mut next);
                }
            }
        }
    }
}

/// Reductions of one channel by itself.
const KINDS: [Reduce; 4] = [Reduce::Mean, Reduce::Min, Reduce::Max, Reduce::Stride];
