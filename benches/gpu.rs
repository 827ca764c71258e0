//! The GPU lane beside the CPU kernel (one thread) on the same brick: host packing, device (copy there, passes, copy
//! back), finishing on the CPU, and the whole call.
//!
//! `cargo bench --bench gpu`: uses a hardware adapter, else a software one, and says which. Figures of a software
//! adapter (lavapipe) say nothing about a GPU's speed. Results are compared with the CPU's first; wrong ones are not timed.

use std::time::Instant;

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::{Gpu, GpuKind, Times};
use occlude::grid::{Affine, DType, Shape};
use occlude::kernel::Context;
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::stage::{Method, Ties, WindowChannel, WindowParams};

const ROUNDS: usize = 3;

fn noise(dtype: DType, shape: Shape) -> Voxels {
    let mut state = 1u64;
    let mut v = Voxels::zeroed(dtype, shape.iter().product());
    for byte in v.as_bytes_mut() {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        *byte = (state >> 56) as u8;
    }
    v
}

fn outputs(dtype: DType, shape: Shape, channels: &[WindowChannel]) -> Vec<Voxels> {
    let of = |c: &WindowChannel| match c {
        WindowChannel::Min | WindowChannel::Max => dtype,
        _ => dtype.result(),
    };
    channels.iter().map(|c| Voxels::zeroed(of(c), shape.iter().product())).collect()
}

/// Seconds of a call, and its phases where it ran on the device.
fn call(
    gpu: Option<&Gpu>,
    volume: &Voxels,
    shape: Shape,
    radius: usize,
    channels: &[WindowChannel],
    out: &mut [Voxels],
    scratch: &mut Scratch,
) -> (f64, Times) {
    let p = WindowParams { radius: [radius; 3], affine: Affine::IDENTITY, missing: None, solid_low: false };
    let mut outs: Vec<WindowOut> =
        out.iter_mut().zip(channels).map(|(v, c)| WindowOut { channel: *c, dst: v.view_mut(shape) }).collect();
    let mut cx = Context { level: Level::detect(), scratch };
    let start = Instant::now();
    let times = match gpu {
        Some(gpu) => gpu.window(volume.view(shape), &p, [0; 3], &mut outs, &mut cx).expect("the device works"),
        None => {
            window(volume.view(shape), &p, Place::whole([0; 3]), &mut outs, &mut cx);
            Times::default()
        }
    };
    (start.elapsed().as_secs_f64(), times)
}

fn main() {
    let (gpu, size) = match Gpu::open(GpuKind::Hardware) {
        Ok(gpu) => (gpu, 256),
        Err(why) => match Gpu::open(GpuKind::Software) {
            Ok(gpu) => (gpu, 96),
            Err(also) => return println!("not measured: {why}; {also}"),
        },
    };
    println!("adapter: {}", gpu.facts().name);
    if gpu.facts().software {
        println!("a software adapter: these figures say nothing about a GPU's speed");
    }
    let kinds = [
        ("mean", vec![WindowChannel::Mean]),
        ("min_max", vec![WindowChannel::Min, WindowChannel::Max]),
        ("variance", vec![WindowChannel::Variance]),
        ("cdf_power", vec![WindowChannel::Openness(Method::CdfPower, Ties::Le)]),
    ];
    println!("{size}^3 voxels, best of {ROUNDS}, ms");
    println!(
        "{:<10} {:<4} {:>3} {:>8} {:>8} {:>8} {:>8} {:>8}",
        "kernel", "type", "r", "pack", "device", "finish", "whole", "cpu"
    );
    let shape = [size; 3];
    let mut scratch = Scratch::new();
    for dtype in [DType::U8, DType::U16] {
        let volume = noise(dtype, shape);
        for (name, channels) in &kinds {
            for radius in [10, 40] {
                let mut cpu = outputs(dtype, shape, channels);
                let mut got = outputs(dtype, shape, channels);
                let mut best = (f64::INFINITY, Times::default());
                let mut host = f64::INFINITY;
                for _ in 0..ROUNDS {
                    let one = call(Some(&gpu), &volume, shape, radius, channels, &mut got, &mut scratch);
                    best = if one.0 < best.0 { one } else { best };
                    host = host.min(call(None, &volume, shape, radius, channels, &mut cpu, &mut scratch).0);
                }
                if cpu.iter().zip(&got).any(|(a, b)| a.as_bytes() != b.as_bytes()) {
                    println!("{name} {dtype} r={radius}: WRONG");
                    std::process::exit(1);
                }
                let (whole, t) = best;
                let [pack, device, finish, whole, host] = [t.pack, t.device, t.finish, whole, host].map(|s| s * 1e3);
                println!(
                    "{name:<10} {:<4} {radius:>3} {pack:>8.1} {device:>8.1} {finish:>8.1} {whole:>8.1} {host:>8.1}",
                    dtype.name()
                );
            }
        }
    }
}
