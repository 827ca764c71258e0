//! Levels, conversions and steps that look at one voxel, made on the GPU, equal the CPU's bit for bit.

use occlude::brick::{Scratch, Voxels, gather};
use occlude::gpu::extend::Beyond;
use occlude::gpu::flow::{Flow, FlowStep, Input, Kernel, Sink};
use occlude::gpu::levels::Pyramid;
use occlude::gpu::points::Op;
use occlude::gpu::{Gpu, Needed, SinkOut};
use occlude::grid::{Affine, AnyView, AnyViewMut, Border, DType, Region, Shape, View, ViewMut};
use occlude::kernel::convert::{Mapping, convert};
use occlude::kernel::reduce::{Cells, Level0};
use occlude::kernel::simd::Level;
use occlude::kernel::{Context, pointwise};
use occlude::stage::{CombineKind, Reduce, WindowMode};

use super::common::hash;
use super::{adapter, fills};

/// f32 that break careless arithmetic: every size, NaN, infinities, zeros of both signs, subnormals, ties.
pub fn hostile(shape: Shape, seed: u64) -> Voxels {
    let special =
        [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.0, 1e-42, f32::MAX, f32::MIN_POSITIVE, 0.5, -f32::MAX, 1.0];
    let value = |i: usize| {
        let h = hash(seed, i as u64);
        match (i / 40) % 4 {
            0 => (h >> 40) as f32 / (1 << 24) as f32,                  // noise of [0, 1)
            1 => f32::from_bits(h as u32 & 0x9fff_ffff | 0x2000_0000), // any size
            2 if h.is_multiple_of(3) => special[(h >> 8) as usize % special.len()],
            _ => ((h >> 20) % 512) as f32 / 255.0 - 0.5, // near halves of codes
        }
    };
    Voxels::F32((0..shape.iter().product()).map(value).collect())
}

pub fn cx(scratch: &mut Scratch) -> Context<'_> {
    Context { level: Level::detect(), scratch }
}

/// A flow of steps over one source, its sinks over a box.
pub fn flow_of(dtype: DType, affine: Affine, shape: Shape, steps: Vec<FlowStep>, sinks: Vec<Sink>) -> Flow {
    Flow { dtype, affine, volume: Region::whole(shape), steps, sinks }
}

/// Windows end where the volume does.
pub const CLIP: Beyond = Beyond { border: Border::Clip, outside: 0 };

pub fn step(kernel: Kernel, inputs: &[Input]) -> FlowStep {
    let reach = match &kernel {
        Kernel::Gaussian { sigma, .. } => sigma.map(|s| (3.0 * s).ceil() as usize),
        Kernel::Gradient { fit, .. } => [fit.size / 2; 3],
        Kernel::Windows { params, .. } => params.radius,
        Kernel::Sweep(prepared) => prepared.reach(),
        Kernel::Points(_) => [0; 3],
    };
    FlowStep { kernel, inputs: inputs.to_vec(), reach, beyond: CLIP, fills: None }
}

pub fn made(step: usize, channel: usize) -> Input {
    Input::Made { step, channel }
}

pub fn point(op: Op, inputs: &[Input]) -> FlowStep {
    step(Kernel::Points(vec![(op, (0..inputs.len()).collect())]), inputs)
}

/// What comes back of every sink, as bytes: voxels, or levels and then numbers of cells.
pub fn results(gpu: &Gpu, flow: &Flow, source: &Voxels) -> Option<Vec<Vec<Vec<u8>>>> {
    results_of(gpu, flow, source, &[])
}

/// The same with masks.
pub fn results_of(gpu: &Gpu, flow: &Flow, source: &Voxels, needed: &[Needed]) -> Option<Vec<Vec<Vec<u8>>>> {
    let extent = |s: &Sink, k: usize| s.pyramid.as_ref().map_or(s.region.shape(), |p| p.extent(k, s.region.shape()));
    let room = |s: &Sink| match &s.pyramid {
        None => vec![Voxels::zeroed(DType::F32, s.region.voxels())],
        Some(p) => {
            let of = |k: usize| Voxels::zeroed(p.dtype, extent(s, k).iter().product());
            (0..=p.halved.len()).map(of).collect()
        }
    };
    let mut rooms: Vec<Vec<Voxels>> = flow.sinks.iter().map(room).collect();
    let mut cells: Vec<Vec<f64>> = flow.sinks.iter().map(|_| vec![]).collect();
    let outs = flow.sinks.iter().zip(&mut rooms).zip(&mut cells).map(|((s, room), cells)| match &s.pyramid {
        None => SinkOut::Voxels(room[0].view_mut(s.region.shape())),
        Some(_) => {
            let views = room.iter_mut().enumerate().map(|(k, v)| v.view_mut(extent(s, k)));
            SinkOut::Levels(views.collect(), cells)
        }
    });
    let mut outs: Vec<SinkOut> = outs.collect();
    let done = gpu.flow(flow, source.view(flow.volume.shape()), flow.volume, needed, &mut outs);
    done.unwrap_or_else(|e| panic!("{e}"))?;
    drop(outs);
    let bytes = |(room, cells): (Vec<Voxels>, Vec<f64>)| {
        let mut all: Vec<Vec<u8>> = room.iter().map(|v| v.as_bytes().to_vec()).collect();
        all.push(cells.iter().flat_map(|v| v.to_bits().to_ne_bytes()).collect());
        all
    };
    Some(rooms.into_iter().zip(cells).map(bytes).collect())
}

/// The levels of a channel over a box by the CPU.
pub fn on_cpu(
    pyramid: &Pyramid,
    value: &Voxels,
    mean: Option<&Voxels>,
    needed: Option<&[u8]>,
    shape: Shape,
    region: Region,
) -> Vec<Vec<u8>> {
    assert!(needed.is_none() || region == Region::whole(shape), "masks are of the whole");
    let part = |v: &Voxels| {
        let mut out = Voxels::zeroed(v.dtype(), region.voxels());
        gather::copy_common(v.view(shape), Region::whole(shape), out.view_mut(region.shape()), region);
        out
    };
    let (value, mean) = (part(value), mean.map(part));
    let mut codes = Voxels::zeroed(pyramid.dtype, region.voxels());
    convert(value.view(region.shape()), pyramid.mapping, codes.view_mut(region.shape()));
    let mut all = vec![codes.as_bytes().to_vec()];
    let (mut cells, mut fine) = (Cells::default(), Cells::default());
    let mut scratch = Scratch::new();
    for (k, halved) in pyramid.halved.iter().enumerate() {
        if k == 0 {
            let mean = mean.as_ref().map(|m| m.view(region.shape()));
            let src = Level0 { value: value.view(region.shape()), mean, needed: needed.map(|m| View::dense(m, shape)) };
            cells.first(pyramid.reduce, pyramid.std, src, *halved, &mut cx(&mut scratch));
        } else {
            std::mem::swap(&mut cells, &mut fine);
            cells.next_from(&fine, *halved, &mut cx(&mut scratch));
        }
        let mut codes = Voxels::zeroed(pyramid.dtype, cells.shape.iter().product());
        cells.write([0; 3], pyramid.mapping, codes.view_mut(cells.shape), &mut cx(&mut scratch));
        all.push(codes.as_bytes().to_vec());
    }
    let mut numbers = Vec::new();
    if pyramid.cells {
        cells.store(&mut numbers);
    }
    all.push(numbers.iter().flat_map(|v| v.to_bits().to_ne_bytes()).collect());
    all
}

/// The first level and byte in which two lanes differ.
pub fn differs(cpu: &[Vec<u8>], gpu: &[Vec<u8>]) -> Option<String> {
    let k = (0..cpu.len().max(gpu.len())).find(|&k| cpu.get(k) != gpu.get(k))?;
    let (a, b) = (cpu.get(k)?, gpu.get(k)?);
    let i = (0..a.len().max(b.len())).find(|&i| a.get(i) != b.get(i))?;
    let word = |v: &[u8]| v[i / 8 * 8..].iter().take(8).copied().collect::<Vec<u8>>();
    Some(format!("level {k}, byte {i}: {:?} on the CPU, {:?} on the GPU", word(a), word(b)))
}

const HALVED: [[bool; 3]; 3] = [[true; 3], [false, true, true], [true, true, false]];

pub fn pyramids(range: Option<[f64; 2]>) -> Vec<Pyramid> {
    let kinds = [
        (Reduce::Mean, false),
        (Reduce::Min, false),
        (Reduce::Max, false),
        (Reduce::Stride, false),
        (Reduce::Moments, false),
        (Reduce::Moments, true),
    ];
    let of = |(k, (reduce, std)): (usize, (Reduce, bool))| {
        let dtype =
            [DType::U8, DType::F32, DType::U16, DType::I16, DType::F32, DType::I8][(k + range.is_some() as usize) % 6];
        let mapping = Mapping { range: range.filter(|_| !dtype.is_float()), fill: 7.0 };
        Pyramid { dtype, mapping, reduce, std, halved: HALVED.to_vec(), cells: true }
    };
    kinds.into_iter().enumerate().map(of).collect()
}

#[test]
fn levels_and_codes_of_hostile_floats_equal_the_cpus() {
    let Some(mut gpu) = adapter() else { return };
    for (shape, seed) in [([9, 10, 37], 1), ([8, 16, 24], 2), ([1, 1, 70], 3), ([5, 1, 3], 4), ([1, 1, 1], 5)] {
        let source = hostile(shape, seed);
        for range in [Some([0.0, 1.0]), Some([-3.25, 1000.5]), None] {
            for pyramid in pyramids(range) {
                let whole = Region::whole(shape);
                // The variance is the value of a voxel, its mean the double of it.
                let steps = vec![point(Op::Scale, &[Input::Source]), point(Op::Times { by: 2.0 }, &[Input::Source])];
                let mean = (pyramid.reduce == Reduce::Moments).then_some(made(1, 0));
                let sink = Sink { value: made(0, 0), mean, region: whole, pyramid: Some(pyramid.clone()) };
                let flow = flow_of(DType::F32, Affine::IDENTITY, shape, steps, vec![sink]);
                let doubled = match &source {
                    Voxels::F32(v) => Voxels::F32(v.iter().map(|v| (*v as f64 * 2.0 + 0.0) as f32).collect()),
                    _ => unreachable!("hostile voxels are floats"),
                };
                let cpu = on_cpu(&pyramid, &source, mean.map(|_| &doubled), None, shape, whole);
                for cap in [1 << 30, 20_000] {
                    gpu.set_cap(cap);
                    let got = results(&gpu, &flow, &source).expect("it fits").swap_remove(0);
                    assert_eq!(differs(&cpu, &got), None, "{pyramid:?} of {shape:?}, cap {cap}");
                }
            }
        }
    }
}

#[test]
fn the_comparison_can_fail() {
    let shape = [4, 6, 8];
    let source = hostile(shape, 9);
    for pyramid in pyramids(Some([0.0, 1.0])) {
        let mean = Some(&source).filter(|_| pyramid.reduce == Reduce::Moments);
        let cpu = on_cpu(&pyramid, &source, mean, None, shape, Region::whole(shape));
        assert_eq!(differs(&cpu, &cpu.clone()), None);
        for k in 0..cpu.len() {
            let mut other = cpu.clone();
            *other[k].last_mut().expect("every level has voxels") ^= 1;
            assert!(differs(&cpu, &other).unwrap().contains(&format!("level {k}")));
        }
        assert!(pyramid.halved.len() == 3 && cpu[4].len() >= 8 * cpu[3].len() / pyramid.dtype.size());
    }
}

/// Every operation on one, two or three channels by the CPU, in f32.
pub fn pointwise_on_cpu(op: &Op, reads: &[(AnyView, Affine)], shape: Shape) -> Vec<f32> {
    let read = |i: usize| (reads[i].0, reads[i].1, None);
    let mut out = vec![7.0f32; shape.iter().product()];
    let view = AnyViewMut::F32(ViewMut::dense(&mut out, shape));
    match op {
        Op::Scale => pointwise::scale(reads[0].0, reads[0].1, None, view),
        Op::Times { by } => {
            pointwise::scale(reads[0].0, Affine { slope: *by, intercept: 0.0 }, None, view);
        }
        Op::Window { low, high, mode } => pointwise::openness_window(read(0), *low, *high, *mode, view),
        Op::ByVariance { sigma_max2 } => pointwise::modulate_by_variance(read(0), read(1), *sigma_max2, view),
        Op::BySaliency { threshold, gain } => {
            pointwise::modulate_by_saliency(read(0), read(1), *threshold, *gain, view);
        }
        Op::Light { k } => pointwise::ambient_light(read(0), read(1), *k, view),
        Op::Combine(kind) => {
            let inputs: Vec<_> = reads.iter().map(|(v, a)| (*v, *a, None)).collect();
            pointwise::combine(&inputs, *kind, view);
        }
        Op::Transfer { points, component } => {
            let mut rest = [0, 1, 2].map(|_| vec![0.0f32; shape.iter().product()]);
            let [a, b, c] = rest.each_mut().map(|v| AnyViewMut::F32(ViewMut::dense(v, shape)));
            match component {
                1 => pointwise::transfer(read(0), points, Some(view), None),
                2 => pointwise::transfer(read(0), points, None, Some([view, b, c])),
                3 => pointwise::transfer(read(0), points, None, Some([a, view, c])),
                _ => pointwise::transfer(read(0), points, None, Some([a, b, view])),
            }
        }
        Op::Length | Op::Share { .. } => unreachable!("gradients and sweeps have it"),
    }
    out
}

fn operations() -> Vec<(Op, usize)> {
    let points = vec![
        [-2.0, 0.0, 1.0, 0.5, 0.1],
        [0.25, 0.9, 0.0, 0.5, 0.2],
        [0.25, 0.3, 0.7, 0.0, 0.0],
        [90.0, 1.0, 0.1, 0.9, 1.0],
    ];
    let mut list = vec![
        (Op::Scale, 1),
        (Op::Times { by: 1.0 / 3.0 }, 1),
        (Op::Window { low: 0.1, high: 0.7, mode: WindowMode::Keep }, 1),
        (Op::Window { low: 0.1, high: 0.7, mode: WindowMode::Stretch }, 1),
        (Op::Window { low: 0.4, high: 0.4, mode: WindowMode::Stretch }, 1),
        (Op::ByVariance { sigma_max2: 0.3 }, 2),
        (Op::ByVariance { sigma_max2: 0.0 }, 2),
        (Op::BySaliency { threshold: 0.2, gain: 1.7 }, 2),
        (Op::Light { k: 0.7 }, 2),
    ];
    let kinds = [CombineKind::Add, CombineKind::Multiply, CombineKind::Min, CombineKind::Max, CombineKind::Mean];
    list.extend(kinds.into_iter().flat_map(|k| (1..=3).map(move |n| (Op::Combine(k), n))));
    list.extend((1..=4).map(|component| (Op::Transfer { points: points.clone(), component }, 1)));
    list
}

#[test]
fn steps_that_look_at_one_voxel_equal_the_cpus() {
    let Some(gpu) = adapter() else { return };
    let shape = [3, 5, 83];
    let whole = Region::whole(shape);
    let affine = Affine { slope: -0.37, intercept: 11.0 };
    let mut sources: Vec<Voxels> =
        [DType::U8, DType::I8, DType::U16, DType::I16].map(|d| fills(d, shape).swap_remove(0).1).into();
    sources.push(hostile(shape, 3));
    for source in &sources {
        for (op, count) in operations() {
            let scales = matches!(op, Op::Scale | Op::Combine(_) | Op::Transfer { .. });
            let affine = if scales { affine } else { Affine::IDENTITY };
            // Beside the source what two steps made of it.
            let others = [Op::Times { by: 0.5 }, Op::Times { by: -3.0 }];
            let mut steps: Vec<FlowStep> = others.iter().map(|o| point(o.clone(), &[Input::Source])).collect();
            steps.push(point(op.clone(), &[Input::Source, made(0, 0), made(1, 0)][..count]));
            let sink = Sink { value: made(2, 0), mean: None, region: whole, pyramid: None };
            let flow = flow_of(source.dtype(), affine, shape, steps, vec![sink]);
            let made: Vec<Vec<f32>> = others
                .iter()
                .map(|o| {
                    let Op::Times { by } = o else { unreachable!() };
                    let mut scaled = vec![0.0f32; whole.voxels()];
                    // In f64 both at once.
                    let mut wide = Voxels::zeroed(DType::F64, whole.voxels());
                    pointwise::scale(source.view(shape), affine, None, wide.view_mut(shape));
                    let view = AnyViewMut::F32(ViewMut::dense(&mut scaled, shape));
                    pointwise::scale(wide.view(shape), Affine { slope: *by, intercept: 0.0 }, None, view);
                    scaled
                })
                .collect();
            let mut reads = vec![(source.view(shape), affine)];
            reads.extend(made.iter().map(|v| (AnyView::F32(View::dense(v, shape)), Affine::IDENTITY)));
            let cpu = pointwise_on_cpu(&op, &reads[..count], shape);
            let got = results(&gpu, &flow, source).expect("it fits").swap_remove(0).swap_remove(0);
            let words = got.as_chunks::<4>().0.iter().map(|b| f32::from_ne_bytes(*b));
            let same = |a: f32, b: f32| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
            let wrong = cpu.iter().zip(words).enumerate().find(|(_, (a, b))| !same(**a, *b));
            assert_eq!(wrong, None, "{op:?} of {count} channels of {}", source.dtype());
        }
    }
}
