//! Runs whose steps stay on the GPU together: no brick shows, levels made there are the CPU's, and what the device leaves is
//! made one by one.

use std::path::Path;

use occlude::gpu::facts::tolerance;
use occlude::plan::Plan;
use occlude::run::RunOptions;

use super::common::{Decoded, assert_same, decode, parse, run_with};
use super::setup::{CPU, folder, folder_of, lane, place, plan, run_on};
use super::{adapter, setup};

const CONFIG: &str = r#"
[run]
threads = 2
brick = [16, 32, 32]
[input.vol]
path = "vol.npy"
[stage.bell]
op = "gaussian"
input = "vol"
sigma = 1.5
[stage.slope]
op = "gradient"
input = "bell.mean"
[output.slope]
path = "out/slope.zarr"
from = ["slope.magnitude", "slope.vector"]
chunk = 16
shard = 32
"#;

/// The same with windows in the place of the gradient.
fn with_windows() -> String {
    let stage = "op = \"box\"\nradius = [2, 3, 4]\ninput = \"bell.mean\"";
    let text = CONFIG.replacen("op = \"gradient\"\ninput = \"bell.mean\"", stage, 1);
    text.replacen("[\"slope.magnitude\", \"slope.vector\"]", "[\"slope.std\", \"slope.max\"]", 1)
}

/// Statistics, a table, modulation and light, with levels beyond those of a brick, of every kind and type; all that is not
/// openness is the CPU's bit for bit.
const LIT: &str = r#"
[run]
threads = 2
brick = [16, 32, 32]
[input.vol]
path = "bytes.npy"
[stage.stats]
op = "box"
input = "vol"
radius = [2, 3, 5]
[stage.tf]
op = "transfer"
input = "vol"
points = [[0, 0.0, 0.1, 0.2, 0.3], [80, 0.4, 0.9, 0.5, 0.0], [255, 1.0, 1.0, 0.8, 0.4]]
[stage.dim]
op = "opacity_modulation"
input = "tf.opacity"
by = "stats.variance"
sigma_max2 = 4600
[stage.cut]
op = "window"
input = "dim"
low = 0.1
high = 0.8
mode = "stretch"
[stage.light]
op = "ambient_light"
input = "cut"
rgb = "tf"
k = 0.9
[stage.both]
op = "combine"
op_kind = "mean"
inputs = ["stats.mean", "stats.max", "vol"]
[output.var]
path = "out/var.zarr"
from = "stats.variance"
reduce = "moments"
chunk = 4
shard = 8
[output.std]
path = "out/std.zarr"
from = "stats.std"
reduce = "moments"
dtype = "u16"
range = [0, 160]
chunk = 4
shard = 8
[output.least]
path = "out/least.zarr"
from = "stats.min"
reduce = "min"
chunk = 8
shard = "none"
[output.most]
path = "out/most.zarr"
from = "stats.max"
reduce = "max"
dtype = "u8"
range = "auto"
chunk = 8
[output.mean]
path = "out/mean.zarr"
from = "stats.mean"
reduce = "stride"
chunk = 8
[output.cut]
path = "out/cut.zarr"
from = "cut"
dtype = "u8"
range = [0, 1]
chunk = 8
[output.light]
path = "out/light.zarr"
from = "light"
chunk = 8
[output.both]
path = "out/both.npy"
from = "both"
"#;
const LIT_OUTPUTS: [&str; 7] = ["var", "std", "least", "most", "mean", "cut", "light"];

fn run(dir: &Path, text: &str, sets: &[&str]) -> Decoded {
    run_on(dir, text, &[&[lane()], sets].concat());
    decode(&dir.join("out/slope.zarr"))
}

/// The stages of each flow.
fn flows(dir: &Path, text: &str) -> Vec<String> {
    setup::flows(&plan(dir, text, &[]))
}

#[test]
fn a_run_keeps_means_on_the_gpu_and_shows_no_brick() {
    let Some(_) = adapter() else { return };
    let shape = [30, 40, 50];
    let dir = folder(shape);
    for text in [CONFIG.to_string(), with_windows()] {
        assert_eq!(flows(dir.path(), &text), ["bell slope"]);
        let all = run(dir.path(), &text, &[]);
        assert_same("other bricks", &all, &run(dir.path(), &text, &["run.brick=[32, 16, 64]"]));
        assert_same("a little memory", &all, &run(dir.path(), &text, &["run.memory='40MiB'", "run.brick='auto'"]));
        // Somebody reads the means, a kernel of the CPU among them: they come back, and the rest is the same.
        let read = format!(
            "{text}[output.bell]\npath = \"out/bell.zarr\"\nfrom = \"bell.mean\"\nchunk = 16\n[stage.rank]\n\
             op = \"ambient_occlusion\"\nmethod = \"exact\"\nradius = 2\ninput = \"bell.mean\"\n[output.rank]\n\
             path = \"out/rank.zarr\"\nfrom = \"rank\"\nchunk = 16\n"
        );
        assert_eq!(flows(dir.path(), &read), ["bell slope"]);
        assert_same("means come back", &all, &run(dir.path(), &read, &[]));
    }
    let all = run(dir.path(), CONFIG, &[]);
    let cpu = folder(shape);
    run_on(cpu.path(), CONFIG, &[CPU]);
    let bound = tolerance::GRADIENT * 65535.0;
    for ((name, (_, a)), (_, b)) in all.iter().zip(decode(&cpu.path().join("out/slope.zarr")).values()) {
        let far = a.iter().zip(b).find(|(a, b)| (f64::from_bits(**a) - f64::from_bits(**b)).abs() > bound);
        assert!(far.is_none() && a.len() == b.len(), "{name}: {far:?}");
    }
}

#[test]
fn statistics_light_and_levels_of_every_kind_equal_the_cpus() {
    let Some(_) = adapter() else { return };
    let shape = [30, 40, 50];
    let [cpu, gpu] = [0, 1].map(|_| folder(shape));
    let joined = flows(gpu.path(), LIT);
    assert_eq!(joined, ["stats tf dim cut light both"]);
    run_on(cpu.path(), LIT, &[CPU]);
    let same = |what: &str| {
        for name in LIT_OUTPUTS {
            let [a, b] = [&cpu, &gpu].map(|d| decode(&d.path().join(format!("out/{name}.zarr"))));
            assert!(a.len() >= 3, "{name} has levels");
            assert_same(&format!("{what}: {name}"), &a, &b);
        }
        let [a, b] = [&cpu, &gpu].map(|d| std::fs::read(d.path().join("out/both.npy")).unwrap());
        assert!(a == b, "{what}: both.npy");
    };
    run_on(gpu.path(), LIT, &[lane()]);
    same("bricks as given");
    run_on(gpu.path(), LIT, &[lane(), "run.memory='48MiB'", "run.brick='auto'", "run.threads=4"]);
    same("a little memory");
}

#[test]
fn plans_say_what_runs_together_and_what_comes_back() {
    let shape = [30, 40, 50];
    let dir = folder(shape);
    let plan = plan(dir.path(), LIT, &[]);
    assert_eq!(place(&plan, "tf"), ("gpu", occlude::plan::flows::BESIDE));
    assert!(plan.flows.iter().all(|f| f.steps.iter().all(|&s| plan.on_gpu(s))));
    let back = |plan: &Plan| {
        let wires = 0..plan.graph.wires.len();
        let back = |w: &usize| occlude::plan::flows::voxels_come_back(plan, &plan.flows[0], &plan.groups[0], *w);
        wires.filter(back).map(|w| plan.graph.wires[w].name.clone()).collect::<Vec<_>>()
    };
    let made = |plan: &Plan| back(plan).into_iter().filter(|n| n != "vol").collect::<Vec<_>>();
    assert_eq!(made(&plan), Vec::<String>::new(), "levels and codes only");
    let rank = "[stage.rank]\nop = \"ambient_occlusion\"\nmethod = \"exact\"\nradius = 2\ninput = \"stats.mean\"\n\
                [output.rank]\npath = \"out/rank.zarr\"\nfrom = \"rank\"\n";
    let read = self::plan(dir.path(), &format!("{LIT}{rank}"), &[]);
    assert_eq!(made(&read), ["stats.mean"], "a step of the CPU reads them");
    // Without anything beside it a table stays on the CPU.
    let alone = "[input.vol]\npath = \"vol.npy\"\n[stage.tf]\nop = \"transfer\"\ninput = \"vol\"\n\
                 points = [[0, 0, 0, 0, 0], [9, 1, 1, 1, 1]]\n[output.o]\npath = \"out/o.zarr\"\nfrom = \"tf.opacity\"\n";
    let plan = self::plan(dir.path(), alone, &[]);
    assert!(plan.flows.is_empty() && plan.placement[0].lane == occlude::plan::Lane::Cpu);
    assert_eq!(plan.placement[0].why, occlude::plan::flows::ALONE);
}

#[test]
fn bricks_that_the_device_leaves_and_constant_ones_run_one_by_one() {
    let Some(_) = adapter() else { return };
    let shape = [20, 20, 70];
    // One voxel in a void: far from it means are as small as f32 goes.
    let mut voxels = vec![0u16; shape.iter().product()];
    voxels[10 * 20 * 70 + 10 * 70 + 9] = 1;
    let dir = folder_of(&voxels, shape);
    let narrow = ["stage.bell.sigma=[0.2, 0.2, 0.2]", "run.brick=[16, 16, 16]"];
    let all = run(dir.path(), CONFIG, &narrow);
    assert_same("no skipping", &all, &{
        let sets = [&[lane()], &narrow[..]].concat();
        let options = RunOptions { overwrite: true, no_skip: true, ..Default::default() };
        run_with(&parse(dir.path(), CONFIG, &sets), &options);
        decode(&dir.path().join("out/slope.zarr"))
    });
    assert_same("one brick", &all, &run(dir.path(), CONFIG, &["stage.bell.sigma=[0.2, 0.2, 0.2]"]));
    assert!(all.values().any(|(_, v)| v.iter().any(|b| f64::from_bits(*b) > 1e-3)));
}

#[test]
fn missing_voxels_and_masks_of_what_is_made_keep_steps_apart() {
    let shape = [6, 7, 8];
    let dir = folder(shape);
    for (from, to, left) in [
        ("path = \"vol.npy\"", "path = \"vol.npy\"\nnodata = 7", &["slope"][..]),
        ("sigma = 1.5", "sigma = 1.5\nwhere = { input = \"vol\", min = 9 }", &["bell slope"]),
        ("input = \"bell.mean\"", "input = \"bell.mean\"\nwhere = { input = \"vol\", min = 9 }", &["bell slope"]),
        ("input = \"bell.mean\"", "input = \"bell.mean\"\nwhere = { input = \"bell.mean\", min = 9 }", &["bell"]),
        ("sigma = 1.5", "sigma = 1.5\nborder = \"reflect\"", &["bell slope"]),
    ] {
        let text = CONFIG.replacen(from, to, 1);
        assert_ne!(text, CONFIG);
        assert_eq!(flows(dir.path(), &text), left, "{to}");
    }
    // Beyond the edge of the volume a window sees means that the border's rule makes of means, there.
    let mirrored = with_windows().replacen("radius =", "border = \"reflect\"\nradius =", 1);
    assert_eq!(flows(dir.path(), &mirrored), ["bell slope"]);
    // A constant that the type cannot hold makes floats of the voxels.
    let constant = CONFIG.replacen("sigma = 1.5", "sigma = 1.5\nborder = { constant = 0.5 }", 1);
    assert_eq!(flows(dir.path(), &constant), ["slope"]);
}

/// Steps of every border over one input and over what is made of it.
const BORDERS: &str = r#"
[run]
threads = 2
brick = [16, 32, 32]
[input.vol]
path = "vol.npy"
[stage.plain]
op = "box"
input = "vol"
radius = [2, 3, 5]
[stage.mirrored]
op = "box"
input = "vol"
radius = [4, 4, 9]
border = "reflect"
[stage.walled]
op = "box"
input = "vol"
radius = 3
border = { constant = 900 }
where = { input = "vol", min = 3000 }
[stage.held]
op = "gaussian"
input = "vol"
sigma = 1.2
border = "nearest"
[stage.sum]
op = "combine"
op_kind = "add"
inputs = ["plain.mean", "mirrored.mean", "walled.max"]
[output.sum]
path = "out/sum.zarr"
from = "sum"
chunk = 8
[output.var]
path = "out/var.zarr"
from = "mirrored.variance"
chunk = 8
[output.held]
path = "out/held.zarr"
from = "held.mean"
chunk = 8
"#;

#[test]
fn steps_of_every_border_run_in_one_go_and_equal_the_cpus() {
    let shape = [30, 40, 50];
    let [cpu, gpu] = [0, 1].map(|_| folder(shape));
    assert_eq!(flows(gpu.path(), BORDERS), ["plain mirrored walled held sum"]);
    let Some(_) = adapter() else { return };
    run_on(cpu.path(), BORDERS, &[CPU]);
    for (what, sets) in [
        ("bricks as given", &[lane()][..]),
        ("a little memory", &[lane(), "run.memory='48MiB'", "run.brick='auto'", "run.threads=4"]),
    ] {
        let report = run_on(gpu.path(), BORDERS, sets);
        let row = report.stages.iter().find_map(|s| s.together.clone()).unwrap();
        assert!(row.bricks > 1 && row.bricks_left == 0, "{what}: {row:?}");
        for name in ["sum", "var", "held"] {
            let [a, b] = [&cpu, &gpu].map(|d| decode(&d.path().join(format!("out/{name}.zarr"))));
            assert_same(&format!("{what}: {name}"), &a, &b);
        }
    }
}
