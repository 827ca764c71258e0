//! Box statistics and estimators: statistics bit for bit, openness within its tolerance.

use occlude::brick::{Scratch, Voxels};
use occlude::gpu::{Gpu, facts};
use occlude::grid::{Affine, DType, Shape};
use occlude::kernel::Context;
use occlude::kernel::simd::Level;
use occlude::kernel::window::{Place, WindowOut, window};
use occlude::stage::{Method, Ties, WindowChannel, WindowParams};

use super::common::hash;
use super::{adapter, fills};

fn params(radius: [usize; 3]) -> WindowParams {
    WindowParams { radius, affine: Affine::IDENTITY, missing: None, solid_low: false }
}

fn all_channels() -> Vec<WindowChannel> {
    use WindowChannel::*;
    let methods = [Method::CdfPower, Method::GaussianCdf, Method::Chebyshev, Method::ChebyshevLiteral];
    let open = methods.iter().flat_map(|m| [Openness(*m, Ties::Le), Openness(*m, Ties::Mid)]);
    [Mean, Min, Max, Variance, Std, Moment2].into_iter().chain(open).collect()
}

fn out_dtype(input: DType, p: &WindowParams, channel: WindowChannel) -> DType {
    let extreme = matches!(channel, WindowChannel::Min | WindowChannel::Max);
    if extreme && p.affine.is_identity() { input } else { input.result() }
}

/// Output box within a volume.
type Box3 = ([usize; 3], Shape);

/// Every channel of a box by one lane; `None` for the CPU.
fn results(
    gpu: Option<&Gpu>,
    volume: &Voxels,
    shape: Shape,
    p: &WindowParams,
    (at, dst): Box3,
    channels: &[WindowChannel],
) -> Vec<Voxels> {
    let dirty = |c: &WindowChannel| {
        let mut v = Voxels::zeroed(out_dtype(volume.dtype(), p, *c), dst.iter().product());
        v.fill(if gpu.is_some() { 77.0 } else { 33.0 });
        v
    };
    let mut made: Vec<Voxels> = channels.iter().map(dirty).collect();
    let mut outs: Vec<WindowOut> =
        made.iter_mut().zip(channels).map(|(v, c)| WindowOut { channel: *c, dst: v.view_mut(dst) }).collect();
    let mut scratch = Scratch::new();
    let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
    match gpu {
        Some(gpu) => drop(
            gpu.window(volume.view(shape), p, at, at.map(|v| v as i64), &mut outs, &mut cx)
                .unwrap_or_else(|e| panic!("{e}")),
        ),
        None => window(volume.view(shape), p, Place::whole(at), &mut outs, &mut cx),
    }
    made
}

/// The first channel and voxel where two lanes differ: statistics in a bit, openness by more than its tolerance.
fn differs(cpu: &[Voxels], gpu: &[Voxels], channels: &[WindowChannel]) -> Option<String> {
    let mut pairs = cpu.iter().zip(gpu).zip(channels);
    pairs.find_map(|((a, b), c)| {
        let apart = |i: usize| match c {
            WindowChannel::Openness(..) => (a.at(i) - b.at(i)).abs().partial_cmp(&facts::tolerance::OPENNESS) != LESS,
            _ => a.at(i).to_bits() != b.at(i).to_bits(),
        };
        let i = (0..a.len()).find(|&i| apart(i))?;
        Some(format!("{c:?}: voxel {i}: {:?} on the CPU, {:?} on the GPU", a.at(i), b.at(i)))
    })
}

const LESS: Option<std::cmp::Ordering> = Some(std::cmp::Ordering::Less);

fn check(gpu: &Gpu, name: &str, volume: &Voxels, shape: Shape, p: &WindowParams, part: Box3) {
    let channels = all_channels();
    let cpu = results(None, volume, shape, p, part, &channels);
    let got = results(Some(gpu), volume, shape, p, part, &channels);
    if let Some(text) = differs(&cpu, &got, &channels) {
        panic!("{name} of {} {shape:?}, {part:?}, {p:?}: {text}", volume.dtype());
    }
}

const MEAN: WindowChannel = WindowChannel::Mean;
const DTYPES: [DType; 4] = [DType::U8, DType::I8, DType::U16, DType::I16];

#[test]
fn every_channel_equals_the_cpu() {
    let Some(gpu) = adapter() else { return };
    let shape = [13, 17, 37];
    for dtype in DTYPES {
        for (name, volume) in fills(dtype, shape) {
            for radius in [[0; 3], [1, 1, 1], [2, 3, 5], [0, 4, 0], [10, 10, 10]] {
                check(&gpu, name, &volume, shape, &params(radius), ([0; 3], shape));
            }
        }
    }
}

#[test]
fn odd_shapes_and_radii_beyond_the_volume() {
    let Some(gpu) = adapter() else { return };
    for shape in [[1, 1, 1], [1, 1, 70], [7, 1, 9], [1, 33, 1], [5, 6, 71], [3, 300, 2], [64, 3, 5]] {
        for dtype in DTYPES {
            let (name, volume) = fills(dtype, shape).swap_remove(0);
            for radius in [[1, 0, 2], [3, 3, 3], [100, 100, 100], [0, 1 << 40, 1]] {
                check(&gpu, name, &volume, shape, &params(radius), ([0; 3], shape));
            }
        }
    }
}

/// Longer than what a workgroup holds of a row, by windows up to and beyond what it can hold.
#[test]
fn long_rows_and_wide_windows() {
    let Some(gpu) = adapter() else { return };
    let shape = [2, 3, 1100];
    for dtype in DTYPES {
        let (name, volume) = fills(dtype, shape).into_iter().find(|(n, _)| *n == "noise").unwrap();
        for radius in [5, 127, 128, 300, 2000] {
            check(&gpu, name, &volume, shape, &params([1, 0, radius]), ([0; 3], shape));
        }
        check(&gpu, name, &volume, shape, &params([0, 2, 90]), ([1, 1, 77], [1, 2, 600]));
    }
}

/// Quotients halfway between two f32, and means next to a power of two, where the nearest f32 change their distance.
#[test]
fn means_are_rounded_half_to_even() {
    let Some(gpu) = adapter() else { return };
    let shape = [16, 16, 40];
    let check_means = |volume: &Voxels, radius: [usize; 3]| {
        let [cpu, got] =
            [None, Some(&gpu)].map(|g| results(g, volume, shape, &params(radius), ([0; 3], shape), &[MEAN]));
        assert_eq!(differs(&cpu, &got, &[MEAN]), None, "radius {radius:?}");
    };
    // Windows of 512 and of 2048 voxels have sums of more bits than f32 has.
    let high = Voxels::U16((0..16 * 16 * 40).map(|i| 65535 - (hash(11, i) % 5000) as u16).collect());
    [[7; 3], [15, 15, 3], [15, 15, 7]].into_iter().for_each(|r| check_means(&high, r));
    for power in [1u16, 2, 64, 4096, 32768] {
        for below in [true, false] {
            let near = |i| match hash(12, i) % 700 {
                0 if below => power - 1,
                0 => power + 1,
                _ => power,
            };
            let volume = Voxels::U16((0..16 * 16 * 40).map(near).collect());
            [[4, 5, 6], [7; 3], [10; 3], [1, 2, 1]].into_iter().for_each(|r| check_means(&volume, r));
        }
    }
}

#[test]
fn boxes_inside_scaled_and_turned_around() {
    let Some(gpu) = adapter() else { return };
    let shape = [20, 24, 40];
    for dtype in DTYPES {
        let (name, volume) = fills(dtype, shape).swap_remove(0);
        for (at, dst) in [([4, 5, 6], [9, 11, 13]), ([0, 23, 0], [20, 1, 40]), ([19, 0, 39], [1, 1, 1])] {
            for (slope, intercept, solid_low) in [(1.0, 0.0, true), (-2.5, 7.0, false), (0.5, -1024.0, true)] {
                let affine = Affine { slope, intercept };
                let p = WindowParams { affine, solid_low, ..params([4, 5, 6]) };
                check(&gpu, name, &volume, shape, &p, (at, dst));
            }
        }
    }
}

#[test]
fn sums_beyond_32_bits() {
    let Some(gpu) = adapter() else { return };
    // 45 * 45 * 45 voxels: S1 of u16 and S2 of u8 exceed 2^32.
    let shape = [45, 45, 45];
    for dtype in DTYPES {
        for (name, volume) in
            fills(dtype, shape).into_iter().filter(|(n, _)| ["greatest", "one off", "noise"].contains(n))
        {
            check(&gpu, name, &volume, shape, &params([60; 3]), ([20, 0, 0], [6, 45, 45]));
            check(&gpu, name, &volume, shape, &params([21; 3]), ([20, 10, 0], [6, 6, 45]));
        }
    }
}

#[test]
fn a_brick_beyond_the_limits_is_cut_and_a_window_beyond_them_goes_to_the_cpu() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [30, 25, 41];
    for dtype in [DType::U8, DType::I16] {
        let (name, volume) = fills(dtype, shape).swap_remove(0);
        for cap in [120_000, 30_000, 6_000, 300] {
            gpu.set_cap(cap);
            check(&gpu, name, &volume, shape, &params([3, 4, 5]), ([0; 3], shape));
        }
    }
}

#[test]
fn threads_share_the_lane_and_each_channel_stands_alone() {
    let Some(gpu) = adapter() else { return };
    let shape = [16, 18, 40];
    let volumes: Vec<Voxels> = DTYPES.iter().map(|d| fills(*d, shape).swap_remove(0).1).collect();
    std::thread::scope(|scope| {
        for t in 0..6usize {
            let (gpu, volumes) = (&gpu, &volumes);
            scope.spawn(move || {
                for (k, channel) in all_channels().into_iter().enumerate() {
                    let (volume, p) = (&volumes[(t + k) % 4], params([t, 3, 2]));
                    let part = ([t, 0, 0], [10, 18, 40]);
                    let cpu = results(None, volume, shape, &p, part, &[channel]);
                    let got = results(Some(gpu), volume, shape, &p, part, &[channel]);
                    assert_eq!(differs(&cpu, &got, &[channel]), None, "thread {t}");
                }
            });
        }
    });
}

#[test]
fn a_lost_device_is_opened_anew() {
    let Some(gpu) = adapter() else { return };
    let shape = [12, 12, 33];
    let (name, volume) = fills(DType::U16, shape).swap_remove(0);
    for _ in 0..3 {
        check(&gpu, name, &volume, shape, &params([2; 3]), ([0; 3], shape));
        gpu.lose(false);
        check(&gpu, name, &volume, shape, &params([3; 3]), ([0; 3], shape));
    }
}

/// Bricks of one group are of no use to the next one's, whose budget does not count them.
#[test]
fn buffers_are_let_go_and_made_anew() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [12, 12, 33];
    let (name, volume) = fills(DType::U16, shape).swap_remove(0);
    for slots in [3, 1, 5] {
        gpu.set_slots(slots);
        check(&gpu, name, &volume, shape, &params([2; 3]), ([0; 3], shape));
        assert!(gpu.idle_bytes() > 2 * volume.as_bytes().len() as u64, "{slots} slots hold what a brick needs");
        gpu.let_go();
        assert_eq!(gpu.idle_bytes(), 0);
    }
    check(&gpu, name, &volume, shape, &params([3; 3]), ([0; 3], shape));
}

#[test]
fn the_comparison_can_fail() {
    let shape = [4, 5, 6];
    let volume = fills(DType::U8, shape).swap_remove(0).1;
    let channels = all_channels();
    let cpu = results(None, &volume, shape, &params([1; 3]), ([0; 3], shape), &channels);
    assert_eq!(differs(&cpu, &cpu.clone(), &channels), None);
    for k in 0..channels.len() {
        let mut other = cpu.clone();
        match (&mut other[k], channels[k]) {
            (Voxels::F32(v), WindowChannel::Openness(..)) => v[77] += 2e-5, // more than the tolerance
            (v, _) => *v.as_bytes_mut().last_mut().expect("there are voxels") ^= 1,
        }
        let text = differs(&cpu, &other, &channels).expect("that is a difference");
        assert!(text.contains(&format!("{:?}", channels[k])), "{text}");
    }
    let wider = results(None, &volume, shape, &params([2; 3]), ([0; 3], shape), &channels);
    assert!(differs(&cpu, &wider, &channels).is_some());
}

#[test]
fn inputs_without_a_kernel_are_named() {
    let mean = [WindowChannel::Mean];
    for dtype in DTYPES {
        assert!(facts::window(dtype, false, &all_channels()).is_ok());
        assert!(facts::window(dtype, true, &mean).unwrap_err().contains("missing"));
        let exact = WindowChannel::Openness(Method::Exact, Ties::Le);
        assert!(facts::window(dtype, false, &[exact]).unwrap_err().contains("exact"));
    }
    for dtype in [DType::U32, DType::I32, DType::F64] {
        assert!(facts::window(dtype, false, &mean).unwrap_err().contains("runs on the CPU"));
    }
    assert!(facts::window(DType::F32, false, &mean).is_ok());
    let Some(gpu) = adapter() else { return };
    let volume = Voxels::zeroed(DType::F64, 8);
    let mut made = Voxels::zeroed(DType::F64, 8);
    let mut outs = [WindowOut { channel: WindowChannel::Mean, dst: made.view_mut([2, 2, 2]) }];
    let mut cx = Context { level: Level::detect(), scratch: &mut Scratch::new() };
    let error = gpu.window(volume.view([2, 2, 2]), &params([1; 3]), [0; 3], [0; 3], &mut outs, &mut cx).unwrap_err();
    assert!(error.to_string().contains("f64"));
}
