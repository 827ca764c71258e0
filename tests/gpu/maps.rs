//! Occlusion maps: every level of the chain within `facts::tolerance`, and never a brick that shows.

use std::path::Path;

use occlude::brick::{Scratch, Voxels, gather};
use occlude::gpu::maps::{MapCodes, MapJob, MapLevel};
use occlude::gpu::{Gpu, facts};
use occlude::grid::{Affine, AnyView, DType, Region, Shape, View};
use occlude::kernel::Context;
use occlude::kernel::convert::{Mapping, convert};
use occlude::kernel::occlusion_map::{Moments, base, coarsen};
use occlude::kernel::simd::Level;

use super::common::{Decoded, assert_same, decode};
use super::setup::{CPU, folder, lane, run_on};
use super::{adapter, fills};

const DTYPES: [DType; 4] = [DType::U8, DType::I8, DType::U16, DType::I16];

fn levels(shape: Shape, halved: &[[bool; 3]]) -> Vec<MapLevel> {
    let mut list = vec![MapLevel { shape, factor: [1; 3], halved: [false; 3] }];
    for &halved in halved {
        let fine = list[list.len() - 1];
        let shape = std::array::from_fn(|a| if halved[a] { fine.shape[a].div_ceil(2) } else { fine.shape[a] });
        let factor = std::array::from_fn(|a| fine.factor[a] << halved[a] as usize);
        list.push(MapLevel { shape, factor, halved });
    }
    list
}

/// All levels from 1 on, over the whole volume, by the CPU.
fn on_cpu(volume: &Voxels, levels: &[MapLevel], affine: Affine) -> Vec<Moments> {
    let mut cx = Context { level: Level::detect(), scratch: &mut Scratch::new() };
    let mut fine = Moments::default();
    base(volume.view(levels[0].shape), affine, None, &mut fine);
    let mut made = Vec::new();
    for pair in levels.windows(2) {
        let [from, to] = [pair[0], pair[1]];
        let mut coarse = Moments::default();
        let [fine_box, coarse_box] = [from, to].map(|l| Region::whole(l.shape));
        coarsen(&fine, fine_box, from.shape, to.halved, coarse_box, &mut coarse, &mut cx);
        made.push(coarse.clone());
        fine = coarse;
    }
    made
}

/// The same over a brick by the device, from no more than it needs.
fn on_gpu(gpu: &Gpu, volume: &Voxels, levels: &[MapLevel], brick: Region, affine: Affine) -> Vec<Moments> {
    (2..=levels.len()).map(|count| last_on_gpu(gpu, volume, &levels[..count], brick, affine)).collect()
}

/// Of the last of these levels alone.
fn last_on_gpu(gpu: &Gpu, volume: &Voxels, levels: &[MapLevel], brick: Region, affine: Affine) -> Moments {
    let job = MapJob::new(volume.dtype(), levels.to_vec()).unwrap();
    let read = job.boxes(brick)[0];
    let mut part = Voxels::zeroed(volume.dtype(), read.voxels());
    let whole = Region::whole(levels[0].shape);
    gather::copy_common(volume.view(levels[0].shape), whole, part.view_mut(read.shape()), read);
    let (first, dtype, mapping) = (levels.len(), DType::F32, Mapping::KEEP);
    let codes = MapCodes { first, moments: vec![], dtype, mapping, affine, cells: true };
    let made = gpu.occlusion_codes(part.view(read.shape()), read, &job, brick, &codes);
    made.unwrap_or_else(|e| panic!("{e}")).last.expect("the last level's cells are asked for")
}

/// The first cell that lies further from the CPU's than the tolerance; of two lanes' levels over the whole volume.
fn differs(cpu: &[Moments], gpu: &[Moments], range: f64) -> Option<String> {
    let bound = |mean: f64| facts::tolerance::MEAN * range + 2f64.powi(-23) * mean.abs();
    (0..cpu.len()).find_map(|k| {
        let close = |i: usize| {
            let (m, v) = (cpu[k].mean[i], cpu[k].variance[i]);
            (m - gpu[k].mean[i]).abs() <= bound(m) && (v - gpu[k].variance[i]).abs() <= facts::tolerance::VARIANCE * v
        };
        let i = (0..cpu[k].mean.len()).find(|&i| !close(i))?;
        let of = |m: &Moments| (m.mean[i], m.variance[i]);
        Some(format!("level {}, cell {i}: {:?} on the CPU, {:?} on the GPU", k + 1, of(&cpu[k]), of(&gpu[k])))
    })
}

#[test]
fn every_level_holds_its_tolerance_on_every_type_and_fill() {
    let Some(gpu) = adapter() else { return };
    let chains: [(Shape, &[[bool; 3]]); 4] = [
        ([19, 22, 37], &[[true; 3]; 3]),
        ([9, 40, 33], &[[false, true, true], [true; 3], [true; 3]]),
        ([1, 1, 70], &[[false, false, true]; 3]),
        ([30, 2, 3], &[[true, true, true], [true, false, true]]),
    ];
    for (shape, halved) in chains {
        let levels = levels(shape, halved);
        for dtype in DTYPES {
            for (name, volume) in fills(dtype, shape) {
                for affine in [Affine::IDENTITY, Affine { slope: -0.5, intercept: 300.0 }] {
                    let cpu = on_cpu(&volume, &levels, affine);
                    let got = on_gpu(&gpu, &volume, &levels, Region::whole(shape), affine);
                    let range = 2f64.powi(8 * dtype.size() as i32) * affine.slope.abs();
                    if let Some(text) = differs(&cpu, &got, range) {
                        panic!("{name} of {dtype} {shape:?}, {affine:?}: {text}");
                    }
                }
            }
        }
    }
}

#[test]
fn a_constant_stays_what_it_is() {
    let Some(gpu) = adapter() else { return };
    let levels = levels([11, 13, 17], &[[true; 3]; 3]);
    for value in [0.0, 1.0, 201.0, 65535.0] {
        let mut volume = Voxels::zeroed(DType::U16, 11 * 13 * 17);
        volume.fill(value);
        for level in on_gpu(&gpu, &volume, &levels, Region::whole([11, 13, 17]), Affine::IDENTITY) {
            assert!(level.mean.iter().all(|m| *m == value) && level.variance.iter().all(|v| *v == 0.0));
        }
    }
}

#[test]
fn bricks_and_cuts_change_no_bit() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [37, 42, 51];
    let levels = levels(shape, &[[true; 3], [false, true, true], [true; 3]]);
    for dtype in [DType::U8, DType::I16] {
        let job = MapJob::new(dtype, levels.clone()).unwrap();
        let volume = fills(dtype, shape).swap_remove(0).1;
        gpu.set_cap(1 << 30);
        let all = on_gpu(&gpu, &volume, &levels, Region::whole(shape), Affine::IDENTITY);
        for (lo, hi, cap) in [
            ([0, 0, 0], [37, 42, 51], 300_000),
            ([16, 8, 0], [32, 42, 16], 1 << 30),
            ([36, 40, 48], [37, 42, 51], 1 << 30),
        ] {
            gpu.set_cap(cap);
            let brick = Region::new(lo, hi);
            let got = on_gpu(&gpu, &volume, &levels, brick, Affine::IDENTITY);
            for k in 1..4 {
                let (own, n) = (job.own(k, brick), levels[k].shape);
                for (j, v) in own.iter().enumerate() {
                    let i = (v[0] as usize * n[1] + v[1] as usize) * n[2] + v[2] as usize;
                    let of = |m: &Moments, i: usize| [m.mean[i].to_bits(), m.variance[i].to_bits()];
                    assert_eq!(of(&all[k - 1], i), of(&got[k - 1], j), "{dtype}, {brick:?}, level {k}, {v:?}");
                }
            }
        }
    }
}

#[test]
fn a_lost_device_is_opened_anew_and_what_has_no_kernel_is_named() {
    for dtype in DTYPES {
        assert_eq!(facts::occlusion_map(dtype, false), Ok(()));
        assert!(facts::occlusion_map(dtype, true).unwrap_err().contains("missing"));
    }
    for dtype in [DType::U32, DType::I32, DType::F32, DType::F64] {
        assert!(facts::occlusion_map(dtype, false).unwrap_err().contains("runs on the CPU"));
    }
    let Some(gpu) = adapter() else { return };
    let (shape, levels) = ([9, 10, 11], levels([9, 10, 11], &[[true; 3]]));
    let volume = fills(DType::U8, shape).swap_remove(0).1;
    let all = on_gpu(&gpu, &volume, &levels, Region::whole(shape), Affine::IDENTITY);
    gpu.lose(false);
    assert_eq!(all, on_gpu(&gpu, &volume, &levels, Region::whole(shape), Affine::IDENTITY));
}

#[test]
fn the_comparison_can_fail() {
    let level = Moments { mean: vec![100.0; 4], variance: vec![2.0; 4] };
    let with = |change: &dyn Fn(&mut Moments)| {
        let mut other = level.clone();
        change(&mut other);
        differs(std::slice::from_ref(&level), &[other], 1000.0)
    };
    assert_eq!(with(&|_| ()), None);
    assert_eq!(with(&|m| m.mean[3] += 9e-4), None);
    assert!(with(&|m| m.mean[3] += 2e-3).unwrap().contains("level 1, cell 3"));
    assert!(with(&|m| m.variance[1] += 3e-5).is_some());
    assert!(with(&|m| m.variance[1] = f64::NAN).is_some());
}

const CONFIG: &str = r#"
[run]
threads = 2
brick = [16, 32, 32]
[input.vol]
path = "vol.npy"
slope = 0.5
[stage.map]
op = "occlusion_map"
input = "vol"
[stage.fine]
op = "occlusion_map"
input = "vol"
start_level = 0
[output.map]
path = "out/map.zarr"
from = ["map.mean", "map.variance"]
chunk = 16
shard = 32
[output.fine]
path = "out/fine.zarr"
from = "fine.mean"
chunk = 16
shard = 32
"#;

fn run(dir: &Path, sets: &[&str]) -> [Decoded; 2] {
    let report = run_on(dir, CONFIG, sets);
    let device = if sets.contains(&CPU) { "cpu" } else { "gpu" };
    assert_eq!([&report.placement["map"], &report.placement["fine"]], [device; 2]);
    ["map", "fine"].map(|name| decode(&dir.join(format!("out/{name}.zarr"))))
}

#[test]
fn a_run_makes_maps_on_the_gpu_and_shows_no_brick() {
    let Some(_) = adapter() else { return };
    let dir = folder([40, 70, 80]);
    let cpu = run(dir.path(), &[CPU]);
    let all = run(dir.path(), &[lane()]);
    let sets: [&[&str]; 3] = [
        &[lane(), "run.brick=[32, 16, 64]"],
        &[lane(), "run.memory='40MiB'", "run.brick='auto'"],
        &[lane(), "run.brick=[64, 96, 96]"],
    ];
    for sets in sets {
        for (a, b) in all.iter().zip(run(dir.path(), sets)) {
            assert_same(&format!("{sets:?}"), a, &b);
        }
    }
    for (cpu, gpu) in cpu.iter().zip(&all) {
        assert!(cpu.keys().eq(gpu.keys()) && cpu.len() > 1, "a few levels");
        for ((name, (_, a)), (_, b)) in cpu.iter().zip(gpu.values()) {
            // Variances are as large as their values' range squared, means as it is.
            let values = a.iter().zip(b).map(|(a, b)| (f64::from_bits(*a), f64::from_bits(*b)));
            let far = values.clone().find(|(a, b)| (a - b).abs() > 1e-6 * 32768.0 + 1e-5 * a.abs());
            assert!(far.is_none() && a.len() == b.len(), "{name}: {far:?}");
            assert!(values.clone().any(|(a, _)| a != 0.0));
        }
    }
}

#[test]
fn codes_are_those_of_the_levels_bit_for_bit() {
    let Some(mut gpu) = adapter() else { return };
    let shape = [19, 22, 37];
    let list = levels(shape, &[[true; 3], [false, true, true], [true; 3]]);
    let brick = Region::whole(shape);
    for (dtype, to, range) in [
        (DType::U8, DType::U8, Some([-20.0, 90.0])),
        (DType::I16, DType::U16, Some([-30000.0, 30000.0])),
        (DType::U16, DType::F32, None),
    ] {
        for (name, volume) in fills(dtype, shape) {
            for affine in [Affine::IDENTITY, Affine { slope: -0.37, intercept: 11.0 }] {
                let job = MapJob::new(dtype, list.clone()).unwrap();
                let view = volume.view(shape);
                gpu.set_cap(1 << 30);
                let moments = on_gpu(&gpu, &volume, &list, brick, affine);
                let mapping = Mapping { range, fill: 3.0 };
                let codes = MapCodes { first: 2, moments: vec![1, 0], dtype: to, mapping, affine, cells: true };
                for cap in [1 << 30, 60_000] {
                    gpu.set_cap(cap);
                    let made = gpu.occlusion_codes(view, brick, &job, brick, &codes).unwrap();
                    assert!(made.codes[0].is_empty(), "level 1 is not stored");
                    assert_eq!(made.last.as_ref(), moments.last(), "{name} of {dtype}, cap {cap}");
                    for k in [2, 3] {
                        let extent = job.own(k, brick).shape();
                        let values = [&moments[k - 1].variance, &moments[k - 1].mean];
                        for (values, got) in values.into_iter().zip(&made.codes[k - 1]) {
                            let mut expect = Voxels::zeroed(to, values.len());
                            let from = AnyView::F64(View::dense(values, extent));
                            convert(from, mapping, expect.view_mut(extent));
                            assert_eq!(
                                expect.as_bytes(),
                                got.as_bytes(),
                                "{name} of {dtype} to {to}, level {k}, cap {cap}"
                            );
                        }
                    }
                }
            }
        }
    }
}
