//! The GPU lane beside the CPU kernels (one thread) on the same brick, and a stream of bricks beside the sum of its parts.
//!
//! `cargo bench --bench gpu [-- [--passes] [--gpu-only] WORD ...]` (`--passes`: every dispatch's time, too; `--gpu-only`: neither
//! times nor results of the CPU; only rows that hold a word, such as `gradient` or `f32`; without words
//! benches/gpu_rivals.py runs at the end): uses a hardware adapter, else a software one, and says which. Figures of a software adapter (lavapipe) say nothing about a GPU's speed. Results are
//! compared with the CPU's before a time is printed; after a wrong one it ends with status 1.
//!
//! Columns, in ms: by the wall clock `pack` (host writes voxels into the mapped staging buffer), `device` (from submission
//! until results are mapped), `finish` (host turns sums into results), `whole` (the call); by the device's own time stamps
//! `up`, `compute`, `back` (copy there, dispatches, copy back), `-` where the adapter has none. Then the CPU kernel.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Barrier, Mutex};
use std::time::Instant;

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::extend::Beyond;
use occlude::gpu::facts::{MOST_SLOTS, tolerance};
use occlude::gpu::flow::{Flow, FlowStep, Input, Kernel as Step, Sink};
use occlude::gpu::levels::Pyramid;
use occlude::gpu::slopes::Fit;
use occlude::gpu::taps::Wanted;
use occlude::gpu::{Gpu, GpuError, GpuKind, SinkOut, Times};
use occlude::grid::{Affine, AnyView, AnyViewMut, Border, DType, Region, Shape, ViewMut};
use occlude::kernel::convert::{Mapping, convert};
use occlude::kernel::gradient::{GradientOut, gradient};
use occlude::kernel::obscurance::{ObscuranceIo, ObscuranceParams, Prepared};
use occlude::kernel::reduce::{Cells, Level0};
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::kernel::{Context, gaussian};
use occlude::stage::{
    DirectionSet, DirectionWeights, GradientWeight, Method, Reduce, Rho, Ties, WindowChannel, WindowParams,
};

const ROUNDS: usize = 3;

/// What is timed.
enum Kernel {
    Window(Vec<WindowChannel>, usize),
    /// Sigma; with the variance.
    Gaussian(f64, bool),
    /// Magnitude of a window of 3 or 5 voxels.
    Gradient(usize),
    /// Magnitude of 5^3 voxels of a Gaussian mean, which stays on the device.
    Smoothed(f64),
    /// A channel of windows in codes of u8 with three levels, made there: neither sums nor floats come back.
    Levels(WindowChannel, usize),
    /// Directions, distance.
    Obscurance(Prepared),
}

struct Case {
    name: String,
    kernel: Kernel,
}

fn noise(dtype: DType, shape: Shape) -> Voxels {
    let mut state = 1u64;
    let mut next = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 56) as u8
    };
    let mut v = Voxels::zeroed(dtype, shape.iter().product());
    if dtype == DType::F32 {
        // Any bytes would be NaN and subnormals, too.
        (0..v.len()).for_each(|i| {
            let value = next() as f32 + next() as f32 / 256.0;
            v.as_bytes_mut()[4 * i..][..4].copy_from_slice(&value.to_ne_bytes());
        });
        return v;
    }
    v.as_bytes_mut().iter_mut().for_each(|b| *b = next());
    v
}

fn cases() -> Vec<Case> {
    let mut list = Vec::new();
    let windows = [
        ("mean", vec![WindowChannel::Mean]),
        ("min_max", vec![WindowChannel::Min, WindowChannel::Max]),
        ("variance", vec![WindowChannel::Variance]),
        ("cdf_power", vec![WindowChannel::Openness(Method::CdfPower, Ties::Le)]),
    ];
    for (name, channels) in windows {
        for radius in [10, 40] {
            let kernel = Kernel::Window(channels.clone(), radius);
            list.push(Case { name: format!("{name} r={radius}"), kernel });
        }
    }
    let open = WindowChannel::Openness(Method::CdfPower, Ties::Le);
    for (name, channel) in [("mean", WindowChannel::Mean), ("cdf_power", open)] {
        list.push(Case { name: format!("{name} r=10, levels"), kernel: Kernel::Levels(channel, 10) });
    }
    for sigma in [2.0, 6.0] {
        list.push(Case { name: format!("gaussian s={sigma}"), kernel: Kernel::Gaussian(sigma, false) });
        list.push(Case { name: format!("gaussian+variance s={sigma}"), kernel: Kernel::Gaussian(sigma, true) });
        list.push(Case { name: format!("gradient of s={sigma}"), kernel: Kernel::Smoothed(sigma) });
    }
    for size in [3, 5] {
        list.push(Case { name: format!("gradient {size}"), kernel: Kernel::Gradient(size) });
    }
    for (directions, max_distance) in [(12, 64.0), (42, 64.0), (42, 256.0), (162, 64.0)] {
        let params = ObscuranceParams {
            directions,
            set: DirectionSet::Icosahedron,
            weights: DirectionWeights::Uniform,
            rho: Rho::Sqrt,
            max_distance,
            spacing: [1.0; 3],
            flipped: false,
            missing: None,
            ambient: [1.0; 3],
            ranks: None,
        };
        let name = format!("obscurance {directions} d={max_distance}");
        list.push(Case { name, kernel: Kernel::Obscurance(Prepared::new(&params)) });
    }
    list
}

impl Case {
    fn takes(&self, dtype: DType) -> bool {
        dtype != DType::F32 || !matches!(self.kernel, Kernel::Gaussian(..) | Kernel::Smoothed(_))
    }

    /// How far a result may be from the CPU's, in ranges of the values (up to 2^16) or of itself; 0: not at all.
    fn tolerance(&self, dtype: DType) -> f64 {
        match self.kernel {
            Kernel::Window(..) if dtype == DType::F32 => tolerance::VARIANCE,
            Kernel::Gaussian(_, true) => tolerance::VARIANCE,
            Kernel::Gradient(_) | Kernel::Smoothed(_) => 2.0 * tolerance::GRADIENT,
            Kernel::Window(ref c, _) if c.iter().any(is_open) => tolerance::OPENNESS / 65536.0,
            // A code may round to its neighbour.
            Kernel::Levels(c, _) if is_open(&c) || dtype == DType::F32 => 1.0 / 65536.0,
            _ => 0.0,
        }
    }

    /// Extent of the outputs: windows of gradients stay inside the volume.
    fn extent(&self, shape: Shape) -> Shape {
        match self.kernel {
            Kernel::Gradient(size) => shape.map(|n| n - size + 1),
            Kernel::Smoothed(_) => shape.map(|n| n - 4),
            _ => shape,
        }
    }

    fn outputs(&self, dtype: DType, shape: Shape) -> Vec<Voxels> {
        let of = |c: &WindowChannel| match c {
            WindowChannel::Min | WindowChannel::Max => dtype,
            _ => dtype.result(),
        };
        let types = match &self.kernel {
            Kernel::Window(channels, _) => channels.iter().map(of).collect(),
            Kernel::Gaussian(_, true) => vec![DType::F32; 2],
            Kernel::Levels(..) => {
                let pyramid = pyramid();
                let extents = (0..=LEVELS).map(|k| pyramid.extent(k, shape).iter().product());
                return extents.map(|n| Voxels::zeroed(DType::U8, n)).collect();
            }
            _ => vec![DType::F32],
        };
        types.into_iter().map(|t| Voxels::zeroed(t, self.extent(shape).iter().product())).collect()
    }

    /// A line of every dispatch in microseconds, with the share of the copy rate at which passes of windows and Gaussians move
    /// what they have to read and write.
    fn passes(&self, passes: &[(&'static str, f64)], dtype: DType, shape: Shape, rate: f64) -> String {
        let voxels = shape.iter().product::<usize>() as f64;
        let square = matches!(&self.kernel, Kernel::Window(c, _) if c.contains(&WindowChannel::Variance));
        let mut seen = std::collections::HashMap::new();
        let line = passes.iter().map(|(name, seconds)| {
            let cell = match *name {
                "window_sums_z" | "window_sums_y" | "window_sums32" => 4,
                "window_extremes_z" | "window_extremes_y" | "window_extremes" => 4,
                "gaussian" | "gaussian_rows" => 4,
                "window_sums64" | "window_order" => 8,
                "window_moments" if square => 20,
                "window_moments" | "gaussian_variance" => 12,
                _ => 0,
            };
            let number = seen.entry(*name).or_insert(0);
            let first = match *name {
                "window_sums_z" | "window_extremes_z" | "gaussian_rows" => true,
                "window_sums64" | "window_order" | "window_moments" | "gaussian_variance" => *number % 3 == 0,
                _ => false,
            };
            let from = if first { dtype.size() } else { cell };
            *number += 1;
            let share = match cell {
                0 => String::new(),
                _ => format!(" ({:.0} %)", 100.0 * (from + cell) as f64 * voxels / seconds / rate),
            };
            format!("{name} {:.0}{share}", seconds * 1e6)
        });
        format!("    us: {}", line.collect::<Vec<_>>().join(", "))
    }

    /// Seconds of a call, and its phases where it ran on the device; `None` for the CPU kernel.
    fn call(
        &self,
        gpu: Option<&Gpu>,
        volume: &Voxels,
        shape: Shape,
        out: &mut [Voxels],
        scratch: &mut Scratch,
    ) -> (f64, Times) {
        let mut cx = Context { level: Level::detect(), scratch };
        let src = volume.view(shape);
        let start = Instant::now();
        let times = match &self.kernel {
            Kernel::Window(channels, radius) => {
                let radius = [*radius; 3];
                let p = WindowParams { radius, affine: Affine::IDENTITY, missing: None, solid_low: false };
                let outs = out.iter_mut().zip(channels);
                let mut outs: Vec<WindowOut> =
                    outs.map(|(v, c)| WindowOut { channel: *c, dst: v.view_mut(shape) }).collect();
                match gpu {
                    Some(gpu) => gpu.window(src, &p, [0; 3], [0; 3], &mut outs, &mut cx),
                    None => {
                        window(src, &p, Place::whole([0; 3]), &mut outs, &mut cx);
                        Ok(Times::default())
                    }
                }
            }
            Kernel::Gaussian(sigma, _) => {
                let (sigma, affine) = ([*sigma; 3], Affine::IDENTITY);
                let mut views = out.iter_mut().map(|v| v.view_mut(shape));
                let (mean, variance) = (views.next(), views.next());
                match gpu {
                    Some(gpu) => gpu.gaussian(src, sigma, affine, [0; 3], mean, variance, &mut cx),
                    None => {
                        gaussian::gaussian(src, sigma, affine, None, [0; 3], mean, variance, &mut cx);
                        Ok(Times::default())
                    }
                }
            }
            Kernel::Gradient(size) => gradient_on(gpu, *size, src, out[0].view_mut(self.extent(shape)), &mut cx),
            Kernel::Smoothed(sigma) => {
                let (dst, sigma) = (self.extent(shape), [*sigma; 3]);
                let magnitude = out[0].view_mut(dst);
                match gpu {
                    Some(gpu) => {
                        let reach = sigma.map(|s| (3.0 * s).ceil() as usize);
                        let first = Step::Gaussian { sigma, wanted: Wanted { mean: true, variance: false } };
                        let second = Step::Gradient { fit: fit(5), magnitude: true, vector: false };
                        let steps =
                            [(first, Input::Source, reach), (second, Input::Made { step: 0, channel: 0 }, [2; 3])];
                        let region = Region::new([2; 3], shape.map(|n| n as i64 - 2));
                        flow_on(gpu, &flow(src.dtype(), shape, &steps, region, None), src, SinkOut::Voxels(magnitude))
                    }
                    None => {
                        let mut means = Voxels::zeroed(DType::F32, shape.iter().product());
                        let mean = Some(means.view_mut(shape));
                        gaussian::gaussian(src, sigma, Affine::IDENTITY, None, [0; 3], mean, None, &mut cx);
                        gradient_on(None, 5, means.view(shape), magnitude, &mut cx)
                    }
                }
            }
            Kernel::Levels(channel, radius) => levels_on(gpu, *channel, *radius, src, out, &mut cx),
            Kernel::Obscurance(sweep) => {
                let whole = Region::whole(shape);
                let AnyViewMut::F32(view) = out[0].view_mut(shape) else { unreachable!("openness is f32") };
                sweep_on(gpu, sweep, src, whole, view, &mut cx)
            }
        };
        (start.elapsed().as_secs_f64(), times.expect("the device works"))
    }
}

fn is_open(channel: &WindowChannel) -> bool {
    matches!(channel, WindowChannel::Openness(..))
}

/// Levels beyond the first.
const LEVELS: usize = 3;

fn pyramid() -> Pyramid {
    let mapping = Mapping { range: Some([0.0, 65535.0]), fill: 0.0 };
    Pyramid {
        dtype: DType::U8,
        mapping,
        reduce: Reduce::Mean,
        std: false,
        halved: vec![[true; 3]; LEVELS],
        cells: true,
    }
}

/// Steps, each with what it reads and how far, and what comes back of the last.
fn flow(
    dtype: DType,
    shape: Shape,
    steps: &[(Step, Input, [usize; 3])],
    region: Region,
    pyramid: Option<Pyramid>,
) -> Flow {
    let value = Input::Made { step: steps.len() - 1, channel: 0 };
    let step = |(kernel, input, reach): &(Step, Input, [usize; 3])| FlowStep {
        kernel: kernel.clone(),
        inputs: vec![*input],
        reach: *reach,
        beyond: Beyond { border: Border::Clip, outside: 0 },
        fills: None,
    };
    Flow {
        dtype,
        affine: Affine::IDENTITY,
        volume: Region::whole(shape),
        steps: steps.iter().map(step).collect(),
        sinks: vec![Sink { value, mean: None, region, pyramid }],
    }
}

fn flow_on(gpu: &Gpu, flow: &Flow, src: AnyView, out: SinkOut) -> Result<Times, GpuError> {
    let done = gpu.flow(flow, src, flow.volume, &[], &mut [out]);
    done.map(|t| t.expect("noise lies within f32"))
}

fn levels_on(
    gpu: Option<&Gpu>,
    channel: WindowChannel,
    radius: usize,
    src: AnyView,
    out: &mut [Voxels],
    cx: &mut Context,
) -> Result<Times, GpuError> {
    let (shape, radius) = (src.shape(), [radius; 3]);
    let mut pyramid = pyramid();
    if is_open(&channel) {
        pyramid.mapping.range = Some([0.0, 1.0]);
    }
    let params = WindowParams { radius, affine: Affine::IDENTITY, missing: None, solid_low: false };
    if let Some(gpu) = gpu {
        let steps = [(Step::Windows { params, channels: vec![channel] }, Input::Source, radius)];
        let views = out.iter_mut().enumerate().map(|(k, v)| v.view_mut(pyramid.extent(k, shape)));
        let (views, mut cells) = (views.collect(), Vec::new());
        let flow = flow(src.dtype(), shape, &steps, Region::whole(shape), Some(pyramid));
        return flow_on(gpu, &flow, src, SinkOut::Levels(views, &mut cells));
    }
    let mut made = Voxels::zeroed(DType::F32, shape.iter().product());
    let mut outs = [WindowOut { channel, dst: made.view_mut(shape) }];
    window(src, &params, Place::whole([0; 3]), &mut outs, cx);
    convert(made.view(shape), pyramid.mapping, out[0].view_mut(shape));
    let (mut cells, mut fine) = (Cells::default(), Cells::default());
    for (k, halved) in pyramid.halved.iter().enumerate() {
        if k == 0 {
            let src = Level0 { value: made.view(shape), mean: None, needed: None };
            cells.first(pyramid.reduce, false, src, *halved, cx);
        } else {
            std::mem::swap(&mut cells, &mut fine);
            cells.next_from(&fine, *halved, cx);
        }
        cells.write([0; 3], pyramid.mapping, out[k + 1].view_mut(cells.shape), cx);
    }
    Ok(Times::default())
}

fn fit(size: usize) -> Fit {
    Fit { size, weight: GradientWeight::Distance, spacing: [1.0; 3], missing: None }
}

fn gradient_on(
    gpu: Option<&Gpu>,
    size: usize,
    src: AnyView,
    magnitude: AnyViewMut,
    cx: &mut Context,
) -> Result<Times, GpuError> {
    let out = GradientOut { magnitude: Some(magnitude), vector: None };
    let (Fit { weight, spacing, missing, .. }, at) = (fit(size), [size / 2; 3]);
    match gpu {
        Some(gpu) => gpu.gradient(src, &fit(size), Affine::IDENTITY, at, out, cx),
        None => {
            gradient(src, size, weight, spacing, Affine::IDENTITY, missing, at, out, cx);
            Ok(Times::default())
        }
    }
}

/// Whether every voxel is as near to its twin as it has to be.
fn agree(a: &Voxels, b: &Voxels, tolerance: f64) -> bool {
    if tolerance == 0.0 {
        return a.as_bytes() == b.as_bytes();
    }
    let most = (0..a.len()).map(|i| a.at(i).abs()).fold(1.0, f64::max).max(65536.0);
    (0..a.len()).all(|i| (a.at(i) - b.at(i)).abs() <= tolerance * most)
}

fn sweep_on(
    gpu: Option<&Gpu>,
    sweep: &Prepared,
    src: AnyView,
    whole: Region,
    mut view: ViewMut<f32>,
    cx: &mut Context,
) -> Result<Times, GpuError> {
    match gpu {
        Some(gpu) => gpu.obscurance(sweep, src, whole, whole, &mut view, cx),
        None => {
            let openness = Some(AnyViewMut::F32(view));
            sweep.sweep(
                src,
                whole,
                whole,
                ObscuranceIo { colour: None, normal: None, needed: None, openness, rgb: None },
                cx,
            );
            Ok(Times::default())
        }
    }
}

/// Some calls, each on a device that was kept busy before it: one that idled keeps a low clock at first, and one that waits for
/// the host between calls falls back to it (H200, 2026-11-26: 345 of 1980 MHz, passes five times as slow).
fn awake<T>(gpu: &Gpu, mut call: impl FnMut() -> T) -> Vec<T> {
    gpu.keep_busy(0.3).expect("the device works");
    let one = |_| {
        gpu.keep_busy(0.03).expect("the device works");
        call()
    };
    (0..2 + ROUNDS).map(one).skip(2).collect()
}

/// Bricks per second with as many threads as the ring has slots at most, beside one thread and beside the slowest phase alone.
/// Every thread makes a brick before the clock starts: a stream is long, and what it waits for once are its slots' buffers and
/// their pages.
fn stream(gpu: &Gpu, case: &Case, volume: &Voxels, shape: Shape) {
    const BRICKS: usize = 48;
    let run = |gpu: Option<&Gpu>, threads: usize| {
        let bricks = if gpu.is_some() || threads > 1 { BRICKS } else { BRICKS / 8 };
        let next = AtomicUsize::new(0);
        let sum = Mutex::new(Times::default());
        let ready = Barrier::new(threads + 1);
        let start = std::thread::scope(|scope| {
            for _ in 0..threads {
                scope.spawn(|| {
                    let mut out = case.outputs(volume.dtype(), shape);
                    let mut scratch = Scratch::new();
                    case.call(gpu, volume, shape, &mut out, &mut scratch);
                    ready.wait();
                    while next.fetch_add(1, Ordering::Relaxed) < bricks {
                        let (_, t) = case.call(gpu, volume, shape, &mut out, &mut scratch);
                        let mut sum = sum.lock().expect("no thread panics");
                        (sum.pack, sum.finish) = (sum.pack + t.pack, sum.finish + t.finish);
                        (0..3).for_each(|k| sum.stamps[k] += t.stamps[k]);
                    }
                });
            }
            ready.wait();
            Instant::now()
        });
        (bricks as f64 / start.elapsed().as_secs_f64(), sum.into_inner().expect("no thread panics"))
    };
    let (one, _) = run(Some(gpu), 1);
    let (ring, t) = run(Some(gpu), MOST_SLOTS as usize);
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    let [(cpu, _), (all, _)] = [1, cores].map(|threads| run(None, threads));
    let parts = [t.pack, t.finish, t.stamps.iter().sum()].map(|s| s * 1e3 / BRICKS as f64);
    println!(
        "{:<22} {:<4} {one:>10.1} {ring:>10.1} {:>8.1} {:>8.1} {:>8.1} {cpu:>10.1} {all:>10.1}",
        case.name,
        volume.dtype().name(),
        parts[0],
        parts[1],
        parts[2]
    );
}

fn main() {
    let (mut gpu, size) = match Gpu::open_timed(GpuKind::Hardware) {
        Ok(gpu) => (gpu, 256),
        Err(why) => match Gpu::open_timed(GpuKind::Software) {
            Ok(gpu) => (gpu, 64),
            Err(also) => return println!("not measured: {why}; {also}"),
        },
    };
    gpu.set_slots(MOST_SLOTS);
    println!("adapter: {}; f32 arithmetic is the CPU's: {}", gpu.facts().name, gpu.facts().exact_floats);
    if gpu.facts().software {
        println!("a software adapter: these figures say nothing about a GPU's speed");
    }
    println!("{size}^3 voxels, best of {ROUNDS} calls (CPU: of those within half a second), ms");
    println!(
        "{:<22} {:<4} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}",
        "kernel", "type", "pack", "device", "finish", "whole", "up", "compute", "back", "cpu"
    );
    let rates = awake(&gpu, || gpu.copy_rate().expect("the device works"));
    let rate = rates.into_iter().flatten().fold(0.0, f64::max);
    if rate > 0.0 {
        println!("copy on the device: {:.0} GB/s, read and written", rate * 1e-9);
    }
    let shape = [size; 3];
    let words: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let flag = |name: &str| std::env::args().any(|a| a == name);
    let (passes, gpu_only) = (flag("--passes"), flag("--gpu-only"));
    let wanted = |case: &Case, dtype: DType| {
        let row = format!("{} {dtype}", case.name);
        words.is_empty() || words.iter().any(|w| row.contains(w.as_str()))
    };
    let (mut scratch, mut wrong) = (Scratch::new(), 0);
    for dtype in [DType::U8, DType::U16, DType::F32] {
        let volume = noise(dtype, shape);
        for case in cases().iter().filter(|c| c.takes(dtype) && wanted(c, dtype)) {
            let (mut cpu, mut got) = (case.outputs(dtype, shape), case.outputs(dtype, shape));
            let rounds = awake(&gpu, || case.call(Some(&gpu), &volume, shape, &mut got, &mut scratch));
            // The fastest call, with the passes of the fastest passes: the host and the device do not hold each other up.
            let whole = rounds.iter().map(|r| r.0).fold(f64::INFINITY, f64::min);
            let t = rounds.into_iter().map(|r| r.1).min_by(|a, b| a.stamps[1].total_cmp(&b.stamps[1]));
            let t = t.expect("there is a round");
            let (start, mut host) = (Instant::now(), f64::INFINITY);
            for round in 0..ROUNDS {
                if gpu_only || round > 0 && start.elapsed().as_secs_f64() > 0.5 {
                    break;
                }
                host = host.min(case.call(None, &volume, shape, &mut cpu, &mut scratch).0);
            }
            if !gpu_only && !cpu.iter().zip(&got).all(|(a, b)| agree(a, b, case.tolerance(dtype))) {
                println!("{} {dtype}: WRONG", case.name);
                wrong += 1;
                continue;
            }
            let stamp = |k: usize| match t.stamps.iter().sum::<f64>() {
                0.0 => "-".to_string(),
                _ => format!("{:.1}", t.stamps[k] * 1e3),
            };
            let [pack, device, finish, whole, host] = [t.pack, t.device, t.finish, whole, host].map(|s| s * 1e3);
            println!(
                "{:<22} {:<4} {pack:>8.1} {device:>8.1} {finish:>8.1} {whole:>8.1} {:>8} {:>8} {:>8} {host:>8.1}",
                case.name,
                dtype.name(),
                stamp(0),
                stamp(1),
                stamp(2)
            );
            if passes {
                println!("{}", case.passes(&t.passes, dtype, shape, rate));
            }
        }
    }
    if gpu_only {
        return;
    }
    if wrong > 0 {
        println!("{wrong} results differ from the CPU's");
        std::process::exit(1);
    }
    println!(
        "stream of bricks of {size}^3: bricks/s by one thread and by {MOST_SLOTS}, then ms per brick of host and device alone, then \
         the CPU's bricks/s by one thread and by all"
    );
    println!(
        "{:<22} {:<4} {:>10} {:>10} {:>8} {:>8} {:>8} {:>10} {:>10}",
        "kernel", "type", "1 thread", "ring", "pack", "finish", "device", "cpu", "cpu, all"
    );
    let volume = noise(DType::U8, shape);
    for case in cases().iter().filter(|c| {
        let streamed = ["cdf_power r=10", "cdf_power r=10, levels", "gradient of s=2", "obscurance 42 d=64"];
        streamed.contains(&c.name.as_str()) && wanted(c, DType::U8)
    }) {
        stream(&gpu, case, &volume, shape);
    }
    if words.is_empty() {
        rivals();
    }
}

/// The same by CuPy and torch, where they are; the script says what it lacks.
fn rivals() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/gpu_rivals.py");
    println!("\n{script}:");
    match std::process::Command::new("python3").arg(script).status() {
        Ok(status) if status.success() || status.code() == Some(3) => {}
        Ok(status) => {
            println!("failed: {status}");
            std::process::exit(1);
        }
        Err(e) => println!("not measured: python3 cannot be run: {e}"),
    }
}
