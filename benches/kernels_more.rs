//! Times exact rank, quantile levels, bounds by four moments (beside `cdf_power`), Gaussian, the occlusion-map chain and gradient on one core: ns per output voxel, Mvoxel/s, and the
//! multiple of the time that memcpy takes for the same voxels of a 256^3 volume in this process. Each kernel's result on
//! this CPU's level is compared with that of the portable code first.
//!
//! `cargo bench --bench kernels_more [-- FILTER]`

use std::hint::black_box;
use std::time::Instant;

use occlude::brick::{Scratch, Voxels};
use occlude::grid::{Affine, AnyView, DType, Region, Shape, Voxel};
use occlude::kernel::Context;
use occlude::kernel::gaussian::{gaussian, reach};
use occlude::kernel::gradient::{GradientOut, gradient};
use occlude::kernel::levels::{Levels, levels};
use occlude::kernel::moments4::{BoundOut, Codes, moments4};
use occlude::kernel::occlusion_map::{Moments, base, coarsen};
use occlude::kernel::rank::rank;
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::stage::{Bound, GradientWeight, Method, Ties, WindowChannel, WindowParams, WindowShape};

/// Voxels of the output box: rows as a brick of the planner has them.
const BOX: Shape = [64, 64, 256];

fn main() {
    let filter = std::env::args().skip(1).find(|a| !a.starts_with("--")).unwrap_or_default();
    println!("{:<44} {:>10} {:>10} {:>9}", "kernel", "ns/voxel", "Mvoxel/s", "memcpys");
    for dtype in [DType::U8, DType::U16, DType::F32] {
        let copy = memcpy_ns(dtype);
        let row = |name: String, job: &dyn Fn() -> Job<'static>| {
            let name = format!("{name} {dtype}");
            if name.contains(&filter) {
                report(&name, copy, &mut job());
            }
        };
        for (window, radius) in
            [(WindowShape::Box, 5), (WindowShape::Box, 10), (WindowShape::Box, 64), (WindowShape::Ball, 5)]
        {
            row(format!("rank {window:?} radius {radius}"), &|| rank_job(dtype, window, radius));
        }
        for (count, radius) in [(32, 5), (32, 10), (32, 64), (64, 10)] {
            row(format!("levels {count} radius {radius}"), &|| levels_job(dtype, count, radius));
        }
        for radius in [5, 10, 64] {
            row(format!("moments4 radius {radius}"), &|| moments4_job(dtype, radius));
        }
        for radius in [10, 64] {
            row(format!("window cdf_power radius {radius}"), &|| power_job(dtype, radius));
        }
        for (sigma, moment) in [1, 3, 10].into_iter().flat_map(|s| [(s, "mean"), (s, "variance")]) {
            let variance = moment == "variance";
            row(format!("gaussian sigma {sigma} {moment}"), &|| gaussian_job(dtype, sigma as f64, variance));
            if dtype == DType::F32 {
                for gaps in GAPS {
                    row(format!("gaussian sigma {sigma} {moment}, {gaps:?} gaps"), &|| {
                        gaussian_job(dtype, sigma as f64, variance).with(gaps)
                    });
                }
            }
        }
        row("occlusion map, base and chain".into(), &|| chain_job(dtype));
        for gaps in GAPS.iter().filter(|_| dtype == DType::F32) {
            row(format!("occlusion map, {gaps:?} gaps"), &|| chain_job(dtype).with(*gaps));
        }
        for size in [3, 5] {
            row(format!("gradient {size}^3 magnitude"), &|| gradient_job(dtype, size));
            for gaps in GAPS.iter().filter(|_| dtype == DType::F32) {
                row(format!("gradient {size}^3 magnitude, {gaps:?} gaps"), &|| gradient_job(dtype, size).with(*gaps));
            }
        }
    }
}

/// Seconds of CPU time that this thread has used: neighbours on the machine count less.
fn thread_seconds() -> f64 {
    occlude::store::os::thread_time().expect("a thread clock").as_secs_f64()
}

/// Least seconds of several runs.
fn best(mut f: impl FnMut()) -> f64 {
    let start = Instant::now();
    let mut least = f64::INFINITY;
    let mut runs = 0;
    while runs < 5 || start.elapsed().as_secs_f64() < 0.4 {
        let one = thread_seconds();
        f();
        least = least.min(thread_seconds() - one);
        runs += 1;
    }
    least
}

/// Nanoseconds per voxel of copying a 256^3 volume between warm buffers.
fn memcpy_ns(dtype: DType) -> f64 {
    let bytes = 256 * 256 * 256 * dtype.size();
    let (from, mut to) = (vec![1u8; bytes], vec![2u8; bytes]);
    let seconds = best(|| {
        to.copy_from_slice(black_box(&from));
        black_box(&mut to);
    });
    seconds * 1e9 / (256.0 * 256.0 * 256.0)
}

fn report(name: &str, copy: f64, job: &mut Job) {
    let level = Level::detect();
    job.run(Level::Baseline);
    let portable = job.out.clone();
    job.run(level);
    assert!(job.out.as_bytes() == portable.as_bytes(), "{name}: {level:?} differs from the portable code");
    let ns = best(|| job.run(level)) * 1e9 / BOX.iter().product::<usize>() as f64;
    println!("{name:<44} {ns:>10.3} {:>10.1} {:>9.1}", 1e3 / ns, ns / copy);
}

/// A smooth field with noise, grown by `reach` on every side.
fn field(dtype: DType, reach: [usize; 3]) -> (Voxels, Shape) {
    fn fill<T: Voxel>(v: &mut [T], shape: Shape, top: f64) {
        let mut state = 12345u64;
        for (i, v) in v.iter_mut().enumerate() {
            let (z, y, x) = (i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]);
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let noise = (state >> 33) as f64 / (1u64 << 31) as f64;
            let wave = (z as f64 * 0.11).sin() + (y as f64 * 0.07).sin() + (x as f64 * 0.05).cos();
            *v = T::from_f64((wave / 6.0 + 0.5).mul_add(0.9, noise * 0.08) * top);
        }
    }
    let shape: Shape = std::array::from_fn(|a| BOX[a] + 2 * reach[a]);
    let mut v = Voxels::zeroed(dtype, shape.iter().product());
    let top = if dtype == DType::U16 { 65535.0 } else { 255.0 };
    occlude::with_voxels!(&mut v, v => fill(v, shape, top));
    (v, shape)
}

/// Source, place of the output box in it, output, level and scratch.
type Kernel<'a> = dyn FnMut(AnyView, [usize; 3], &mut Voxels, &mut Context) + 'a;

/// Which voxels of a source are missing.
#[derive(Clone, Copy, Debug)]
enum Gaps {
    /// All outside of the ellipsoid that fills the box: a brain mask, a field of view.
    Ball,
    /// One of a hundred, at random.
    Few,
    /// Three of ten, at random.
    Many,
}

const GAPS: [Gaps; 3] = [Gaps::Ball, Gaps::Few, Gaps::Many];

impl Gaps {
    fn holds(self, [z, y, x]: [usize; 3], shape: Shape, random: u64) -> bool {
        let along = |i: usize, n: usize| (2.0 * i as f64 + 1.0) / n as f64 - 1.0;
        match self {
            Gaps::Ball => {
                let [z, y, x] = [along(z, shape[0]), along(y, shape[1]), along(x, shape[2])];
                z * z + y * y + x * x > 1.0
            }
            Gaps::Few => random % 1000 < 10,
            Gaps::Many => random % 1000 < 300,
        }
    }
}

/// One timed kernel: its source, its buffers, and the call.
struct Job<'a> {
    src: (Voxels, Shape),
    reach: [usize; 3],
    out: Voxels,
    scratch: Scratch,
    kernel: Box<Kernel<'a>>,
}

impl<'a> Job<'a> {
    fn new(
        dtype: DType,
        reach: [usize; 3],
        kernel: impl FnMut(AnyView, [usize; 3], &mut Voxels, &mut Context) + 'a,
    ) -> Job<'a> {
        let out = Voxels::zeroed(dtype.result(), BOX.iter().product());
        Job { src: field(dtype, reach), reach, out, scratch: Scratch::new(), kernel: Box::new(kernel) }
    }

    /// The same with missing voxels, where the source is f32.
    fn with(mut self, gaps: Gaps) -> Job<'a> {
        let (Voxels::F32(voxels), shape) = (&mut self.src.0, self.src.1) else { return self };
        let mut state = 99u64;
        for (i, v) in voxels.iter_mut().enumerate() {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let at = [i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]];
            if gaps.holds(at, shape, state >> 33) {
                *v = f32::NAN;
            }
        }
        self
    }

    fn run(&mut self, level: Level) {
        let mut cx = Context { level, scratch: &mut self.scratch };
        (self.kernel)(self.src.0.view(self.src.1), self.reach, &mut self.out, &mut cx);
    }
}

fn gradient_job<'a>(dtype: DType, size: usize) -> Job<'a> {
    Job::new(dtype, [size / 2; 3], move |src, at, out, cx| {
        let out = GradientOut { magnitude: Some(out.view_mut(BOX)), vector: None };
        gradient(src, size, GradientWeight::Distance, [1.0; 3], Affine::IDENTITY, None, at, out, cx);
    })
}

fn rank_job<'a>(dtype: DType, window: WindowShape, radius: usize) -> Job<'a> {
    let params = WindowParams { radius: [radius; 3], affine: Affine::IDENTITY, missing: None, solid_low: false };
    Job::new(dtype, [radius; 3], move |src, at, out, cx| {
        rank(src, &params, window, Ties::Le, at, out.view_mut(BOX), cx);
    })
}

/// Levels of the field, from every 97th voxel.
fn levels_job<'a>(dtype: DType, count: usize, radius: usize) -> Job<'a> {
    let params = WindowParams { radius: [radius; 3], affine: Affine::IDENTITY, missing: None, solid_low: false };
    let mut chosen = None;
    Job::new(dtype, [radius; 3], move |src, at, out, cx| {
        let chosen = chosen.get_or_insert_with(|| choose(&src, count));
        levels(src, chosen, &params, Ties::Le, at, out.view_mut(BOX), cx);
    })
}

fn choose(src: &AnyView, count: usize) -> Levels {
    let n: usize = src.shape().iter().product();
    let place =
        |i: usize| [i / src.shape()[2] / src.shape()[1], i / src.shape()[2] % src.shape()[1], i % src.shape()[2]];
    let mut values: Vec<f64> = (0..n).step_by(97).map(|i| src.at_f64(place(i))).collect();
    values.sort_by(f64::total_cmp);
    let groups = values.chunk_by(|a, b| a == b).map(|g| (g[0], g.len() as u64));
    Levels::choose(&groups.collect::<Vec<_>>(), count)
}

/// The middle of the bounds.
fn moments4_job<'a>(dtype: DType, radius: usize) -> Job<'a> {
    let params = WindowParams { radius: [radius; 3], affine: Affine::IDENTITY, missing: None, solid_low: false };
    let mut codes = None;
    Job::new(dtype, [radius; 3], move |src, at, out, cx| {
        let codes = codes.get_or_insert_with(|| Codes::new(&choose(&src, 64)));
        let mut outs = [BoundOut { channel: Bound::Openness, dst: out.view_mut(BOX) }];
        moments4(src, Some(codes), &params, Ties::Le, at, &mut outs, cx);
    })
}

fn power_job<'a>(dtype: DType, radius: usize) -> Job<'a> {
    let params = WindowParams { radius: [radius; 3], affine: Affine::IDENTITY, missing: None, solid_low: false };
    Job::new(dtype, [radius; 3], move |src, at, out, cx| {
        let channel = WindowChannel::Openness(Method::CdfPower, Ties::Le);
        window(src, &params, Place::whole(at), &mut [WindowOut { channel, dst: out.view_mut(BOX) }], cx);
    })
}

fn gaussian_job<'a>(dtype: DType, sigma: f64, variance: bool) -> Job<'a> {
    let sigma = [sigma; 3];
    Job::new(dtype, reach(sigma), move |src, at, out, cx| {
        let out = Some(out.view_mut(BOX));
        let (mean, variance) = if variance { (None, out) } else { (out, None) };
        gaussian(src, sigma, Affine::IDENTITY, None, at, mean, variance, cx);
    })
}

/// Every level of the map of the box, from its data; the last level's moments stand at the front of the result.
fn chain_job<'a>(dtype: DType) -> Job<'a> {
    let (mut fine, mut coarse) = (Moments::default(), Moments::default());
    Job::new(dtype, [0; 3], move |src, _, out, cx| {
        base(src, Affine::IDENTITY, None, &mut fine);
        let mut shape = src.shape();
        while shape.iter().any(|n| *n > 8) {
            let (whole, half) = (Region::whole(shape), shape.map(|n| n.div_ceil(2)));
            coarsen(&fine, whole, shape, [true; 3], Region::whole(half), &mut coarse, cx);
            std::mem::swap(&mut fine, &mut coarse);
            shape = half;
        }
        let bytes = out.as_bytes_mut();
        for (to, from) in bytes.chunks_exact_mut(16).zip(fine.mean.iter().zip(&fine.variance)) {
            to[..8].copy_from_slice(&from.0.to_le_bytes());
            to[8..].copy_from_slice(&from.1.to_le_bytes());
        }
    })
}
