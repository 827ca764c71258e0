//! Whole runs against mathematics, on arrays in memory.

mod common;

use common::*;
use ndarray::Array3;
use occlude::run::{RunOptions, Session, Silent};
use occlude::store::Source;

/// Runs one stage over an array and returns its main channel.
fn stage(volume: &Array3<f32>, body: &str) -> Array3<f64> {
    let dir = tempfile::tempdir().unwrap();
    let text = format!(
        "[run]\nbrick = 16\n[input.a]\npath = 'memory.npy'\n[stage.s]\ninput = 'a'\n{body}\n[output.o]\npath = 'o.npy'\nfrom = 's'\n\
         dtype = 'f32'\n"
    );
    let config = parse(dir.path(), &text, &[]);
    let options = RunOptions::default();
    let source = Source::from_ndarray(volume.view());
    let session = Session::open_with(&config, vec![source], &options, &Silent).unwrap_or_else(|e| panic!("{e}"));
    let tasks = session.open_tasks();
    session.run_tasks(&tasks).unwrap();
    session.finish().unwrap();
    let decoded = decode(&dir.path().join("o.npy"));
    let (shape, bits) = &decoded["level 0 component 0"];
    Array3::from_shape_fn((shape[0], shape[1], shape[2]), |(z, y, x)| {
        f64::from_bits(bits[(z * shape[1] + y) * shape[2] + x])
    })
}

#[test]
fn a_plane_through_the_centre_leaves_half_open_by_mid_rank() {
    // Values fall along z: half of each interior window is denser.
    let v = Array3::from_shape_fn((31, 24, 26), |(z, _, _)| -(z as f32));
    let o = stage(&v, "op = 'ambient_occlusion'\nmethod = 'exact'\nradius = 3\nties = 'mid'");
    for z in 3..28 {
        assert!((o[[z, 10, 10]] - 0.5).abs() < 1e-7, "{}", o[[z, 10, 10]]);
    }
}

#[test]
fn a_two_value_window_gives_chebyshev_its_exact_share() {
    // Checkerboard of columns: the share of the high value in a window is known by counting.
    let v = Array3::from_shape_fn((20, 20, 20), |(_, _, x)| if x < 10 { 0.0 } else { 4.0 });
    let o = stage(&v, "op = 'ambient_occlusion'\nmethod = 'chebyshev'\nradius = 2");
    // At x = 10 and 11 the window holds 3 and 4 of 5 planes of the high value: openness = 1 - share.
    assert!((o[[10, 10, 10]] - 0.4).abs() < 1e-6 && (o[[10, 10, 11]] - 0.2).abs() < 1e-6);
}

#[test]
fn a_uniform_field_gives_itself_by_the_power_law() {
    let noise = |i: u64| (hash(11, i) >> 40) as f32 / (1u64 << 24) as f32;
    let v = Array3::from_shape_fn((40, 40, 40), |(z, y, x)| noise(((z * 40 + y) * 40 + x) as u64));
    let o = stage(&v, "op = 'ambient_occlusion'\nmethod = 'cdf_power'\nradius = 8");
    let mut worst = 0.0f64;
    for i in (8..32).step_by(5) {
        worst = worst.max((o[[i, i, i]] - f64::from(v[[i, i, i]])).abs());
    }
    assert!(worst < 0.03, "t^beta of uniform values is the value: off by {worst}");
}

/// A mirror repeats a plane of one voxel and nothing else: windows on it hold what windows in the middle of
/// as many copies hold. (Fewer values than `levels` keeps, which takes quantiles of all voxels.)
#[test]
fn a_plane_under_mirrors_is_a_stack_of_itself() {
    let plane = |_, y: usize, x: usize| (hash(5, (y * 40 + x) as u64) % 50) as f32;
    for border in ["nearest", "reflect"] {
        for (kind, stack) in [
            ("op = 'box'\nradius = [3, 4, 2]", 7),
            ("op = 'gaussian'\nsigma = [1, 2, 1]", 7),
            ("op = 'ambient_occlusion'\nmethod = 'cdf_power'\nradius = 3", 7),
            ("op = 'ambient_occlusion'\nmethod = 'exact'\nties = 'mid'\nradius = 3", 7),
            ("op = 'ambient_occlusion'\nmethod = 'exact'\nradius = 2\nregion = 'ball'", 5),
            ("op = 'ambient_occlusion'\nmethod = 'exact'\nradius = 5\nregion = 'equal_volume'", 9),
            ("op = 'ambient_occlusion'\nmethod = 'levels'\nradius = 3", 7),
        ] {
            let body = format!("{kind}\nborder = '{border}'");
            let one = stage(&Array3::from_shape_fn((1, 30, 40), |(z, y, x)| plane(z, y, x)), &body);
            let many = stage(&Array3::from_shape_fn((stack, 30, 40), |(z, y, x)| plane(z, y, x)), &body);
            for y in 0..30 {
                for x in 0..40 {
                    let (a, b) = (one[[0, y, x]], many[[stack / 2, y, x]]);
                    assert!((a - b).abs() <= 1e-6 * b.abs().max(1.0), "{body} at {y}, {x}: {a}, of copies {b}");
                }
            }
        }
    }
}

#[test]
fn a_wall_dims_by_the_closed_form_of_each_rho() {
    // One dense plane h voxels above; directions that meet it within dmax contribute rho. Lattice lines round by half a
    // voxel, so the distances are long.
    let (h, dmax) = (16usize, 40.0f64);
    let v = Array3::from_shape_fn((40, 86, 86), |(z, _, _)| if z == 20 + h { 1.0 } else { 0.0 });
    let a = h as f64 / dmax;
    for (rho, expected) in [
        ("step", 1.0 - (1.0 - a) / 2.0),
        ("linear", 1.0 - ((1.0 - a) + a * a.ln()) / 2.0),
        ("sqrt", 1.0 - (1.0 - a.sqrt()).powi(2) / 2.0),
    ] {
        let body =
            format!("op = 'obscurance'\nset = 'fibonacci'\ndirections = 400\nrho = '{rho}'\nmax_distance = {dmax}");
        let o = stage(&v, &body)[[20, 43, 43]];
        assert!((o - expected).abs() < 0.012, "{rho}: {o}, closed form {expected}");
    }
}

#[test]
fn a_linear_ramp_has_its_slope_everywhere_inside() {
    let v = Array3::from_shape_fn((14, 15, 16), |(z, y, x)| 2.0 * z as f32 - 3.0 * y as f32 + 6.0 * x as f32);
    let g = stage(&v, "op = 'gradient'");
    assert!((g[[7, 7, 7]] - 7.0).abs() < 1e-5, "{}", g[[7, 7, 7]]);
    let flat = stage(&v, "op = 'gaussian'\nsigma = 1.0");
    assert!((flat[[7, 7, 7]] - f64::from(v[[7, 7, 7]])).abs() < 1e-4);
}

#[test]
fn directions_weighed_by_the_normal_make_one_openness() {
    // Values fall along z and so does the normal: no voxel in the open half is denser.
    let v = Array3::from_shape_fn((14, 15, 16), |(z, _, _)| -(z as f32));
    let o = stage(&v, "op = 'obscurance'\ndirections = 12\nmax_distance = 3\nweight_by_normal = true");
    assert!(
        o.iter().all(|o| (o - 1.0).abs() < 1e-6),
        "the openness, not the gradient that weighs it: {:?}",
        o[[7, 7, 7]]
    );
}

/// Mean of the middle of a part of the phantom's volume, by channel (openness, then red, green, blue): the shipped config with
/// 2000 directions and a reach that meets one face only.
fn phantom(region: [[i64; 2]; 3], dmax: f64) -> [f64; 4] {
    let dir = tempfile::tempdir().unwrap();
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/phantom.toml");
    let sets = [
        "stage.sweep.set=fibonacci".to_string(),
        "stage.sweep.directions=2000".to_string(),
        format!("stage.sweep.max_distance={dmax}"),
        "stage.sweep.ambient=[0.25, 0.5, 1.0]".to_string(),
        format!("run.region={region:?}"),
        "output.openness.dtype=f32".to_string(),
        "output.rgb.dtype=u16".to_string(),
        format!("output.openness.path={}", dir.path().join("o.npy").display()),
        format!("output.rgb.path={}", dir.path().join("rgb.zarr").display()),
    ];
    let config = occlude::config::load(&path, &sets).unwrap_or_else(|e| panic!("{e}"));
    run_with(&config, &RunOptions::default());
    let mean = |path: &str, component: usize, scale: f64| {
        let decoded = decode(&dir.path().join(path));
        let (_, bits) = &decoded[&format!("level 0 component {component}")];
        bits.iter().map(|v| f64::from_bits(*v) / scale).sum::<f64>() / bits.len() as f64
    };
    let colour = |c| mean("rgb.zarr", c, 65535.0);
    [mean("o.npy", 0, 1.0), colour(0), colour(1), colour(2)]
}

#[test]
fn faces_of_the_phantom_bleed_by_their_closed_form_on_the_axes() {
    // On a line through the middle of a face, h from it: a share of (1 + a) / 2 of all directions is open, and the rest
    // sees the face through sqrt(d / dmax), whose mean is O - (1 + a) / 2. Lines that are not dominated by the face's
    // normal enter it half a voxel early on average (see the wall above), so the truth lies between two forms.
    let (h, dmax, ambient) = (16, 40.0, [0.25, 0.5, 1.0]);
    let closed = |a: f64, face: f64, ambient: f64| {
        let (all, open) = (1.0 - (1.0 - a.sqrt()).powi(2) / 2.0, (1.0 + a) / 2.0);
        open * ambient + (all - open) * face
    };
    for (axis, face) in [(2, [0.0, 1.0, 0.0]), (1, [0.0, 0.0, 1.0]), (0, [1.0, 1.0, 1.0])] {
        let mut region = [[60, 66]; 3];
        region[axis] = [h, h + 1];
        let got = phantom(region, dmax);
        for (c, got) in got.into_iter().enumerate() {
            let (face, ambient) = if c == 0 { (1.0, 1.0) } else { (face[c - 1], ambient[c - 1]) };
            let forms = [0.5, 0.0].map(|near| closed((h as f64 - near) / dmax, face, ambient));
            let (lo, hi) = (forms[0].min(forms[1]), forms[0].max(forms[1]));
            assert!(lo - 2e-3 < got && got < hi + 2e-3, "axis {axis} channel {c}: {got}, closed forms {lo} {hi}");
        }
    }
}

#[test]
fn what_masked_voxels_hold_is_no_saliency() {
    // Slopes of 0.001, 0.002 and 0.003 along x, far below the fill of the half that nothing needs.
    let slope = |x: usize| [0.001, 0.002, 0.003][x / 10];
    let value = |x: usize| (0..x).map(slope).sum::<f64>();
    let v = Array3::from_shape_fn((20, 12, 30), |(_, _, x)| value(x) as f32);
    let body = "op = 'saliency'\nsize = 3\nscale = 'max'\nfill = 0.5\nwhere = { input = 'a', max = 0.029 }";
    let o = stage(&v, body);
    // Needed are the first 20 voxels of a row: the largest of their saliencies is 0.0025, where two slopes meet, or 0.002.
    let largest = (0..20).map(|x| o[[10, 6, x]]).fold(0.0, f64::max);
    assert!((largest - 1.0).abs() < 1e-6, "{largest}");
    assert_eq!(o[[10, 6, 29]], 0.5);
}

/// Levels of a variance beside a mean a hundred thousand times larger than the spread, whose f32 hides a part of it.
#[test]
fn levels_of_a_variance_pool_unrounded_means() {
    let shape = [16, 12, 20];
    let value = |z: usize, y: usize, x: usize| 1e6 + (hash(5, ((z * 64 + y) * 64 + x) as u64) % 64) as f64 / 8.0;
    let dir = tempfile::tempdir().unwrap();
    let floats: Vec<f32> = fill(shape, |z, y, x| value(z, y, x) as f32);
    write_npy(&dir.path().join("floats.npy"), "<f4", shape, &f32_bytes(&floats));
    let counts: Vec<u16> = fill(shape, |z, y, x| 65000 + (value(z, y, x) as u64 % 3) as u16);
    write_npy(&dir.path().join("counts.npy"), "<u2", shape, &u16_bytes(&counts));
    let doubles: Vec<f64> = fill(shape, |z, y, x| value(z, y, x) + 0.1);
    let bytes: Vec<u8> = doubles.iter().flat_map(|v| v.to_le_bytes()).collect();
    write_npy(&dir.path().join("doubles.npy"), "<f8", shape, &bytes);
    let volumes = [
        ("floats", floats.iter().map(|v| *v as f64).collect::<Vec<_>>()),
        ("counts", counts.iter().map(|v| *v as f64).collect()),
        ("doubles", doubles),
    ];
    for (input, voxels) in &volumes {
        for (name, stage, reach) in [("box", "op = 'box'\nradius = 1", 1), ("bell", "op = 'gaussian'\nsigma = 0.6", 2)]
        {
            let weight = |d: i64| if name == "box" { 1.0 } else { (-(d * d) as f64 / 0.72).exp() };
            let windows = fill(shape, |z, y, x| moments(voxels, shape, [z, y, x], reach, &weight));
            for channel in ["variance", "std"].into_iter().filter(|c| *c == "variance" || name == "box") {
                let text = format!(
                    "[run]\nbrick = 8\n[input.v]\npath = '{input}.npy'\n[stage.s]\n{stage}\ninput = 'v'\n[output.o]\n\
                     path = 'o.zarr'\nfrom = 's.{channel}'\nreduce = 'moments'\nchunk = 4\nlevels = 3\n[output.mean]\npath = 'mean.npy'\nfrom = 's.mean'\n"
                );
                run(dir.path(), &text, &[]);
                // Beside the means that levels pool stand those that were asked for.
                let (_, means) = &decode(&dir.path().join("mean.npy"))["level 0 component 0"];
                for (bits, window) in means.iter().zip(&windows) {
                    let (got, expect) = (f64::from_bits(*bits), window[0] + voxels[0]);
                    assert!((got - expect).abs() <= 2e-7 * expect, "{name}.mean of {input}: {got}, {expect} expected");
                }
                let decoded = decode(&dir.path().join("o.zarr"));
                for level in 1..3 {
                    let (cells, bits) = &decoded[&format!("level {level} component 0")];
                    for (c, bits) in bits.iter().enumerate() {
                        let cell = [c / cells[2] / cells[1], c / cells[2] % cells[1], c % cells[2]];
                        let variance = pooled(&windows, shape, cell, 1 << level);
                        let expect = if channel == "std" { variance.sqrt() } else { variance };
                        let got = f64::from_bits(*bits);
                        let what = format!("{name}.{channel} of {input}, level {level} cell {cell:?}");
                        assert!((got - expect).abs() <= 1e-6 * expect, "{what}: {got}, {expect} expected");
                    }
                }
            }
        }
    }
}

/// Mean (less the first voxel) and variance of the window about `c`, in two passes.
fn moments(voxels: &[f64], shape: [usize; 3], c: [usize; 3], reach: i64, weight: &dyn Fn(i64) -> f64) -> [f64; 2] {
    let edge = 2 * reach as usize + 1;
    let taps: Vec<(f64, f64)> = fill([edge; 3], |z, y, x| [z, y, x].map(|i| i as i64 - reach))
        .into_iter()
        .filter(|d| (0..3).all(|a| (0..shape[a] as i64).contains(&(c[a] as i64 + d[a]))))
        .map(|d| {
            let [z, y, x]: [usize; 3] = std::array::from_fn(|a| (c[a] as i64 + d[a]) as usize);
            (d.map(weight).iter().product(), voxels[(z * shape[1] + y) * shape[2] + x] - voxels[0])
        })
        .collect();
    let total: f64 = taps.iter().map(|t| t.0).sum();
    let mean = taps.iter().map(|t| t.0 * t.1).sum::<f64>() / total;
    [mean, taps.iter().map(|t| t.0 * (t.1 - mean).powi(2)).sum::<f64>() / total]
}

/// Mean of variances plus variance of means of the windows that a cell covers.
fn pooled(windows: &[[f64; 2]], shape: [usize; 3], cell: [usize; 3], edge: usize) -> f64 {
    let covered: Vec<[f64; 2]> =
        fill([edge; 3], |z, y, x| [cell[0] * edge + z, cell[1] * edge + y, cell[2] * edge + x])
            .into_iter()
            .filter(|p| (0..3).all(|a| p[a] < shape[a]))
            .map(|p| windows[(p[0] * shape[1] + p[1]) * shape[2] + p[2]])
            .collect();
    let n = covered.len() as f64;
    let mean = covered.iter().map(|w| w[0]).sum::<f64>() / n;
    covered.iter().map(|w| w[1] + (w[0] - mean).powi(2)).sum::<f64>() / n
}
