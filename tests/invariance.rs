//! Bricks never show (SPEC 5.1): one result for every brick, thread count, budget, region and way of skipping.

mod common;

use std::path::Path;

use common::*;

const SHAPE: [usize; 3] = [61, 75, 83];

/// Every kind of stage in one graph, over `vol.npy`.
const CONFIG: &str = r#"
[input.vol]
path = "vol.npy"
spacing = [2, 1, 1]

[stage.stats]
op = "box"
input = "vol"
radius = [2, 3, 4]
[stage.ao]
op = "ambient_occlusion"
input = "vol"
method = "cdf_power"
radius = [2, 3, 4]
[stage.rank]
op = "ambient_occlusion"
input = "vol"
method = "exact"
radius = 2
border = "reflect"
[stage.shares]
op = "ambient_occlusion"
input = "vol"
method = "levels"
level_count = 16
radius = [2, 3, 4]
solid = "low"
border = "nearest"
[stage.between]
op = "ambient_occlusion"
input = "vol"
method = "moments4"
radius = [2, 3, 4]
ties = "mid"
[stage.wide]
op = "ambient_occlusion"
input = "bell.mean"
method = "moments4"
radius = 2
solid = "low"
border = { constant = 1000.5 }
[stage.bell]
op = "gaussian"
input = "vol"
sigma = 1.3
[stage.slope]
op = "gradient"
input = "vol"
[stage.map]
op = "occlusion_map"
input = "vol"
[stage.sweep]
op = "obscurance"
input = "vol"
directions = 12
max_distance = 9
[stage.paint]
op = "transfer"
input = "vol"
points = [[0, 0, 1, 0, 0], [65535, 1, 0, 0, 1]]
[stage.coloured]
op = "obscurance"
input = "vol"
directions = 12
max_distance = 5
colour = "paint"
weight_by_normal = true
[stage.masked]
op = "ambient_occlusion"
input = "vol"
method = "gaussian_cdf"
radius = 3
where = { input = "vol", min = 33000 }
[stage.edge]
op = "saliency"
input = "sweep"
size = 3
scale = "max"
[stage.windowed]
op = "window"
input = "sweep"
low = 0.3
high = 0.9
mode = "stretch"
[stage.lines]
op = "saliency"
input = "windowed"
[stage.strong]
op = "opacity_modulation"
input = "paint"
by = "lines"
threshold = 0.01
gain = 5
[stage.again]
op = "obscurance"
input = "strong"
directions = 12
max_distance = 7
weight_by_normal = true
[stage.light]
op = "combine"
inputs = ["ao", "rank", "sweep"]
op_kind = "mean"

[output.stats]
path = "out/stats.zarr"
from = "stats.variance"
reduce = "moments"
chunk = 16
shard = 32
levels = 5
[output.extremes]
path = "out/extremes.zarr"
from = ["stats.min", "stats.max"]
chunk = [16, 8, 16]
shard = "none"
codec = "zstd:1"
[output.shares]
path = "out/shares.zarr"
from = "shares"
chunk = 16
dtype = "native"
[output.between]
path = "out/between.zarr"
from = ["between.lower", "between", "between.upper"]
chunk = 16
[output.wide]
path = "out/wide.zarr"
from = ["wide.lower", "wide.upper"]
chunk = 32
[output.ao]
path = "out/ao.zarr"
from = "ao"
chunk = 16
shard = 48
[output.rank]
path = "out/rank.npy"
from = "rank"
dtype = "f32"
[output.bell]
path = "out/bell.zarr"
from = ["bell.mean", "bell.variance"]
chunk = 24
[output.slope]
path = "out/slope.zarr"
from = "slope.vector"
chunk = 32
format = "ome-zarr-0.4"
[output.map]
path = "out/map.zarr"
from = ["map.mean", "map.variance"]
chunk = 4
shard = 8
[output.masked]
path = "out/masked.zarr"
from = "masked"
dtype = "f32"
chunk = 16
[output.edge]
path = "out/edge.zarr"
from = "edge"
dtype = "u8"
range = "auto"
chunk = 16
[output.coloured]
path = "out/coloured.npy"
from = "coloured"
dtype = "f32"
[output.again]
path = "out/again.zarr"
from = ["again", "lines", "strong"]
chunk = 16
shard = "none"
[output.light]
path = "out/light.raw"
from = "light"
"#;

const OUTPUTS: [&str; 15] = [
    "stats.zarr",
    "extremes.zarr",
    "shares.zarr",
    "between.zarr",
    "wide.zarr",
    "ao.zarr",
    "rank.npy",
    "bell.zarr",
    "slope.zarr",
    "map.zarr",
    "masked.zarr",
    "edge.zarr",
    "coloured.npy",
    "again.zarr",
    "light.raw",
];

/// Runs and decodes every output; raw files are taken as they are.
fn results(dir: &Path, sets: &[&str]) -> Vec<(Decoded, String)> {
    run(dir, CONFIG, sets);
    OUTPUTS.iter().map(|name| one(&dir.join("out").join(name))).collect()
}

fn one(path: &Path) -> (Decoded, String) {
    if path.extension().is_some_and(|e| e == "raw") {
        let bytes = std::fs::read(path).unwrap();
        let numbers = bytes.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap())).to_bits());
        return ([("raw".to_string(), (SHAPE.to_vec(), numbers.collect()))].into(), String::new());
    }
    let meta = if path.is_dir() { format!("{:?}", metadata(path)) } else { String::new() };
    (decode(path), meta)
}

fn volume() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("vol.npy"), "<u2", SHAPE, &u16_bytes(&mixed_u16(SHAPE)));
    dir
}

#[test]
fn openness_has_one_component_whatever_shapes_it() {
    let dir = volume();
    run(dir.path(), CONFIG, &[]);
    let (decoded, _) = one(&dir.path().join("out/coloured.npy"));
    assert!(decoded.values().all(|(shape, _)| *shape == SHAPE), "{:?}", decoded.values().next().map(|d| &d.0));
}

#[test]
fn bricks_threads_and_budgets_never_show() {
    let dir = volume();
    let first = results(dir.path(), &["run.brick=128", "run.threads=1"]);
    let variants: [&[&str]; 6] = [
        &["run.brick=8", "run.threads=2"],
        &["run.brick=[16, 24, 40]", "run.threads=3"],
        &["run.brick=[61, 8, 83]", "run.threads=2"],
        &["run.memory=64MiB", "run.threads=2"],
        &["run.memory=4GiB", "run.threads=5"],
        &["run.brick=[8, 80, 16]", "run.threads=1"],
    ];
    for sets in variants {
        let other = results(dir.path(), sets);
        for ((name, a), b) in OUTPUTS.iter().zip(&first).zip(&other) {
            assert_same(&format!("{name} with {sets:?}"), &a.0, &b.0);
            assert_eq!(a.1, b.1, "metadata of {name} with {sets:?}");
        }
    }
}

/// Volumes of a few voxels along an axis, whose tasks are long.
#[test]
fn bricks_of_thin_volumes_never_show() {
    const THIN: &str = "[input.vol]\npath = \"vol.npy\"\n[stage.stats]\nop = \"box\"\ninput = \"vol\"\nradius = 3\n[stage.ao]\n\
                        op = \"ambient_occlusion\"\ninput = \"vol\"\nradius = 4\nmethod = \"cdf_power\"\n[stage.sweep]\n\
                        op = \"obscurance\"\ninput = \"vol\"\ndirections = 12\nmax_distance = 6\n[stage.map]\n\
                        op = \"occlusion_map\"\ninput = \"vol\"\n[output.ao]\npath = \"out/ao.zarr\"\nfrom = \"ao\"\n\
                        chunk = 16\nshard = 64\n[output.variance]\npath = \"out/variance.npy\"\nfrom = \"stats.variance\"\n\
                        [output.sweep]\npath = \"out/sweep.zarr\"\nfrom = \"sweep\"\nreduce = \"stride\"\n[output.map]\n\
                        path = \"out/map.zarr\"\nfrom = \"map\"\n";
    for shape in [[1, 2, 12_000], [3, 120, 210], [3000, 5, 2]] {
        let dir = tempfile::tempdir().unwrap();
        write_npy(&dir.path().join("vol.npy"), "<u2", shape, &u16_bytes(&mixed_u16(shape)));
        let of = |sets: &[&str]| {
            run(dir.path(), THIN, sets);
            ["ao.zarr", "variance.npy", "sweep.zarr", "map.zarr"].map(|name| one(&dir.path().join("out").join(name)))
        };
        let first = of(&[]);
        for sets in
            [&["run.brick=[8, 8, 512]", "run.threads=3"][..], &["run.brick=[64, 64, 16]"], &["run.memory=64MiB"]]
        {
            for (a, b) in first.iter().zip(&of(sets)) {
                assert_same(&format!("{shape:?} with {sets:?}"), &a.0, &b.0);
                assert_eq!(a.1, b.1, "metadata of {shape:?} with {sets:?}");
            }
        }
    }
}

#[test]
fn a_chain_of_stages_is_the_chain_of_their_runs() {
    let dir = volume();
    run(dir.path(), CONFIG, &[]);
    let (whole, _) = one(&dir.path().join("out/again.zarr"));
    // What the chain reads at first, then one stage a run, on what the run before it has written.
    let input = |name: &str| format!("[input.{name}]\npath = '{name}.npy'\nspacing = [2, 1, 1]\n");
    let links: [(&[&str], &str, &str); 6] = [
        (&["vol"], "sweep", "op = 'obscurance'\ninput = 'vol'\ndirections = 12\nmax_distance = 9"),
        (&["vol"], "paint", "op = 'transfer'\ninput = 'vol'\npoints = [[0, 0, 1, 0, 0], [65535, 1, 0, 0, 1]]"),
        (&["sweep"], "windowed", "op = 'window'\ninput = 'sweep'\nlow = 0.3\nhigh = 0.9\nmode = 'stretch'"),
        (&["windowed"], "lines", "op = 'saliency'\ninput = 'windowed'"),
        (
            &["paint", "lines"],
            "strong",
            "op = 'opacity_modulation'\ninput = 'paint'\nby = 'lines'\nthreshold = 0.01\ngain = 5",
        ),
        (
            &["strong"],
            "again",
            "op = 'obscurance'\ninput = 'strong'\ndirections = 12\nmax_distance = 7\nweight_by_normal = true",
        ),
    ];
    for (inputs, name, stage) in links {
        let inputs: String = inputs.iter().map(|name| input(name)).collect();
        let out = format!("[output.o]\npath = '{name}.npy'\nfrom = '{name}_'\ndtype = 'f32'\n");
        run(dir.path(), &format!("{inputs}[stage.{name}_]\n{stage}\n{out}"), &[]);
    }
    for (component, name) in ["again", "lines", "strong"].into_iter().enumerate() {
        let alone = decode(&dir.path().join(format!("{name}.npy")));
        let (shape, values) = &alone["level 0 component 0"];
        assert!(values.iter().any(|v| *v != values[0]), "{name} says nothing");
        let (of, together) = &whole[&format!("level 0 component {component}")];
        assert!(shape == of && values == together, "{name} differs");
    }
}

#[test]
fn skipping_never_shows() {
    let dir = volume();
    let sets = ["run.brick=16", "run.threads=2"];
    let skipped = results(dir.path(), &sets);
    let config = parse(dir.path(), CONFIG, &sets);
    let options = occlude::run::RunOptions { overwrite: true, no_skip: true, ..Default::default() };
    run_with(&config, &options);
    for (name, a) in OUTPUTS.iter().zip(&skipped) {
        assert_same(name, &a.0, &one(&dir.path().join("out").join(name)).0);
    }
}

#[test]
fn a_region_is_that_part_of_the_whole() {
    let dir = volume();
    let whole = results(dir.path(), &["run.threads=2"]);
    let (lo, hi) = ([9, 21, 30], [50, 64, 83]);
    let part = results(dir.path(), &["run.threads=2", "run.region=[[9, 50], [21, 64], [30, 83]]", "run.brick=24"]);
    for ((name, a), b) in OUTPUTS.iter().zip(&whole).zip(&part) {
        // An occlusion map's first dataset is a level of the region's own chain.
        if *name == "map.zarr" {
            continue;
        }
        for (array, (_, values)) in b.0.iter().filter(|(k, _)| k.starts_with("level 0") || *k == "raw") {
            let mut i = 0;
            for z in lo[0]..hi[0] {
                for y in lo[1]..hi[1] {
                    for x in lo[2]..hi[2] {
                        let there = a.0[array].1[(z * SHAPE[1] + y) * SHAPE[2] + x];
                        assert_eq!(values[i], there, "{name} {array} at {:?} of the volume", [z, y, x]);
                        i += 1;
                    }
                }
            }
            assert_eq!(i, values.len());
        }
    }
}

#[test]
fn the_comparison_names_a_changed_voxel() {
    let a: Decoded = [("level 0".to_string(), (vec![2, 3, 4], vec![0u64; 24]))].into();
    let mut b = a.clone();
    assert_eq!(difference(&a, &b), None);
    b.get_mut("level 0").unwrap().1[17] = 1;
    assert!(difference(&a, &b).unwrap().contains("[1, 1, 1]"), "{:?}", difference(&a, &b));
}

/// The sign and the payload of a NaN hang on the instructions that made it; what is stored is one NaN, in flat files, too.
#[test]
fn missing_voxels_and_infinities_have_the_same_bytes_in_every_brick() {
    let dir = tempfile::tempdir().unwrap();
    let shape = [3, 20, 64];
    let mut values: Vec<f32> = (0..shape.iter().product::<usize>()).map(|i| (i % 37) as f32).collect();
    values[100..160].fill(f32::from_bits(0xffc0_0000));
    values[161] = f32::from_bits(0x7fc0_0123);
    (values[700], values[702]) = (f32::INFINITY, f32::NEG_INFINITY);
    write_npy(&dir.path().join("v.npy"), "<f4", shape, &f32_bytes(&values));
    let stages = [
        ("", "a"),
        ("[stage.s]\nop = 'box'\ninput = 'a'\nradius = [1, 1, 8]\n", "s.mean"),
        ("[stage.s]\nop = 'gaussian'\ninput = 'a'\nsigma = 1\n", "s.variance"),
        ("[stage.s]\nop = 'gradient'\ninput = 'a'\n", "s.magnitude"),
        ("[stage.s]\nop = 'combine'\ninputs = ['a', 'a']\nop_kind = 'add'\n", "s"),
    ];
    for (stage, from) in stages {
        let bytes = |brick: &str| {
            let text = format!(
                "[run]\nbrick = {brick}\n[input.a]\npath = 'v.npy'\n{stage}[output.o]\npath = 'o.npy'\nfrom = '{from}'\n"
            );
            run_with(
                &parse(dir.path(), &text, &[]),
                &occlude::run::RunOptions { overwrite: true, ..Default::default() },
            );
            std::fs::read(dir.path().join("o.npy")).unwrap()
        };
        let whole = bytes("64");
        for brick in ["[1, 1, 4]", "[3, 4, 16]"] {
            assert!(bytes(brick) == whole, "{from} in bricks of {brick}");
        }
    }
}

/// A `nodata` that the type cannot hold is nobody's value.
#[test]
fn a_nodata_beyond_the_type_leaves_the_value_range_alone() {
    let dir = tempfile::tempdir().unwrap();
    let shape = [32, 64, 64];
    let values = fill(shape, |z, y, x| if y < 32 && x < 32 { 0 } else { 50 + ((z + y * 3 + x * 7) % 50) as u8 });
    write_npy(&dir.path().join("v.npy"), "|u1", shape, &values);
    let codes = |brick: &str, no_skip: bool| {
        let text = format!(
            "[run]\nbrick = {brick}\n[input.a]\npath = 'v.npy'\nnodata = -1024\n[output.o]\npath = 'o.npy'\nfrom = 'a'\n\
             dtype = 'u8'\nrange = 'auto'\n"
        );
        let options = occlude::run::RunOptions { overwrite: true, no_skip, ..Default::default() };
        run_with(&parse(dir.path(), &text, &[]), &options);
        std::fs::read(dir.path().join("o.npy")).unwrap()
    };
    let whole = codes("32", false);
    assert_eq!(whole[whole.len() - 32 * 64 * 64], 0, "0 is a value like others");
    assert!(codes("32", true) == whole && codes("[32, 32, 64]", false) == whole);
}
