//! Steps that run together on the GPU equal the same steps one by one bit for bit, wherever a box lies and however it is cut.

use std::sync::Arc;

use occlude::brick::{Scratch, Voxels, gather};
use occlude::gpu::Gpu;
use occlude::gpu::extend::Beyond;
use occlude::gpu::flow::{Flow, FlowStep, Input, Kernel, Sink};
use occlude::gpu::levels::Pyramid;
use occlude::gpu::points::Op;
use occlude::gpu::slopes::Fit;
use occlude::gpu::taps::Wanted;
use occlude::grid::{Affine, AnyViewMut, Border, DType, Region, View, ViewMut, Voxel};
use occlude::kernel::convert::Mapping;
use occlude::kernel::gradient::GradientOut;
use occlude::kernel::obscurance::{ObscuranceParams, Prepared};
use occlude::kernel::window::WindowOut;
use occlude::stage::{
    CombineKind, DirectionSet, DirectionWeights, GradientWeight, Method, Reduce, Rho, Ties, WindowChannel, WindowMode,
    WindowParams,
};

use super::levels::{cx, differs, flow_of, made, on_cpu, point, pointwise_on_cpu, results, step};
use super::{adapter, fills};

/// The steps of a flow one by one over the whole volume.
fn one_by_one(gpu: &Gpu, flow: &Flow, source: &Voxels) -> Vec<Vec<Voxels>> {
    let shape = flow.volume.shape();
    let mut all: Vec<Vec<Voxels>> = Vec::new();
    let mut scratch = Scratch::new();
    for step in &flow.steps {
        let read = |i: &Input| match i {
            Input::Source => (source, flow.affine),
            Input::Made { step, channel } => (&all[*step][*channel], Affine::IDENTITY),
        };
        let reads: Vec<(&Voxels, Affine)> = step.inputs.iter().map(read).collect();
        let (src, affine) = reads[0];
        let room = |n: usize| (0..n).map(|_| Voxels::zeroed(DType::F32, flow.volume.voxels())).collect::<Vec<_>>();
        let mut cx = cx(&mut scratch);
        let windows = matches!(step.kernel, Kernel::Gaussian { .. } | Kernel::Windows { .. });
        let bordered = (windows && step.beyond.border != Border::Clip).then(|| {
            let grown = flow.volume.grow(step.reach);
            let mut padded = Voxels::zeroed(src.dtype(), grown.voxels());
            pad(src, flow.volume, &mut padded, grown, step.beyond);
            (padded, grown.shape())
        });
        let (view, at) = match &bordered {
            Some((padded, extent)) => (padded.view(*extent), step.reach),
            None => (src.view(shape), [0; 3]),
        };
        let made = match &step.kernel {
            Kernel::Gaussian { sigma, wanted } => {
                let mut out = room(2);
                let [mean, variance] = &mut out[..] else { unreachable!() };
                let mean = wanted.mean.then(|| mean.view_mut(shape));
                let variance = wanted.variance.then(|| variance.view_mut(shape));
                gpu.gaussian(view, *sigma, affine, at, mean, variance, &mut cx).unwrap();
                let kept = [wanted.mean, wanted.variance];
                out.into_iter().zip(kept).filter(|(_, k)| *k).map(|(v, _)| v).collect()
            }
            Kernel::Gradient { fit, magnitude, vector } => {
                let half = [fit.size / 2; 3];
                let grown = flow.volume.grow(half);
                let mut padded = Voxels::zeroed(src.dtype(), grown.voxels());
                pad(src, flow.volume, &mut padded, grown, Beyond { border: Border::Nearest, outside: 0 });
                let mut out = room(4);
                let [m, z, y, x] = &mut out[..] else { unreachable!() };
                let to = GradientOut {
                    magnitude: magnitude.then(|| m.view_mut(shape)),
                    vector: vector.then(|| [z, y, x].map(|v| v.view_mut(shape))),
                };
                gpu.gradient(padded.view(grown.shape()), fit, affine, half, to, &mut cx).unwrap();
                let kept = [*magnitude, *vector, *vector, *vector];
                out.into_iter().zip(kept).filter(|(_, k)| *k).map(|(v, _)| v).collect()
            }
            Kernel::Windows { params, channels } => {
                let extreme = |c: &WindowChannel| matches!(c, WindowChannel::Min | WindowChannel::Max);
                let own = |c: &WindowChannel| extreme(c) && params.affine.is_identity();
                let of = |c: &WindowChannel| if own(c) { src.dtype() } else { DType::F32 };
                let mut out: Vec<Voxels> =
                    channels.iter().map(|c| Voxels::zeroed(of(c), flow.volume.voxels())).collect();
                let outs = out.iter_mut().zip(channels);
                let mut outs: Vec<WindowOut> =
                    outs.map(|(v, c)| WindowOut { channel: *c, dst: v.view_mut(shape) }).collect();
                gpu.window(view, params, at, [0; 3], &mut outs, &mut cx).unwrap();
                drop(outs);
                out
            }
            Kernel::Sweep(prepared) => {
                let (mut out, whole) = (room(1), flow.volume);
                let AnyViewMut::F32(mut open) = out[0].view_mut(shape) else { unreachable!() };
                gpu.obscurance(prepared, src.view(shape), whole, whole, &mut open, &mut cx).unwrap();
                out
            }
            Kernel::Points(ops) => {
                let one = |(op, of): &(Op, Vec<usize>)| {
                    let views: Vec<_> = of.iter().map(|&i| (reads[i].0.view(shape), reads[i].1)).collect();
                    Voxels::F32(pointwise_on_cpu(op, &views, shape))
                };
                ops.iter().map(one).collect()
            }
        };
        all.push(made);
    }
    all
}

/// Grown by a border rule.
fn pad(src: &Voxels, whole: Region, dst: &mut Voxels, grown: Region, beyond: Beyond) {
    let bits = beyond.outside;
    let outside = if src.dtype() == DType::F32 { f32::from_bits(bits) as f64 } else { bits as f64 };
    macro_rules! arms {
        ($($t:ident),*) => {
            match (src, dst) {
                $((Voxels::$t(s), Voxels::$t(d)) => {
                    let (s, d) = (View::dense(s, whole.shape()), ViewMut::dense(d, grown.shape()));
                    gather::extend(s, whole, d, grown, whole, beyond.border, Voxel::from_f64(outside));
                })*
                _ => unreachable!("of one type"),
            }
        };
    }
    arms!(U8, I8, U16, I16, F32)
}

fn fit(size: usize) -> Fit {
    Fit { size, weight: GradientWeight::Distance, spacing: [1.0, 2.0, 0.5], missing: None }
}

fn windows(radius: [usize; 3], affine: Affine, channels: &[WindowChannel]) -> Kernel {
    let params = WindowParams { radius, affine, missing: None, solid_low: true };
    Kernel::Windows { params, channels: channels.to_vec() }
}

/// Flows of every kind of step after every other; each with whether it takes floats as its source.
fn recipes(affine: Affine) -> Vec<(&'static str, Vec<FlowStep>, bool)> {
    use WindowChannel::{Max, Mean, Min, Std, Variance};
    let source = [Input::Source];
    let open = |m| WindowChannel::Openness(m, Ties::Le);
    let gaussian = |variance: bool| {
        step(Kernel::Gaussian { sigma: [1.0, 0.7, 1.6], wanted: Wanted { mean: true, variance } }, &source)
    };
    let gradient = |of: Input, magnitude: bool, vector: bool, size: usize| {
        step(Kernel::Gradient { fit: fit(size), magnitude, vector }, &[of])
    };
    let id = Affine::IDENTITY;
    let stats = || step(windows([2, 1, 4], affine, &[Mean, Variance, Min, open(Method::CdfPower)]), &source);
    let sweep = |of: Input, solid_low: bool| {
        let params = ObscuranceParams {
            directions: 12,
            set: DirectionSet::Icosahedron,
            weights: DirectionWeights::Uniform,
            rho: Rho::Sqrt,
            max_distance: 3.0,
            spacing: [1.0; 3],
            flipped: solid_low,
            missing: None,
            ranks: None,
            ambient: [1.0; 3],
        };
        step(Kernel::Sweep(Arc::new(Prepared::new(&params))), &[of])
    };
    let bordered = |step: FlowStep, border: Border, outside: u32| {
        let beyond = Beyond { border, outside };
        FlowStep { beyond, ..step }
    };
    let constant = Border::Constant(0.0);
    let wide = || step(windows([9, 2, 20], affine, &[Mean, Min, open(Method::Chebyshev)]), &source);
    let opacity = Op::Transfer { points: vec![[0.0, 0.1, 0.0, 0.0, 0.0], [150.0, 1.0, 1.0, 0.5, 0.2]], component: 1 };
    vec![
        ("a gradient of a Gaussian", vec![gaussian(false), gradient(made(0, 0), true, true, 5)], false),
        (
            "windows of a Gaussian",
            vec![gaussian(true), step(windows([2, 1, 4], id, &[Std, Max]), &[made(0, 0)])],
            false,
        ),
        ("a gradient of means", vec![stats(), gradient(made(0, 0), true, false, 3)], false),
        (
            "every border over one source",
            vec![
                bordered(stats(), Border::Reflect, 0),
                bordered(wide(), constant, 3),
                bordered(gaussian(true), Border::Nearest, 0),
                bordered(wide(), Border::Reflect, 0),
                stats(),
                point(Op::Combine(CombineKind::Add), &[made(3, 0), made(4, 0), made(1, 1)]),
            ],
            false,
        ),
        (
            "borders of what was made",
            vec![
                bordered(gaussian(false), constant, 7),
                bordered(step(windows([1, 4, 2], id, &[Std, Max, Mean]), &[made(0, 0)]), Border::Reflect, 0),
                bordered(step(windows([0, 2, 4], id, &[Mean, Min]), &[made(1, 0)]), constant, 40.5f32.to_bits()),
                bordered(step(windows([1, 1, 1], id, &[Max]), &[made(2, 0)]), Border::Nearest, 0),
            ],
            false,
        ),
        (
            "windows of windows",
            vec![stats(), step(windows([1, 3, 0], id, &[Mean, open(Method::GaussianCdf)]), &[made(0, 0)])],
            false,
        ),
        (
            "windows of a component of a gradient of voxels",
            vec![gradient(Input::Source, true, true, 5), step(windows([1; 3], id, &[Max, Mean]), &[made(0, 3)])],
            true,
        ),
        (
            "a sweep of voxels, its gradient",
            vec![sweep(Input::Source, false), gradient(made(0, 0), true, false, 5)],
            true,
        ),
        ("sweeps of a Gaussian", vec![gaussian(false), sweep(made(0, 0), true)], false),
        (
            "a table of voxels, times the variance, then cut",
            vec![
                stats(),
                point(opacity, &source),
                point(Op::ByVariance { sigma_max2: 900.0 }, &[made(1, 0), made(0, 1)]),
                point(Op::Window { low: 0.2, high: 0.6, mode: WindowMode::Stretch }, &[made(2, 0)]),
            ],
            false,
        ),
        (
            "the magnitude of the gradient of an openness, and light",
            vec![
                stats(),
                gradient(made(0, 3), true, false, 5),
                point(Op::Light { k: 0.7 }, &[made(0, 3), made(1, 0)]),
                point(Op::Combine(CombineKind::Max), &[made(2, 0), made(0, 2), made(1, 0)]),
            ],
            false,
        ),
    ]
}

#[test]
fn flows_equal_their_steps_one_by_one_wherever_the_box_lies() {
    let Some(mut gpu) = adapter() else { return };
    let scaled = Affine { slope: -0.5, intercept: 100.0 };
    for (shape, dtypes) in [([12, 15, 33], &[DType::U8, DType::I16, DType::F32][..]), ([1, 9, 40], &[DType::U16])] {
        for &dtype in dtypes {
            for affine in [Affine::IDENTITY, scaled] {
                for (name, steps, floats) in recipes(affine) {
                    if dtype == DType::F32 && !floats || affine != Affine::IDENTITY && dtype == DType::I16 {
                        continue;
                    }
                    // Noise; where the device leaves windows to the CPU there is nothing to compare.
                    let volume = fills(dtype, shape).swap_remove(0).1;
                    let last = steps.len() - 1;
                    let channels = |s: usize| match &steps[s].kernel {
                        Kernel::Gaussian { wanted, .. } => wanted.mean as usize + wanted.variance as usize,
                        Kernel::Gradient { magnitude, vector, .. } => *magnitude as usize + 3 * *vector as usize,
                        Kernel::Windows { channels, .. } => channels.len(),
                        Kernel::Sweep(_) => 1,
                        Kernel::Points(ops) => ops.len(),
                    };
                    let wanted: Vec<(usize, usize)> =
                        (0..channels(last)).map(|c| (last, c)).chain([(0, channels(0) - 1)]).collect();
                    gpu.set_cap(1 << 30);
                    let bare = flow_of(dtype, affine, shape, steps.clone(), vec![]);
                    let all = one_by_one(&gpu, &bare, &volume);
                    for (lo, hi, cap) in [
                        ([0, 0, 0], [12, 15, 33], 1 << 30),
                        ([0, 0, 0], [12, 15, 33], 40_000),
                        ([0, 4, 8], [8, 9, 20], 1 << 30),
                        ([8, 0, 32], [12, 15, 33], 40_000),
                    ] {
                        let region = Region::new(lo, hi).clip(&Region::whole(shape));
                        if region.is_empty() {
                            continue;
                        }
                        gpu.set_cap(cap);
                        let pyramid = Pyramid {
                            dtype: DType::U8,
                            mapping: Mapping { range: Some([0.0, 200.0]), fill: 3.0 },
                            reduce: Reduce::Mean,
                            std: false,
                            halved: vec![[true; 3]; 2],
                            cells: true,
                        };
                        let sink = |(s, c), pyramid| Sink { value: made(s, c), mean: None, region, pyramid };
                        let mut sinks: Vec<Sink> = wanted.iter().map(|w| sink(*w, None)).collect();
                        sinks.push(sink(wanted[0], Some(pyramid.clone())));
                        let flow = flow_of(dtype, affine, shape, steps.clone(), sinks);
                        let got = results(&gpu, &flow, &volume);
                        let got = got.unwrap_or_else(|| panic!("{name} of {dtype}, cap {cap}: left to the CPU"));
                        for ((s, c), got) in wanted.iter().zip(&got) {
                            let plain = Pyramid {
                                dtype: DType::F32,
                                mapping: Mapping::KEEP,
                                halved: vec![],
                                cells: false,
                                ..pyramid.clone()
                            };
                            let expect = on_cpu(&plain, &all[*s][*c], None, None, shape, region);
                            let text = differs(&expect, got);
                            assert_eq!(
                                text, None,
                                "{name} of {dtype} {affine:?}, step {s}, channel {c}, {region:?}, cap {cap}"
                            );
                        }
                        let (s, c) = wanted[0];
                        let expect = on_cpu(&pyramid, &all[s][c], None, None, shape, region);
                        assert_eq!(
                            differs(&expect, &got[wanted.len()]),
                            None,
                            "levels of {name} of {dtype}, {region:?}"
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn a_flow_is_left_where_a_window_is_or_nothing_fits_and_survives_a_lost_device() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [6, 9, 20];
    let whole = Region::whole(shape);
    let (_, steps, _) = recipes(Affine::IDENTITY).swap_remove(0);
    let sink = |s: usize, c: usize| Sink { value: made(s, c), mean: None, region: whole, pyramid: None };
    let flow = flow_of(DType::U16, Affine::IDENTITY, shape, steps, vec![sink(1, 0)]);
    // One voxel in a void: far from it means are as small as f32 goes.
    let mut voxels = vec![0u16; whole.voxels()];
    voxels[777] = 1;
    let mut narrow = flow.clone();
    let wanted = Wanted { mean: true, variance: false };
    narrow.steps[0] = step(Kernel::Gaussian { sigma: [0.2; 3], wanted }, &[Input::Source]);
    assert!(results(&gpu, &narrow, &Voxels::U16(voxels)).is_none(), "too small for f32");
    let volume = fills(DType::U16, shape).swap_remove(0).1;
    let first = results(&gpu, &flow, &volume).expect("it fits");
    gpu.lose(false);
    assert_eq!(results(&gpu, &flow, &volume), Some(first));
    gpu.set_cap(600);
    assert!(results(&gpu, &flow, &volume).is_none());
}
