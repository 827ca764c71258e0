//! The GPU lane beside the CPU kernels (one thread) on the same brick, and a stream of bricks beside the sum of its parts.
//!
//! `cargo bench --bench gpu`: uses a hardware adapter, else a software one, and says which. Figures of a software adapter
//! (lavapipe) say nothing about a GPU's speed. Results are compared with the CPU's first; wrong ones are not timed.
//!
//! Columns, in ms: by the wall clock `pack` (host writes voxels into the mapped staging buffer), `device` (from submission
//! until results are mapped), `finish` (host turns sums into results), `whole` (the call); by the device's own time stamps
//! `up`, `compute`, `back` (copy there, dispatches, copy back), `-` where the adapter has none. Then the CPU kernel.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::facts::SLOTS;
use occlude::gpu::{Gpu, GpuKind, Times};
use occlude::grid::{Affine, AnyViewMut, DType, Region, Shape, ViewMut};
use occlude::kernel::obscurance::{ObscuranceIo, ObscuranceParams, Prepared};
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::kernel::{Context, gaussian};
use occlude::stage::{DirectionSet, DirectionWeights, Method, Rho, Ties, WindowChannel, WindowParams};

const ROUNDS: usize = 3;

/// What is timed.
enum Kernel {
    Window(Vec<WindowChannel>, usize),
    Gaussian(f64),
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
    for sigma in [2.0, 6.0] {
        list.push(Case { name: format!("gaussian s={sigma}"), kernel: Kernel::Gaussian(sigma) });
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
        };
        let name = format!("obscurance {directions} d={max_distance}");
        list.push(Case { name, kernel: Kernel::Obscurance(Prepared::new(&params)) });
    }
    list
}

impl Case {
    fn takes(&self, dtype: DType) -> bool {
        dtype != DType::F32 || matches!(self.kernel, Kernel::Obscurance(_))
    }

    fn outputs(&self, dtype: DType, shape: Shape) -> Vec<Voxels> {
        let of = |c: &WindowChannel| match c {
            WindowChannel::Min | WindowChannel::Max => dtype,
            _ => dtype.result(),
        };
        let types = match &self.kernel {
            Kernel::Window(channels, _) => channels.iter().map(of).collect(),
            _ => vec![DType::F32],
        };
        types.into_iter().map(|t| Voxels::zeroed(t, shape.iter().product())).collect()
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
                    Some(gpu) => gpu.window(src, &p, [0; 3], &mut outs, &mut cx),
                    None => {
                        window(src, &p, Place::whole([0; 3]), &mut outs, &mut cx);
                        Ok(Times::default())
                    }
                }
            }
            Kernel::Gaussian(sigma) => {
                let (sigma, affine) = ([*sigma; 3], Affine::IDENTITY);
                let mut mean = out[0].view_mut(shape);
                match gpu {
                    Some(gpu) => gpu.gaussian(src, sigma, affine, [0; 3], &mut mean, &mut cx),
                    None => {
                        gaussian::gaussian(src, sigma, affine, None, [0; 3], Some(mean), None, &mut cx);
                        Ok(Times::default())
                    }
                }
            }
            Kernel::Obscurance(sweep) => {
                let whole = Region::whole(shape);
                let AnyViewMut::F32(view) = out[0].view_mut(shape) else { unreachable!("openness is f32") };
                sweep_on(gpu, sweep, src, whole, view, &mut cx)
            }
        };
        (start.elapsed().as_secs_f64(), times.expect("the device works"))
    }
}

fn sweep_on(
    gpu: Option<&Gpu>,
    sweep: &Prepared,
    src: occlude::grid::AnyView,
    whole: Region,
    mut view: ViewMut<f32>,
    cx: &mut Context,
) -> Result<Times, occlude::gpu::GpuError> {
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

/// Bricks per second with as many threads as the ring has slots, beside one thread and beside the slowest phase alone.
fn stream(gpu: &Gpu, case: &Case, volume: &Voxels, shape: Shape) {
    const BRICKS: usize = 12;
    let run = |threads: usize| {
        let next = AtomicUsize::new(0);
        let sum = Mutex::new(Times::default());
        let start = Instant::now();
        std::thread::scope(|scope| {
            for _ in 0..threads {
                scope.spawn(|| {
                    let mut out = case.outputs(volume.dtype(), shape);
                    let mut scratch = Scratch::new();
                    while next.fetch_add(1, Ordering::Relaxed) < BRICKS {
                        let (_, t) = case.call(Some(gpu), volume, shape, &mut out, &mut scratch);
                        let mut sum = sum.lock().expect("no thread panics");
                        (sum.pack, sum.finish) = (sum.pack + t.pack, sum.finish + t.finish);
                        (0..3).for_each(|k| sum.stamps[k] += t.stamps[k]);
                    }
                });
            }
        });
        (BRICKS as f64 / start.elapsed().as_secs_f64(), sum.into_inner().expect("no thread panics"))
    };
    let (one, _) = run(1);
    let (ring, t) = run(SLOTS as usize);
    let parts = [t.pack, t.finish, t.stamps.iter().sum()].map(|s| s * 1e3 / BRICKS as f64);
    println!(
        "{:<22} {:<4} {one:>10.1} {ring:>10.1} {:>8.1} {:>8.1} {:>8.1}",
        case.name,
        volume.dtype().name(),
        parts[0],
        parts[1],
        parts[2]
    );
}

fn main() {
    let (gpu, size) = match Gpu::open_timed(GpuKind::Hardware) {
        Ok(gpu) => (gpu, 256),
        Err(why) => match Gpu::open_timed(GpuKind::Software) {
            Ok(gpu) => (gpu, 64),
            Err(also) => return println!("not measured: {why}; {also}"),
        },
    };
    println!("adapter: {}; f32 arithmetic is the CPU's: {}", gpu.facts().name, gpu.facts().exact_floats);
    if gpu.facts().software {
        println!("a software adapter: these figures say nothing about a GPU's speed");
    }
    println!("{size}^3 voxels, best of {ROUNDS}, ms");
    println!(
        "{:<22} {:<4} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}",
        "kernel", "type", "pack", "device", "finish", "whole", "up", "compute", "back", "cpu"
    );
    let shape = [size; 3];
    let mut scratch = Scratch::new();
    for dtype in [DType::U8, DType::U16, DType::F32] {
        let volume = noise(dtype, shape);
        for case in cases().iter().filter(|c| c.takes(dtype)) {
            let (mut cpu, mut got) = (case.outputs(dtype, shape), case.outputs(dtype, shape));
            let mut best = (f64::INFINITY, Times::default());
            let mut host = f64::INFINITY;
            for _ in 0..ROUNDS {
                let one = case.call(Some(&gpu), &volume, shape, &mut got, &mut scratch);
                best = if one.0 < best.0 { one } else { best };
                host = host.min(case.call(None, &volume, shape, &mut cpu, &mut scratch).0);
            }
            if cpu.iter().zip(&got).any(|(a, b)| a.as_bytes() != b.as_bytes()) {
                println!("{} {dtype}: WRONG", case.name);
                std::process::exit(1);
            }
            let (whole, t) = best;
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
        }
    }
    println!(
        "stream of bricks of {size}^3: bricks/s by one thread and by {SLOTS}, then ms per brick of host and device alone"
    );
    println!(
        "{:<22} {:<4} {:>10} {:>10} {:>8} {:>8} {:>8}",
        "kernel", "type", "1 thread", "ring", "pack", "finish", "device"
    );
    let volume = noise(DType::U8, shape);
    for case in cases().iter().filter(|c| ["cdf_power r=10", "obscurance 42 d=64"].contains(&c.name.as_str())) {
        stream(&gpu, case, &volume, shape);
    }
}
