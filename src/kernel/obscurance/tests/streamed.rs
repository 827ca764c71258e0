//! Columns against the whole box, bit for bit.

use super::*;

/// The streamed sweep of `out`; every box that it fetches must lie in the volume, and no more is read than was said.
pub(super) fn streamed<T: Coded>(
    level: Level,
    p: &ObscuranceParams,
    field: &Field<T>,
    out: Region,
    needed: Option<&[u8]>,
) -> Vec<f32>
where
    for<'a> AnyView<'a>: From<View<'a, T>>,
{
    with_normals(level, p, field, out, needed, None)
}

/// The same; `gradient` covers the output box.
fn with_normals<T: Coded>(
    level: Level,
    p: &ObscuranceParams,
    field: &Field<T>,
    out: Region,
    needed: Option<&[u8]>,
    gradient: Option<&[Vec<f32>; 3]>,
) -> Vec<f32>
where
    for<'a> AnyView<'a>: From<View<'a, T>>,
{
    let prepared = Prepared::new(p);
    let own: Vec<T> = out.iter().map(|q| field.data[field.index(q).unwrap()]).collect();
    let mut openness = vec![-1f32; out.voxels()];
    let asked = prepared.streamed_bytes(T::DTYPE, field.region.shape(), out.shape(), gradient.is_some())
        + needed.map_or(0, |_| prepared.masked_bytes(out.shape()));
    let mut scratch = Scratch::new();
    // What is left over from before must not matter.
    scratch.take(asked).fill(0xff);
    let mut read = 0;
    let mut fetch = |part: Region, mut dst: AnyViewMut| {
        assert!(field.region.contains(&part) && dst.shape() == part.shape());
        read += part.voxels();
        for q in part.iter() {
            let at = part.offset_of(&Region::new(q, q));
            let v = field.data[field.index(q).unwrap()].to_f64();
            crate::with_view!(AnyViewMut, dst.reborrow(), view => set(view, at, v));
        }
        Ok::<(), ()>(())
    };
    fn set<T: Voxel>(mut view: ViewMut<T>, at: [usize; 3], v: f64) {
        view.set(at, T::from_f64(v));
    }
    let view = AnyView::from(View::dense(&own, out.shape()));
    let dst = AnyViewMut::F32(ViewMut::dense(&mut openness, out.shape()));
    let mut cx = Context { level, scratch: &mut scratch };
    let needed = needed.map(|n| View::dense(n, out.shape()));
    let normal = gradient.map(|g| [0, 1, 2].map(|c| View::dense(&g[c], out.shape())));
    let io = ObscuranceIo { colour: None, normal, needed, openness: Some(dst), rgb: None };
    let done = prepared.sweep_streamed(view, out, field.region, io, &mut fetch, &mut cx).unwrap();
    assert!(done.flat || done.lines.total > 0);
    assert!(scratch.bytes() <= asked.next_multiple_of(64), "{} bytes taken, {asked} promised", scratch.bytes());
    match needed {
        None => assert_eq!(read, prepared.streamed_voxels(out, field.region, gradient.is_some())),
        Some(_) => assert!(read <= prepared.streamed_voxels(out, field.region, gradient.is_some())),
    }
    openness
}

fn check<T: Coded>(seed: u64)
where
    for<'a> AnyView<'a>: From<View<'a, T>>,
{
    let parts = [[[0, 0, 0], [40, 90, 150]], [[11, 3, 70], [30, 88, 140]], [[39, 89, 149], [40, 90, 150]]];
    for (i, set) in [DirectionSet::Icosahedron, DirectionSet::Fibonacci].into_iter().enumerate() {
        let region = Region::whole([40, 90, 150]).shift([-20, 7, 1000].map(|s| s * i as i64));
        let data = hostile::<T>(region.voxels(), seed + i as u64);
        let field = Field { data: &data, region };
        let p = ObscuranceParams {
            set,
            directions: [42, 9][i],
            max_distance: [30.0, 77.0][i],
            spacing: [[1.0; 3], [2.0, 1.0, 0.7]][i],
            missing: [None, Some(0)][i],
            flipped: i == 1,
            ..params()
        };
        for (k, [lo, hi]) in parts.into_iter().enumerate() {
            let out = Region::new(lo, hi).shift(region.lo);
            for level in Level::available() {
                if k == 0 && level != Level::detect() {
                    continue;
                }
                let want = sweep_part(level, &p, &field, out, None, None).openness;
                assert_eq!(
                    bits(&streamed(level, &p, &field, out, None)),
                    bits(&want),
                    "{} {out:?} {level:?}",
                    T::DTYPE
                );
            }
        }
    }
}

#[test]
fn columns_give_the_bits_of_the_whole_box() {
    check::<u8>(51);
    check::<i16>(52);
    check::<f32>(53);
    check::<f64>(54);
}

#[test]
fn columns_of_long_reach_and_many_tiles_give_the_same_bits() {
    // Wider than a tile along y, and a reach that leaves the volume on all sides of small parts.
    let region = Region::whole([9, 300, 40]);
    let data = mixed(region, 5);
    let field = Field { data: &data, region };
    let p = ObscuranceParams { max_distance: 256.0, ..params() };
    for out in [region, Region::new([2, 100, 5], [5, 290, 17])] {
        let want = sweep_part(Level::detect(), &p, &field, out, None, None).openness;
        assert_eq!(bits(&streamed(Level::detect(), &p, &field, out, None)), bits(&want), "{out:?}");
    }
}

#[test]
fn columns_weighed_by_normals_give_the_same_bits() {
    // Wider than a tile of such sums along y; to the right a constant, where nothing is occluded.
    let region = Region::whole([20, 150, 40]).shift([5, -9, 3]);
    let mut data = mixed(region, 6);
    region.iter().zip(&mut data).filter(|(p, _)| p[2] > 25).for_each(|(_, v)| *v = 7);
    let field = Field { data: &data, region };
    let mut noise = Noise(3);
    let normals = [0, 1, 2].map(|_| region.iter().map(|_| (noise.next() % 5) as f32 - 2.0).collect::<Vec<f32>>());
    let p = ObscuranceParams { max_distance: 12.0, flipped: true, ..params() };
    for (lo, hi) in [([0, 0, 0], [20, 150, 40]), ([3, 9, 38], [9, 140, 40])] {
        let out = Region::new(lo, hi).shift(region.lo);
        let own = normals.each_ref().map(|n| out.iter().map(|q| n[field.index(q).unwrap()]).collect::<Vec<f32>>());
        for level in Level::available() {
            let want = sweep_part(level, &p, &field, out, None, Some(&normals)).openness;
            let got = with_normals(level, &p, &field, out, None, Some(&own));
            assert_eq!(bits(&got), bits(&want), "{out:?} {level:?}");
        }
    }
}

#[test]
fn a_failed_fetch_ends_the_sweep() {
    let region = Region::whole([5, 6, 7]);
    let data = mixed(region, 5);
    let view = AnyView::U8(View::dense(&data, region.shape()));
    let mut out = vec![0f32; data.len()];
    let dst = AnyViewMut::F32(ViewMut::dense(&mut out, region.shape()));
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    let mut left = 3;
    let mut fetch = |_: Region, _: AnyViewMut| {
        left -= 1;
        if left == 0 { Err("gone") } else { Ok(()) }
    };
    let io = ObscuranceIo { colour: None, normal: None, needed: None, openness: Some(dst), rgb: None };
    let prepared = Prepared::new(&params());
    assert_eq!(prepared.sweep_streamed(view, region, region, io, &mut fetch, &mut cx), Err("gone"));
    assert_eq!(left, 0);
}
