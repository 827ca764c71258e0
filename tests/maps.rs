//! Occlusion maps of what stages make: the map of a stage is the map of what the stage writes.

mod common;

use common::*;

const SHAPE: [usize; 3] = [43, 38, 61];

/// Stages by what they add to a config, the last of which is `s`, and the channel that the map is made of.
const STAGES: [(&str, &str); 11] = [
    ("[stage.s]\nop = 'box'\ninput = 'vol'\nradius = [1, 2, 3]", "s.mean"),
    ("[stage.s]\nop = 'box'\ninput = 'vol'\nradius = 2", "s.max"),
    ("[stage.s]\nop = 'box'\ninput = 'vol'\nradius = 2\nborder = 'reflect'", "s.variance"),
    ("[stage.s]\nop = 'gaussian'\ninput = 'vol'\nsigma = 1.2", "s"),
    ("[stage.s]\nop = 'gradient'\ninput = 'vol'", "s.magnitude"),
    ("[stage.s]\nop = 'transfer'\ninput = 'vol'\npoints = [[0, 0, 1, 0, 0], [50000, 1, 0, 0, 1]]", "s.opacity"),
    ("[stage.s]\nop = 'obscurance'\ninput = 'vol'\ndirections = 12\nmax_distance = 7", "s"),
    ("[stage.s]\nop = 'ambient_occlusion'\ninput = 'vol'\nmethod = 'exact'\nradius = 2", "s"),
    (
        "[stage.s]\nop = 'ambient_occlusion'\ninput = 'vol'\nmethod = 'cdf_power'\nradius = 2\n\
         where = { input = 'vol', min = 30000 }\nfill = 0.25",
        "s",
    ),
    ("[stage.s]\nop = 'saliency'\ninput = 'vol'\nscale = 'max'", "s"),
    (
        "[stage.first]\nop = 'box'\ninput = 'vol'\nradius = 1\n[stage.sweep]\nop = 'obscurance'\ninput = 'first'\n\
         directions = 12\nmax_distance = 5\n[stage.s]\nop = 'combine'\nop_kind = 'multiply'\ninputs = ['sweep', 'first']",
        "s",
    ),
];

fn maps(from: &str) -> String {
    let map = |name: &str, level: usize, channels: &str| {
        format!(
            "[stage.{name}]\nop = 'occlusion_map'\ninput = '{from}'\nstart_level = {level}\n[output.{name}]\n\
             path = '{name}.zarr'\nfrom = {channels}\nchunk = 8\nshard = 16\n"
        )
    };
    map("whole", 0, "['whole.mean', 'whole.variance']") + &map("half", 1, "'half.variance'")
}

fn made(dir: &std::path::Path) -> [Decoded; 2] {
    ["whole.zarr", "half.zarr"].map(|name| decode(&dir.join(name)))
}

#[test]
fn the_map_of_a_stage_is_the_map_of_what_it_writes() {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("vol.npy"), "<u2", SHAPE, &u16_bytes(&mixed_u16(SHAPE)));
    let vol = "[input.vol]\npath = 'vol.npy'\n";
    for (stages, channel) in STAGES {
        let dtype = if channel == "s.max" { "native" } else { "f32" };
        let written = format!("{vol}{stages}\n[output.o]\npath = 'o.npy'\nfrom = '{channel}'\ndtype = '{dtype}'\n");
        run(dir.path(), &written, &[]);
        run(dir.path(), &format!("[input.o]\npath = 'o.npy'\n{}", maps("o")), &[]);
        let expected = made(dir.path());
        let values = &expected[0]["level 0 component 0"].1;
        assert!(values.iter().any(|v| *v != values[0]), "{channel} says nothing");
        let text = format!("{vol}{stages}\n{}", maps(channel));
        for sets in [&["run.brick=128"][..], &["run.brick=8", "run.threads=3"], &["run.brick=[40, 16, 24]"]] {
            run(dir.path(), &text, sets);
            for (a, b) in made(dir.path()).iter().zip(&expected) {
                assert_same(&format!("{stages} with {sets:?}"), a, b);
            }
        }
        let options = occlude::run::RunOptions { overwrite: true, no_skip: true, ..Default::default() };
        run_with(&parse(dir.path(), &text, &["run.brick=16"]), &options);
        for (a, b) in made(dir.path()).iter().zip(&expected) {
            assert_same(&format!("{stages} without skipping"), a, b);
        }
    }
}

/// A stage that is an output as well, and one that a map shares with another stage.
#[test]
fn what_a_map_is_made_of_may_be_wanted_by_others() {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("vol.npy"), "<u2", SHAPE, &u16_bytes(&mixed_u16(SHAPE)));
    let stages = "[input.vol]\npath = 'vol.npy'\n[stage.s]\nop = 'gaussian'\ninput = 'vol'\nsigma = 1\n[stage.t]\n\
                  op = 'box'\ninput = 's'\nradius = 4\n";
    let others = "[output.s]\npath = 's.npy'\nfrom = 's'\n[output.t]\npath = 't.zarr'\nfrom = 't.std'\n";
    run(dir.path(), &format!("{stages}{}", maps("s")), &[]);
    let map = made(dir.path());
    run(dir.path(), &format!("{stages}{others}"), &[]);
    let files = || ["s.npy", "t.zarr"].map(|name| decode(&dir.path().join(name)));
    let alone = files();
    for sets in [&["run.brick=8"][..], &["run.threads=1"], &["run.brick=[48, 8, 32]"]] {
        run(dir.path(), &format!("{stages}{others}{}", maps("s")), sets);
        for (a, b) in made(dir.path()).iter().chain(&files()).zip(map.iter().chain(&alone)) {
            assert_same(&format!("{sets:?}"), a, b);
        }
    }
}
