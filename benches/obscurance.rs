//! Speed and accuracy of obscurance sweeps, one thread.
//!
//! `cargo bench --bench obscurance [-- --accuracy | --edge N | --raw FILE Z Y X | --only TEXT | --bricks DISTANCE | --halves | --weights | --where | --opacities]`:
//! CPU seconds of the best of several sweeps over a cube of 256^3 voxels, by field, element type, reach and instruction set;
//! with `--accuracy`, errors of direction sets against 6000 directions; with `--bricks`, what halos cost; with `--halves`, two
//! threads; with `--weights`, colours and normals; with `--where`, masks; with `--opacities`, what a transfer table makes.

use occlude::brick::Scratch;
use occlude::grid::{AnyView, AnyViewMut, Region, Shape, View, ViewMut};
use occlude::kernel::Context;
use occlude::kernel::obscurance::{ObscuranceIo, ObscuranceParams, Prepared, Ranks};
use occlude::kernel::simd::Level;
use occlude::stage::{DirectionSet, DirectionWeights, Rho};

fn params() -> ObscuranceParams {
    ObscuranceParams {
        directions: 42,
        set: DirectionSet::Icosahedron,
        weights: DirectionWeights::Uniform,
        rho: Rho::Sqrt,
        max_distance: 64.0,
        spacing: [1.0; 3],
        flipped: false,
        missing: None,
        ambient: [1.0; 3],
        ranks: None,
    }
}

/// Seconds that this thread has computed: other users of the machine do not count.
fn cpu_seconds() -> f64 {
    occlude::store::os::thread_time().expect("a thread clock").as_secs_f64()
}

fn hash(p: [i64; 3]) -> u64 {
    let mut h = (p[0] as u64) << 42 ^ (p[1] as u64) << 21 ^ p[2] as u64;
    for _ in 0..2 {
        h = (h ^ h >> 31).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }
    h >> 40
}

/// Values of a field in [0, 1).
fn field(name: &str, shape: Shape) -> Vec<f64> {
    let edge = shape[2] as f64;
    let value = |p: [i64; 3]| {
        let [z, y, x] = p.map(|c| c as f64);
        let noise = hash(p) as f64 / (1 << 24) as f64;
        match name {
            "noise" => noise,
            "ramp x" => x / edge,
            "ramp" => (x + y + z) / (3.0 * edge),
            "falling" => 1.0 - (x + y + z + 1.0) / (3.0 * edge),
            "plateaus" => hash(p.map(|c| c / 40)) as f64 / (1 << 24) as f64,
            "sparse" => {
                let tube = |a: f64, b: f64| ((a * 0.071).sin() + (b * 0.053).cos()).abs();
                if tube(x, y) < 0.06 || tube(y, z) < 0.05 { 0.5 + 0.5 * noise } else { 0.0 }
            }
            "ct" => {
                let wave = (x * 0.05).sin() * (y * 0.043).cos() + (z * 0.031).sin() * (x * 0.017).cos();
                let ball = ((x - 128.0).powi(2) + (y - 128.0).powi(2) + (z - 128.0).powi(2)).sqrt();
                let body = if ball < 110.0 { 0.35 + 0.15 * wave } else { 0.02 };
                (body + 0.06 * noise + if (ball - 95.0).abs() < 4.0 { 0.35 } else { 0.0 }).clamp(0.0, 0.999)
            }
            _ => panic!("no field {name}"),
        }
    };
    Region::whole(shape).iter().map(value).collect()
}

/// CPU seconds of the best of `runs` sweeps over the whole volume, and a checksum of the result.
fn time(level: Level, p: &ObscuranceParams, view: AnyView, runs: usize) -> (f64, u64) {
    let shape = view.shape();
    let whole = Region::whole(shape);
    let prepared = Prepared::new(p);
    let mut out = vec![0f32; whole.voxels()];
    let mut scratch = Scratch::new();
    let mut best = f64::INFINITY;
    for _ in 0..runs {
        let io = ObscuranceIo {
            colour: None,
            normal: None,
            needed: None,
            openness: Some(AnyViewMut::F32(ViewMut::dense(&mut out, shape))),
            rgb: None,
        };
        let start = cpu_seconds();
        prepared.sweep(view, whole, whole, io, &mut Context { level, scratch: &mut scratch });
        best = best.min(cpu_seconds() - start);
    }
    let sum = out.iter().fold(0u64, |h, v| h.rotate_left(5).wrapping_add(v.to_bits() as u64));
    (best, sum)
}

fn row(name: &str, kind: &str, level: Level, p: &ObscuranceParams, view: AnyView) {
    let voxels = view.shape().iter().product::<usize>() as f64;
    let (seconds, sum) = time(level, p, view, 3);
    let each = seconds * 1e9 / voxels / p.directions as f64;
    println!(
        "{name:<10} {kind:<4} {level:<9?} dmax {:>4}  {:>3} directions  {seconds:7.3} s  {each:6.3} ns/voxel/direction  {sum:016x}",
        p.max_distance, p.directions
    );
}

/// Bricks from the middle of a volume of 384^3, with their halos.
fn bricks(max_distance: f64) {
    let edge = 384;
    let shape = [edge; 3];
    let data: Vec<u8> = field("ct", shape).iter().map(|v| (v * 256.0) as u8).collect();
    let p = ObscuranceParams { max_distance, ..params() };
    let prepared = Prepared::new(&p);
    let mut scratch = Scratch::new();
    for brick in [[64; 3], [64, 128, 128], [128; 3], [128, 128, 256], [128, 256, 256], [256, 128, 256], [256; 3]] {
        let lo = brick.map(|n: usize| ((edge - n) / 2) as i64);
        let dst = Region::new(lo, std::array::from_fn(|a| lo[a] + brick[a] as i64));
        let src = dst.grow(prepared.reach()).clip(&Region::whole(shape));
        let view = View::dense(&data, shape).part(src.lo.map(|v| v as usize), src.shape());
        let mut out = vec![0f32; dst.voxels()];
        let mut best = f64::INFINITY;
        for _ in 0..2 {
            let openness = Some(AnyViewMut::F32(ViewMut::dense(&mut out, brick)));
            let io = ObscuranceIo { colour: None, normal: None, needed: None, openness, rgb: None };
            let start = cpu_seconds();
            let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
            prepared.sweep(AnyView::U8(view), src, dst, io, &mut cx);
            best = best.min(cpu_seconds() - start);
        }
        let each = best * 1e9 / dst.voxels() as f64 / p.directions as f64;
        let reads = src.voxels() as f64 / dst.voxels() as f64;
        println!("{brick:?} dmax {max_distance:>4}  reads {reads:5.2}  {each:6.3} ns/voxel/direction");
    }
}

/// Wall-clock seconds of two threads that sweep a half of the cube each, halos included.
fn halves(edge: usize) {
    let shape = [edge; 3];
    let data: Vec<u8> = field("ct", shape).iter().map(|v| (v * 256.0) as u8).collect();
    let prepared = Prepared::new(&params());
    let whole = Region::whole(shape);
    let half = (edge / 2) as i64;
    let mut out = vec![0f32; whole.voxels()];
    let mut scratches = [Scratch::new(), Scratch::new()];
    for _ in 0..4 {
        let start = std::time::Instant::now();
        std::thread::scope(|scope| {
            for ((part, out), scratch) in (0..).zip(out.chunks_mut(whole.voxels() / 2)).zip(&mut scratches) {
                let (prepared, data) = (&prepared, &data);
                scope.spawn(move || {
                    let mut dst = whole;
                    (dst.lo[0], dst.hi[0]) = (part * half, (part + 1) * half);
                    let src = dst.grow(prepared.reach()).clip(&whole);
                    let view = View::dense(data, shape).part(src.lo.map(|v| v as usize), src.shape());
                    let openness = Some(AnyViewMut::F32(ViewMut::dense(out, dst.shape())));
                    let io = ObscuranceIo { colour: None, normal: None, needed: None, openness, rgb: None };
                    let mut cx = Context { level: Level::detect(), scratch };
                    prepared.sweep(AnyView::U8(view), src, dst, io, &mut cx);
                });
            }
        });
        println!("two threads, a half of {edge}^3 each, dmax 64: {:.3} s", start.elapsed().as_secs_f64());
    }
}

/// Openness, colours and normals over 128^3 CT-like voxels.
fn weights() {
    let shape = [128; 3];
    let whole = Region::whole(shape);
    let data: Vec<u8> = field("ct", shape).iter().map(|v| (v * 256.0) as u8).collect();
    let floats: Vec<f32> = data.iter().map(|v| *v as f32).collect();
    let three = [0; 3].map(|_| View::dense(&floats, shape));
    let colours: Vec<[f32; 4]> = floats.iter().map(|&v| [v; 4]).collect();
    let prepared = Prepared::new(&params());
    let mut scratch = Scratch::new();
    for (name, weigh, bleed) in
        [("openness", false, false), ("rgb", false, true), ("normals", true, false), ("both", true, true)]
    {
        for level in [Level::Baseline, Level::detect()] {
            let mut results = [0; 4].map(|_| vec![0f32; data.len()]);
            let mut best = f64::INFINITY;
            for _ in 0..2 {
                let [openness, r, g, b] = &mut results;
                let view = |v| AnyViewMut::F32(ViewMut::dense(v, shape));
                let io = ObscuranceIo {
                    colour: bleed.then(|| View::dense(&colours[..], shape)),
                    normal: weigh.then_some(three),
                    needed: None,
                    openness: Some(view(openness)),
                    rgb: bleed.then(|| [view(r), view(g), view(b)]),
                };
                let start = cpu_seconds();
                let mut cx = Context { level, scratch: &mut scratch };
                prepared.sweep(AnyView::U8(View::dense(&data, shape)), whole, whole, io, &mut cx);
                best = best.min(cpu_seconds() - start);
            }
            println!("{name:<9} {level:<9?} {:6.2} ns/voxel/direction", best * 1e9 / data.len() as f64 / 42.0);
        }
    }
}

/// Sweeps of 256^3 of which only some voxels are needed.
fn masks() {
    let shape = [256; 3];
    let whole = Region::whole(shape);
    let data: Vec<u8> = field("ct", shape).iter().map(|v| (v * 256.0) as u8).collect();
    let distance = |p: [i64; 3]| p.iter().map(|c| (*c as f64 - 128.0).powi(2)).sum::<f64>().sqrt();
    let prepared = Prepared::new(&params());
    let mut scratch = Scratch::new();
    let masks: [(&str, Option<Vec<u8>>); 4] = [
        ("all", None),
        ("body", Some(whole.iter().map(|p| u8::from(distance(p) < 110.0)).collect())),
        ("band of 2", Some(whole.iter().map(|p| u8::from((distance(p) - 95.0).abs() < 2.0)).collect())),
        ("0.1 %", Some(whole.iter().map(|p| u8::from(hash(p).is_multiple_of(1000))).collect())),
    ];
    for (name, mask) in masks {
        let mut out = vec![0f32; data.len()];
        let (mut best, mut counts) = (f64::INFINITY, Default::default());
        for _ in 0..3 {
            let openness = Some(AnyViewMut::F32(ViewMut::dense(&mut out, shape)));
            let needed = mask.as_ref().map(|m| View::dense(&m[..], shape));
            let io = ObscuranceIo { colour: None, normal: None, needed, openness, rgb: None };
            let start = cpu_seconds();
            let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
            counts = prepared.sweep(AnyView::U8(View::dense(&data, shape)), whole, whole, io, &mut cx);
            best = best.min(cpu_seconds() - start);
        }
        let needed = mask.map_or(1.0, |m| m.iter().map(|&v| v as f64).sum::<f64>() / m.len() as f64);
        println!("{name:<10} needed {:5.1} %  {best:6.3} s  {counts:?}", 100.0 * needed);
    }
}

/// Opacities of 8- and 16-bit voxels: as ranks of what a table makes of them, and as the floats that it makes.
fn opacities() {
    fn table(n: usize) -> Vec<f32> {
        (0..n).map(|i| (i as f32 / n as f32 - 0.1).max(0.0).sqrt()).collect()
    }
    let shape = [256; 3];
    let values = field("ct", shape);
    let u8s: Vec<u8> = values.iter().map(|v| (v * 256.0) as u8).collect();
    let u16s: Vec<u16> = values.iter().map(|v| (v * 65536.0) as u16).collect();
    let tables = [table(1 << 8), table(1 << 16)];
    let floats = [
        u8s.iter().map(|v| tables[0][*v as usize]).collect::<Vec<f32>>(),
        u16s.iter().map(|v| tables[1][*v as usize]).collect(),
    ];
    let views = [AnyView::U8(View::dense(&u8s, shape)), AnyView::U16(View::dense(&u16s, shape))];
    let level = Level::detect();
    for max_distance in [64.0, 256.0] {
        let p = ObscuranceParams { max_distance, ..params() };
        for (kind, ((view, table), floats)) in ["u8", "u16"].iter().zip(views.iter().zip(&tables).zip(&floats)) {
            row("values", kind, level, &p, *view);
            row("ranks", kind, level, &ObscuranceParams { ranks: Ranks::new(table), ..p.clone() }, *view);
            row("floats", kind, level, &p, AnyView::F32(View::dense(floats, shape)));
        }
    }
}

fn speed(edge: usize, only: Option<&str>) {
    let shape = [edge; 3];
    let wanted = |name: &str| only.is_none_or(|o| name.contains(o));
    for name in ["ct", "sparse", "noise", "ramp x", "ramp", "falling", "plateaus"] {
        if !only.is_none_or(|o| o.contains(name)) {
            continue;
        }
        let values = field(name, shape);
        let u8s: Vec<u8> = values.iter().map(|v| (v * 256.0) as u8).collect();
        let view = AnyView::U8(View::dense(&u8s, shape));
        for max_distance in [8.0, 64.0, 256.0] {
            let label = format!("u8 {name} {max_distance}");
            if wanted(&label) {
                row(name, "u8", Level::detect(), &ObscuranceParams { max_distance, ..params() }, view);
            }
        }
        if name == "ct" || name == "noise" {
            for level in Level::available() {
                if level != Level::detect() && wanted(&format!("u8 {name} {level:?}")) {
                    row(name, "u8", level, &params(), view);
                }
            }
            let u16s: Vec<u16> = values.iter().map(|v| (v * 65536.0) as u16).collect();
            let f32s: Vec<f32> = values.iter().map(|v| *v as f32).collect();
            for max_distance in [64.0, 256.0] {
                let p = ObscuranceParams { max_distance, ..params() };
                if wanted(&format!("u16 {name} {max_distance}")) {
                    row(name, "u16", Level::detect(), &p, AnyView::U16(View::dense(&u16s, shape)));
                }
                if wanted(&format!("f32 {name} {max_distance}")) {
                    row(name, "f32", Level::detect(), &p, AnyView::F32(View::dense(&f32s, shape)));
                }
            }
        }
    }
}

/// Root-mean-square and largest difference of each set from 6000 Fibonacci directions.
fn accuracy() {
    let shape = [96; 3];
    for name in ["ct", "sparse"] {
        let data: Vec<u8> = field(name, shape).iter().map(|v| (v * 256.0) as u8).collect();
        for rho in [Rho::Step, Rho::Sqrt] {
            let open = |set, directions, weights| {
                let p = ObscuranceParams { set, directions, weights, rho, max_distance: 32.0, ..params() };
                let mut out = vec![0f32; data.len()];
                let io = ObscuranceIo {
                    colour: None,
                    normal: None,
                    needed: None,
                    openness: Some(AnyViewMut::F32(ViewMut::dense(&mut out, shape))),
                    rgb: None,
                };
                let whole = Region::whole(shape);
                let mut scratch = Scratch::new();
                let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
                Prepared::new(&p).sweep(AnyView::U8(View::dense(&data, shape)), whole, whole, io, &mut cx);
                out
            };
            let truth = open(DirectionSet::Fibonacci, 6000, DirectionWeights::Uniform);
            let (ico, fib) = (DirectionSet::Icosahedron, DirectionSet::Fibonacci);
            for (set, n) in [(ico, 12), (ico, 42), (ico, 162), (fib, 12), (fib, 42), (fib, 64), (fib, 162), (fib, 642)]
            {
                for weights in [DirectionWeights::Uniform, DirectionWeights::Voronoi] {
                    if set == fib && weights == DirectionWeights::Voronoi {
                        continue;
                    }
                    let got = open(set, n, weights);
                    let differ = got.iter().zip(&truth).map(|(a, b)| (*a as f64 - *b as f64).abs());
                    let rmse = (differ.clone().map(|d| d * d).sum::<f64>() / data.len() as f64).sqrt();
                    let max = differ.fold(0.0, f64::max);
                    println!("{name:<8} {rho:<6?} {set:<12?} {n:>4} {weights:<8?} rmse {rmse:.4}  max {max:.4}");
                }
            }
        }
    }
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let after = |key: &str| args.iter().position(|a| a == key).map(|i| &args[i + 1..]);
    if after("--accuracy").is_some() {
        return accuracy();
    }
    if after("--weights").is_some() {
        return weights();
    }
    if after("--where").is_some() {
        return masks();
    }
    if after("--opacities").is_some() {
        return opacities();
    }
    if after("--halves").is_some() {
        return halves(256);
    }
    if let Some([distance, ..]) = after("--bricks") {
        return bricks(distance.parse().expect("a distance in voxels"));
    }
    if let Some([file, z, y, x, ..]) = after("--raw") {
        let shape = [z, y, x].map(|n| n.parse().expect("an extent"));
        let data = std::fs::read(file).expect("a raw u8 volume");
        for max_distance in [64.0, 256.0] {
            let p = ObscuranceParams { max_distance, ..params() };
            row("raw", "u8", Level::detect(), &p, AnyView::U8(View::dense(&data, shape)));
        }
        return;
    }
    let edge = after("--edge").map_or(256, |a| a[0].parse().expect("an edge"));
    speed(edge, after("--only").map(|a| a[0].as_str()));
}
