//! Speed of kernels, as multiples of a memcpy of the same volume in the same process.
//!
//! `cargo bench --bench kernels [-- FILTER..]`: rows whose name holds every filter word. Each kernel is first checked
//! against its reference on a small volume; a wrong one is not timed.

use occlude::brick::{Scratch, Voxels};
use occlude::grid::{Affine, AnyView, DType, Shape};
use occlude::kernel::Context;
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, reference, window};
use occlude::stage::{Method, Ties, WindowChannel, WindowParams};

const SHAPE: Shape = [415, 256, 256];
/// Planes so large that most windows of radius 64 are whole, and several tiles lie beside each other.
const WIDE: Shape = [96, 640, 640];

/// A body with a skin in air: smooth, with noise, about like a CT head.
fn phantom(dtype: DType, shape: Shape) -> Voxels {
    let (lo, hi) = if dtype.is_float() { (0.0, 1.0) } else { dtype.range() };
    let mut state = 1u64;
    let mut v = Voxels::zeroed(dtype, shape.iter().product());
    let mut i = 0;
    let at = |a: usize, c: usize| (c as f64 + 0.5) / shape[a] as f64 - 0.5;
    let waves: [Vec<f64>; 2] = [
        (0..shape[0]).map(|z| (40.0 * at(0, z)).sin()).collect(),
        (0..shape[2]).map(|x| (30.0 * at(2, x)).cos()).collect(),
    ];
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let c = [i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]];
        i += 1;
        let d: [f64; 3] = std::array::from_fn(|a| at(a, c[a]));
        let r = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        let tissue = if r > 0.45 {
            0.05
        } else if r > 0.4 {
            0.8
        } else {
            0.4 + 0.1 * waves[0][c[0]] * waves[1][c[2]]
        };
        let noise = (state >> 40) as f64 / (1u64 << 24) as f64 - 0.5;
        lo + (tissue + 0.05 * noise) * (hi - lo)
    };
    fn fill<T: occlude::grid::Voxel>(v: &mut [T], next: &mut impl FnMut() -> f64) {
        v.iter_mut().for_each(|v| *v = T::from_f64(next()));
    }
    occlude::with_voxels!(&mut v, d => fill(d, &mut next));
    v
}

fn params(radius: usize) -> WindowParams {
    WindowParams { radius: [radius; 3], affine: Affine::IDENTITY, missing: None, solid_low: false }
}

fn out_type(input: DType, channel: WindowChannel) -> DType {
    if matches!(channel, WindowChannel::Min | WindowChannel::Max) { input } else { input.result() }
}

fn call(
    src: AnyView,
    dst: &mut [Voxels],
    shape: Shape,
    channels: &[WindowChannel],
    p: &WindowParams,
    cx: &mut Context,
) {
    let mut outs: Vec<WindowOut> =
        dst.iter_mut().zip(channels).map(|(d, c)| WindowOut { channel: *c, dst: d.view_mut(shape) }).collect();
    window(src, p, Place::whole([0; 3]), &mut outs, cx);
}

/// `coded`: openness as bytes, as callers of the library may ask for; a run keeps floats until it writes them.
fn outputs(dtype: DType, shape: Shape, channels: &[WindowChannel], coded: bool) -> Vec<Voxels> {
    let kind = |c: WindowChannel| match c {
        WindowChannel::Openness(..) if coded => DType::U8,
        other => out_type(dtype, other),
    };
    channels.iter().map(|c| Voxels::zeroed(kind(*c), shape.iter().product())).collect()
}

/// Compares a small volume with the reference; `Err` says what is wrong.
fn check(dtype: DType, channels: &[WindowChannel], coded: bool, p: &WindowParams, level: Level) -> Result<(), String> {
    let shape = [9, 14, 75];
    let volume = phantom(dtype, shape);
    let mut dst = outputs(dtype, shape, channels, coded);
    let mut scratch = Scratch::new();
    call(volume.view(shape), &mut dst, shape, channels, p, &mut Context { level, scratch: &mut scratch });
    for (k, channel) in channels.iter().enumerate() {
        for i in (0..volume.len()).step_by(37) {
            let c = [i / (shape[1] * shape[2]), i / shape[2] % shape[1], i % shape[2]];
            let exact = occlude::with_view!(AnyView, volume.view(shape), v => reference::voxel(v, c, p, *channel));
            let open = matches!(channel, WindowChannel::Openness(..));
            let (scale, half) = if open && coded { (255.0, 0.5 / 255.0 + 2e-4) } else { (1.0, 1e-5) };
            let got = dst[k].at(i) / scale;
            let allowed = if open { half } else { 1e-5 * exact.abs() };
            if (got - exact).abs() > allowed {
                return Err(format!("{channel:?} of {dtype} at {c:?}: {got} instead of {exact}"));
            }
        }
    }
    Ok(())
}

/// Processor time of this thread in seconds: neighbours on a shared machine disturb it less than the wall clock.
fn clock() -> f64 {
    occlude::store::os::thread_time().expect("a thread clock").as_secs_f64()
}

/// Best of several runs, in seconds.
fn best(mut run: impl FnMut()) -> f64 {
    let (mut least, begun) = (f64::INFINITY, clock());
    for round in 0.. {
        let start = clock();
        run();
        least = least.min(clock() - start);
        if round >= 2 && clock() - begun > 0.7 {
            break;
        }
    }
    least
}

fn memcpy(dtype: DType) -> f64 {
    let n = SHAPE.iter().product::<usize>() * dtype.size();
    let (src, mut dst) = (vec![1u8; n], vec![2u8; n]);
    best(|| {
        dst.copy_from_slice(std::hint::black_box(&src));
        std::hint::black_box(&mut dst);
    })
}

fn main() {
    let filters: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let open = |m| vec![WindowChannel::Openness(m, Ties::Le)];
    let four = vec![WindowChannel::Mean, WindowChannel::Min, WindowChannel::Max, WindowChannel::Variance];
    // Openness goes to bytes, and to floats as in a run.
    let kernels = [
        ("cdf_power", open(Method::CdfPower), true),
        ("gaussian_cdf", open(Method::GaussianCdf), true),
        ("chebyshev", open(Method::Chebyshev), true),
        ("cdf_power>f32", open(Method::CdfPower), false),
        ("gaussian>f32", open(Method::GaussianCdf), false),
        ("chebyshev>f32", open(Method::Chebyshev), false),
        ("four_moments", four, false),
        ("mean", vec![WindowChannel::Mean], false),
        ("min_max", vec![WindowChannel::Min, WindowChannel::Max], false),
        ("variance", vec![WindowChannel::Variance], false),
    ];
    println!(
        "{:<14} {:<4} {:<12} {:<9} {:>9} {:>10} {:>9}",
        "kernel", "type", "data", "level", "ns/voxel", "Mvoxel/s", "x memcpy"
    );
    let voxels = SHAPE.iter().product::<usize>() as f64;
    for dtype in DType::ALL {
        let mut ready: Option<(Voxels, f64)> = None;
        for (name, channels, coded) in &kernels {
            let coded = *coded;
            if coded && dtype.result() != DType::F32 {
                continue;
            }
            for radius in [3, 10, 64] {
                for level in Level::available().into_iter().rev() {
                    for data in ["phantom", "missing", "wide"] {
                        let tag = format!("{data}_r{radius}");
                        let line = format!("{name} {dtype} {tag} {level:?}");
                        let usual =
                            level != Level::Baseline && data == "phantom" && !matches!(dtype, DType::I8 | DType::I16);
                        if filters.is_empty() && !usual || !filters.iter().all(|f| line.contains(f.as_str())) {
                            continue;
                        }
                        let (volume, copy) = ready.get_or_insert_with(|| (phantom(dtype, SHAPE), memcpy(dtype)));
                        let mut p = params(radius);
                        if data == "missing" && !dtype.is_float() {
                            p.missing = Some(dtype.range().0 as i64 + 7);
                        }
                        if let Err(e) = check(dtype, channels, coded, &params(3), level)
                            .and(check(dtype, channels, coded, &p, level))
                        {
                            println!("{name:<14} {dtype:<4} {tag:<12} WRONG: {e}");
                            std::process::exit(1);
                        }
                        let mut masked = None;
                        if data == "missing" && dtype.is_float() {
                            let mut v = volume.clone();
                            for i in (0..v.len()).step_by(1009) {
                                match &mut v {
                                    Voxels::F32(v) => v[i] = f32::NAN,
                                    Voxels::F64(v) => v[i] = f64::NAN,
                                    _ => unreachable!(),
                                }
                            }
                            masked = Some(v);
                        }
                        let shape = if data == "wide" { WIDE } else { SHAPE };
                        let wide = (data == "wide").then(|| phantom(dtype, WIDE));
                        let src = masked.as_ref().or(wide.as_ref()).unwrap_or(volume).view(shape);
                        let mut dst = outputs(dtype, shape, channels, coded);
                        let mut scratch = Scratch::new();
                        let t = best(|| {
                            call(src, &mut dst, shape, channels, &p, &mut Context { level, scratch: &mut scratch });
                        });
                        // Per voxel, also of another volume.
                        let t = t * voxels / shape.iter().product::<usize>() as f64;
                        let (ns, rate) = (t / voxels * 1e9, voxels / t / 1e6);
                        let level = format!("{level:?}");
                        println!(
                            "{name:<14} {:<4} {tag:<12} {level:<9} {ns:>9.3} {rate:>10.0} {:>9.1}",
                            dtype.name(),
                            t / *copy
                        );
                    }
                }
            }
        }
    }
}
