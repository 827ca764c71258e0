//! Needed voxels come out the same whatever is skipped around them.

use super::*;

/// Masks of all kinds over a box: all, none, noise, a few, a slab, a ball's shell.
fn masks(out: Region) -> Vec<Vec<u8>> {
    let n = out.shape();
    let mut noise = Noise(99);
    let mut random =
        |every: u64| -> Vec<u8> { out.iter().map(|_| u8::from(noise.next().is_multiple_of(every))).collect() };
    let (half, few) = (random(2), random(3000));
    let local = |p: [i64; 3]| [0, 1, 2].map(|a| (p[a] - out.lo[a]) as f64 - n[a] as f64 / 2.0);
    let shell = |p| {
        let d = local(p).iter().map(|c| c * c).sum::<f64>().sqrt();
        u8::from((d - n[2] as f64 / 3.0).abs() < 2.0)
    };
    let slab = out.iter().map(|p| u8::from(local(p)[1].abs() < 1.0)).collect();
    vec![vec![1; out.voxels()], vec![0; out.voxels()], half, few, slab, out.iter().map(shell).collect()]
}

#[test]
fn skipped_lines_never_show() {
    let region = Region::whole([21, 34, 150]).shift([5, -3, 11]);
    let out = Region::new([8, 0, 20], [24, 28, 155]);
    let data = mixed(region, 8);
    let mut noise = Noise(12);
    let mut field_of =
        || -> [Vec<f32>; 3] { [0, 1, 2].map(|_| region.iter().map(|_| noise.unit() as f32 - 0.4).collect()) };
    let (colour, gradient) = (field_of(), field_of());
    let part = |data: &[f32], r: Region| -> Vec<f32> {
        let field = Field { data, region };
        r.iter().map(|q| data[field.index(q).unwrap()]).collect()
    };
    for (weigh, bleed) in [(false, false), (false, true), (true, true)] {
        let p = ObscuranceParams { max_distance: 40.0, ambient: [0.5, 1.0, 2.0], ..params() };
        let prepared = Prepared::new(&p);
        let src = out.grow(prepared.reach()).clip(&region);
        let voxels: Vec<u8> = src.iter().map(|q| data[Field { data: &data, region }.index(q).unwrap()]).collect();
        let colours = interleave(&[0, 1, 2].map(|c| part(&colour[c], src)));
        let normals = [0, 1, 2].map(|c| part(&gradient[c], out));
        let sweep = |level: Level, needed: Option<&[u8]>| {
            let mut results = [0, 1, 2, 3].map(|_| vec![-1f32; out.voxels()]);
            let [openness, r, g, b] = &mut results;
            let view = |v| AnyViewMut::F32(ViewMut::dense(v, out.shape()));
            let io = ObscuranceIo {
                colour: bleed.then(|| View::dense(&colours[..], src.shape())),
                normal: weigh.then(|| [0, 1, 2].map(|c| View::dense(&normals[c], out.shape()))),
                needed: needed.map(|n| View::dense(n, out.shape())),
                openness: Some(view(openness)),
                rgb: bleed.then(|| [view(r), view(g), view(b)]),
            };
            let mut scratch = Scratch::new();
            let asked = prepared.scratch_bytes(DType::U8, src.shape(), out.shape(), bleed, weigh)
                + needed.map_or(0, |_| prepared.masked_bytes(out.shape()));
            let mut cx = Context { level, scratch: &mut scratch };
            let counts = prepared.sweep(AnyView::U8(View::dense(&voxels, src.shape())), src, out, io, &mut cx);
            assert!(scratch.bytes() <= asked.next_multiple_of(64));
            (results, counts)
        };
        for level in Level::available() {
            let (whole, all) = sweep(level, None);
            assert!(all.total > 0 && all.masked == 0, "{all:?}");
            for (kind, mask) in masks(out).into_iter().enumerate() {
                let (part, counts) = sweep(level, Some(&mask));
                for (got, want) in part.iter().zip(&whole) {
                    let mut both = got.iter().zip(want).zip(&mask).filter(|(_, needed)| **needed != 0);
                    assert!(
                        both.all(|((a, b), _)| a.to_bits() == b.to_bits()),
                        "{level:?} mask {kind} {weigh} {bleed}"
                    );
                }
                let searched = counts.total - counts.masked;
                match kind {
                    0 => assert_eq!(counts, all),
                    1 => assert_eq!(counts, LineCounts::default()),
                    _ => assert!(searched < all.total, "mask {kind}: {counts:?} of {all:?}"),
                }
            }
        }
    }
}

#[test]
fn columns_skip_what_boxes_skip() {
    let region = Region::whole([21, 34, 150]).shift([5, -3, 11]);
    let out = Region::new([8, 0, 20], [24, 28, 155]);
    let data = mixed(region, 8);
    let field = Field { data: &data, region };
    let p = ObscuranceParams { max_distance: 40.0, ..params() };
    let whole = sweep_part(Level::detect(), &p, &field, out, None, None).openness;
    for (kind, mask) in masks(out).into_iter().enumerate() {
        let part = streamed::streamed(Level::detect(), &p, &field, out, Some(&mask));
        let mut both = part.iter().zip(&whole).zip(&mask).filter(|(_, needed)| **needed != 0);
        assert!(both.all(|((a, b), _)| a.to_bits() == b.to_bits()), "mask {kind}");
    }
}

#[test]
fn lines_that_nothing_can_occlude_are_counted_alike_at_every_level() {
    // One bright plane: lines inside of it see nothing greater.
    let region = Region::whole([40, 20, 70]);
    let data: Vec<u8> = region.iter().map(|p| if p[0] >= 20 { 200 } else { 3 }).collect();
    let p = ObscuranceParams { max_distance: 9.0, ..params() };
    let prepared = Prepared::new(&p);
    let counts: Vec<LineCounts> = Level::available()
        .into_iter()
        .map(|level| {
            let mut out = vec![0f32; data.len()];
            let openness = Some(AnyViewMut::F32(ViewMut::dense(&mut out, region.shape())));
            let io = ObscuranceIo { colour: None, normal: None, needed: None, openness, rgb: None };
            let mut scratch = Scratch::new();
            let mut cx = Context { level, scratch: &mut scratch };
            prepared.sweep(AnyView::U8(View::dense(&data, region.shape())), region, region, io, &mut cx)
        })
        .collect();
    assert!(counts.windows(2).all(|c| c[0] == c[1]), "{counts:?}");
    assert!(counts[0].open > counts[0].total / 4 && counts[0].open < counts[0].total, "{counts:?}");
}
