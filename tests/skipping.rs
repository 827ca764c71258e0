//! Unneeded work is not done (SPEC 5.5), and it is counted why; nothing is decoded twice.

mod common;

use std::path::Path;

use common::*;
use occlude::run::Report;

fn skipped(report: &Report, cause: &str) -> u64 {
    report.bricks.skipped.get(cause).copied().unwrap_or(0)
}

/// A cube of noise in the middle of zeros.
fn island(dir: &Path) {
    let shape = [96, 96, 96];
    let inside = |i: usize| (40..56).contains(&i);
    let v = fill(shape, |z, y, x| {
        if inside(z) && inside(y) && inside(x) {
            (hash(1, ((z * 96 + y) * 96 + x) as u64) % 60000) as u16 + 1
        } else {
            0
        }
    });
    write_npy(&dir.join("vol.npy"), "<u2", shape, &u16_bytes(&v));
}

const STAGE: &str = "[stage.s]\nop = 'box'\ninput = 'a'\nradius = 2\n[output.o]\npath = 'o.zarr'\nfrom = 's.mean'\nchunk = 16\nshard = 32\n";

#[test]
fn constant_bricks_are_skipped_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text = format!("[run]\nbrick = 16\n[input.a]\npath = 'vol.npy'\n{STAGE}");
    let report = run(dir.path(), &text, &[]);
    // 6^3 bricks; those whose window touches the island (38..58) are bricks 2 and 3 of each axis.
    assert_eq!(report.bricks.total, 216);
    assert_eq!(report.bricks.computed, 8);
    assert_eq!(skipped(&report, "constant"), 208);
}

#[test]
fn missing_chunks_are_not_decoded_and_present_ones_once() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let store =
        "[input.a]\npath = 'vol.npy'\n[output.o]\npath = 'in.zarr'\nfrom = 'a'\nchunk = 16\nshard = 32\nlevels = 1\n";
    run(dir.path(), store, &[]);
    let text = format!("[run]\nbrick = 16\nthreads = 2\n[input.a]\npath = 'in.zarr'\n{STAGE}");
    let report = run(dir.path(), &text, &[]);
    assert_eq!(report.bricks.computed, 8);
    // Bricks 1 and 4 of an axis see zeros of chunks that are stored: constant, not missing.
    assert_eq!(skipped(&report, "missing_chunk"), 216 - 64);
    assert_eq!(skipped(&report, "constant"), 64 - 8);
    let stored: u64 = shards(&dir.path().join("in.zarr/0/c"));
    assert!(report.bytes_read <= stored, "{} bytes read of {stored} stored", report.bytes_read);
    let full = run(dir.path(), &text.replace("radius = 2", "radius = 20"), &[]);
    assert!(full.bytes_read <= stored, "halos decode nothing twice: {} of {stored}", full.bytes_read);
    assert!(full.read_amplification > 5.0, "{}", full.read_amplification);
}

fn shards(dir: &Path) -> u64 {
    let entries = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap());
    entries.map(|e| if e.path().is_dir() { shards(&e.path()) } else { e.metadata().unwrap().len() }).sum()
}

#[test]
fn what_no_mask_needs_is_not_read() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    // A second volume, as large, that only the masked stage reads.
    let other = fill([96, 96, 96], |z, y, x| hash(2, ((z * 96 + y) * 96 + x) as u64) as u8);
    write_npy(&dir.path().join("other.npy"), "|u1", [96, 96, 96], &other);
    let text = "[run]\nbrick = 16\n[input.a]\npath = 'vol.npy'\n[input.b]\npath = 'other.npy'\n[stage.s]\nop = 'box'\ninput = 'b'\n\
                radius = 1\nwhere = { input = 'a', min = 1 }\n[output.o]\npath = 'o.zarr'\nfrom = 's.mean'\nchunk = 16\n";
    let report = run(dir.path(), text, &[]);
    assert_eq!(skipped(&report, "where"), 216 - 8);
    assert_eq!(report.bricks.computed, 8);
    // The mask's input whole (2 bytes a voxel), of the other only eight bricks with their halos.
    assert!(report.bytes_read <= 96 * 96 * 96 * 2 + 8 * 18 * 18 * 18, "{}", report.bytes_read);
}

#[test]
fn bricks_outside_the_region_are_not_visited() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text =
        format!("[run]\nbrick = 16\nregion = [[32, 64], [32, 64], [0, 16]]\n[input.a]\npath = 'vol.npy'\n{STAGE}");
    assert_eq!(run(dir.path(), &text, &[]).bricks.total, 4);
}

#[test]
fn channels_that_nobody_reads_are_not_planned() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text = format!(
        "[input.a]\npath = 'vol.npy'\n[stage.unused]\nop = 'obscurance'\ninput = 'a'\n[stage.again]\nop = 'ambient_occlusion'\n\
         input = 'a'\nmethod = 'cdf_power'\nradius = 2\n{STAGE}[output.p]\npath = 'p.zarr'\nfrom = 'again'\n"
    );
    let (text, plan) = occlude::plan::explain(&parse(dir.path(), &text, &[])).unwrap();
    let steps = plan["steps"].as_array().unwrap();
    assert_eq!(steps.len(), 1, "one pass serves both stages: {text}");
    assert_eq!(steps[0]["makes"], "again.openness, s.mean".to_string().as_str(), "{text}");
}

#[test]
fn obscurance_keeps_its_channels_apart_from_colours_and_normals() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text = "[input.a]\npath = 'vol.npy'\n[stage.tf]\nop = 'transfer'\ninput = 'a'\npoints = [[0, 0, 0, 0, 0], [9, 1, 1, 1, 1]]\n\
                [stage.o]\nop = 'obscurance'\ninput = 'a'\ndirections = 12\nmax_distance = 4\ncolour = 'tf.rgb'\n";
    let open = "[output.o]\npath = 'o.zarr'\nfrom = 'o'\n";
    let (_, plan) = occlude::plan::explain(&parse(dir.path(), &format!("{text}{open}"), &[])).unwrap();
    assert_eq!(plan["steps"].as_array().unwrap().len(), 1, "nobody reads rgb, so no colour is made: {plan}");

    let both = format!("{text}weight_by_normal = true\n{open}[output.c]\npath = 'c.zarr'\nfrom = 'o.rgb'\n");
    run(dir.path(), &both, &["run.region=[[40, 56], [40, 56], [40, 56]]"]);
    let parts = |name: &str| decode(&dir.path().join(name)).keys().filter(|k| k.starts_with("level 0")).count();
    assert_eq!((parts("o.zarr"), parts("c.zarr")), (1, 3));
}

#[test]
fn a_sweep_of_opacities_ranks_the_table_instead_of_the_voxels() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text = "[input.a]\npath = 'vol.npy'\n[stage.tf]\nop = 'transfer'\ninput = 'a'\npoints = [[0, 0, 0, 0, 0], [9, 1, 1, 1, 1]]\n\
                [stage.o]\nop = 'obscurance'\ninput = 'tf'\ndirections = 12\nmax_distance = 4\n";
    let of = |text: &str, from: &str| {
        let text = format!("{text}\n[output.o]\npath = 'o.zarr'\nfrom = '{from}'\n");
        let (_, plan) = occlude::plan::explain(&parse(dir.path(), &text, &[])).unwrap();
        let steps = plan["steps"].as_array().unwrap();
        steps.iter().map(|s| format!("{} of {}", s["makes"], s["reads"]).replace('"', "")).collect::<Vec<_>>()
    };
    assert_eq!(of(text, "o"), ["o.openness of a"]);
    assert_eq!(of(&format!("{text}colour = 'tf.rgb'"), "o.rgb"), ["tf.rgb of a", "o.rgb of a, tf.rgb"]);
    // The normal is that of the opacity, and a table under a mask is no function of the voxel.
    assert_eq!(of(&format!("{text}weight_by_normal = true"), "o").len(), 3);
    let masked = text.replace("op = 'transfer'", "op = 'transfer'\nwhere = { input = 'a', min = 3 }");
    assert_eq!(of(&masked, "o"), ["tf.opacity of a, a", "o.openness of tf.opacity"]);
}

#[test]
fn lines_without_needed_voxels_are_not_searched_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    let text = "[run]\ndevice = 'cpu'\n[input.a]\npath = 'vol.npy'\n[stage.s]\nop = 'obscurance'\ninput = 'a'\ndirections = 12\n\
                max_distance = 20\nwhere = { input = 'a', iso = [1], band = 2.0 }\n[output.o]\npath = 'o.zarr'\nfrom = 's'\n\
                dtype = 'f32'\n";
    let report = run(dir.path(), text, &[]);
    let core = report.stages[0].core_seconds.expect("a stage on the CPU");
    assert!(core > 0.0, "{core}");
    let lines = &report.stages[0].lines;
    assert!(lines["where"] > 0, "{lines:?}");
    assert!(lines["where"] + lines["open"] < lines["total"], "{lines:?}");
    let skipped = decode(&dir.path().join("o.zarr"));
    let config = parse(dir.path(), text, &[]);
    let plain = occlude::run::RunOptions { overwrite: true, no_skip: true, ..Default::default() };
    let report = run_with(&config, &plain);
    assert_eq!(report.stages[0].lines["where"], 0);
    assert_same("with and without skipping", &skipped, &decode(&dir.path().join("o.zarr")));
    // A mask that leaves a stage that sweeps without one alone.
    let unmasked = run(dir.path(), &text.replace("where =", "#"), &[]);
    assert_eq!(unmasked.stages[0].lines["where"], 0);
}

#[test]
fn the_plan_knows_what_will_be_skipped_for_missing_chunks_and_impossible_masks() {
    let dir = tempfile::tempdir().unwrap();
    island(dir.path());
    // A pyramid of the island alone: chunks of zeros are not stored, in shards or as files.
    for shard in ["32", "'none'"] {
        let text = format!(
            "[input.a]\npath = 'vol.npy'\n[output.z]\npath = 'z.zarr'\nfrom = 'a'\nchunk = 16\nshard = {shard}\n"
        );
        run(dir.path(), &text, &[]);
        for (body, cause) in [
            ("", "missing_chunk"),
            ("where = { input = 'a', min = 1 }\n", "where"),
            ("where = { input = 'a', iso = [0.5], band = 1.0 }\n", "where"),
            ("where = { input = 'a', min = 70000 }\n", "where"),
        ] {
            let text = format!(
                "[run]\nbrick = 16\n[input.a]\npath = 'z.zarr'\n[stage.s]\nop = 'box'\ninput = 'a'\nradius = 1\n{body}\
                 [output.o]\npath = 'o.zarr'\nfrom = 's.mean'\nchunk = 16\n"
            );
            let (said, plan) = occlude::plan::explain(&parse(dir.path(), &text, &[])).unwrap();
            let report = run(dir.path(), &text, &[]);
            let known = plan["groups"][0]["skippable"]["causes"][cause].as_u64().unwrap();
            // The band of an isosurface reaches over the chunks' edges, where only voxels tell.
            let (run, all) = (skipped(&report, cause), !body.contains("iso"));
            assert!(known > 0 && known <= run && (!all || known == run), "{body}: {:?} {said}", report.bricks.skipped);
            let share = plan["skippable_share"].as_f64().unwrap();
            assert_eq!(share, known as f64 / report.bricks.total as f64, "{said}");
            assert!(said.contains(&format!("skipped without reading: {known} of 216 bricks")), "{said}");
        }
    }
    let text = format!("[run]\nregion = [[0, 96], [0, 48], [0, 96]]\n[input.a]\npath = 'vol.npy'\n{STAGE}");
    let (said, plan) = occlude::plan::explain(&parse(dir.path(), &text, &[])).unwrap();
    assert_eq!(plan["groups"][0]["skippable"]["outside_region"], 0.5);
    assert!(said.contains("50.0 % of the volume"), "{said}");
}

#[test]
fn flat_chunks_that_the_cache_cannot_hold_are_decoded_once_into_scratch() {
    let dir = tempfile::tempdir().unwrap();
    // Noise above planes of zeros, whose chunks are not stored.
    let shape = [70, 250, 260];
    let v = fill(shape, |z, y, x| if z < 20 { 0 } else { hash(3, ((z * 250 + y) * 260 + x) as u64) as u16 });
    write_npy(&dir.path().join("vol.npy"), "<u2", shape, &u16_bytes(&v));
    let stage = "[stage.s]\nop = 'box'\ninput = 'a'\nradius = 2\n[output.o]\npath = 'o.npy'\nfrom = 's.variance'\n";
    run(dir.path(), &format!("[input.a]\npath = 'vol.npy'\n{stage}"), &[]);
    let expected = decode(&dir.path().join("o.npy"));
    for chunk in ["[1, 250, 260]", "[1, 128, 260]", "[2, 100, 130]"] {
        let planes = format!(
            "[input.a]\npath = 'vol.npy'\n[output.z]\npath = 'z.zarr'\nfrom = 'a'\nlevels = 1\nchunk = {chunk}\nshard = 'none'\n"
        );
        run(dir.path(), &planes, &[]);
        let text = format!("[run]\nmemory = '32MiB'\nthreads = 1\nbrick = 32\n[input.a]\npath = 'z.zarr'\n{stage}");
        let flat = chunk.starts_with("[1");
        let (_, plan) = occlude::plan::explain(&parse(dir.path(), &text, &[])).unwrap();
        assert_eq!(plan["scratch_bytes"].as_u64().unwrap() > 0, flat, "{chunk}");
        run(dir.path(), &text, &[]);
        assert_same(chunk, &expected, &decode(&dir.path().join("o.npy")));
        let (_, plan) = occlude::plan::explain(&parse(dir.path(), &text, &["run.memory='2GiB'"])).unwrap();
        assert_eq!(plan["scratch_bytes"], 0, "a large budget holds the stack of {chunk}");
    }
}

/// A pre-pass sees the whole volume, in bricks that fit it and not the region.
#[test]
fn a_small_region_does_not_make_a_prepass_dear() {
    let dir = tempfile::tempdir().unwrap();
    let shape = [96, 96, 96];
    write_npy(&dir.path().join("v.npy"), "<u2", shape, &u16_bytes(&mixed_u16(shape)));
    let text = "run.region = [[40, 48], [40, 48], [40, 48]]\n[input.v]\npath = 'v.npy'\n[stage.s]\nop = 'box'\ninput = 'v'\nradius = 10\n\
                [output.o]\npath = 'o.npy'\nfrom = 's.mean'\ndtype = 'u8'\nrange = 'auto'\n";
    let report = run(dir.path(), text, &[]);
    let file = 2 * 96u64.pow(3);
    assert!(report.bytes_read < 3 * file, "{} bytes of a file of {file}", report.bytes_read);
    let whole = run(dir.path(), text, &["run.region=all", "output.o.path=w.npy"]);
    assert_eq!(whole.bricks.total, whole.bricks.computed);
    let values = |name: &str| decode(&dir.path().join(name)).into_values().next().expect("a level").1;
    let (part, all) = (values("o.npy"), values("w.npy"));
    for (i, v) in part.iter().enumerate() {
        let [z, y, x] = [i / 64, i / 8 % 8, i % 8].map(|c| 40 + c);
        assert_eq!(*v, all[(z * 96 + y) * 96 + x], "{z} {y} {x}");
    }
}

/// A mask leaves parts of bricks out: kernels run on boxes around the rest, and nobody sees which.
#[test]
fn kernels_run_on_boxes_around_what_is_needed_and_the_result_does_not_show_it() {
    let dir = tempfile::tempdir().unwrap();
    let shape = [70, 90, 200];
    // Noise everywhere, and a mask of two far balls, a plane and single voxels.
    let noise = |z: usize, y: usize, x: usize| (hash(3, ((z * 90 + y) * 200 + x) as u64) % 997) as u16;
    let near = |a: [i64; 3], z: usize, y: usize, x: usize, r: i64| {
        [z, y, x].iter().zip(a).map(|(p, c)| (*p as i64 - c).pow(2)).sum::<i64>() <= r * r
    };
    let mask = fill(shape, |z, y, x| {
        let ball = near([12, 20, 30], z, y, x, 9) || near([60, 70, 180], z, y, x, 7);
        u16::from(ball || (z == 40 && y > 60) || hash(9, ((z * 90 + y) * 200 + x) as u64).is_multiple_of(40_000))
    });
    let values = fill(shape, noise);
    write_npy(&dir.path().join("m.npy"), "<u2", shape, &u16_bytes(&mask));
    write_npy(&dir.path().join("u2.npy"), "<u2", shape, &u16_bytes(&values));
    let bytes: Vec<u8> = values.iter().map(|v| (v % 251) as u8).collect();
    write_npy(&dir.path().join("u1.npy"), "|u1", shape, &bytes);
    let floats: Vec<f32> = values.iter().map(|&v| if v == 7 { f32::NAN } else { f32::from(v) * 0.37 }).collect();
    write_npy(&dir.path().join("f4.npy"), "<f4", shape, &f32_bytes(&floats));
    let wide: Vec<u8> = floats.iter().flat_map(|v| f64::from(*v).to_le_bytes()).collect();
    write_npy(&dir.path().join("f8.npy"), "<f8", shape, &wide);
    let stages = [
        ("op='box'\nradius=[2, 3, 5]", "variance"),
        ("op='box'\nradius=3\nborder='reflect'", "max"),
        ("op='ambient_occlusion'\nmethod='cdf_power'\nradius=4", "openness"),
        ("op='ambient_occlusion'\nmethod='gaussian_cdf'\nradius=3\nborder={ constant = 5.0 }", "openness"),
        ("op='ambient_occlusion'\nmethod='exact'\nradius=3", "openness"),
        ("op='ambient_occlusion'\nmethod='exact'\nradius=5\nregion='ball'", "openness"),
        ("op='ambient_occlusion'\nmethod='exact'\nradius=[2, 12, 12]", "openness"),
        ("op='ambient_occlusion'\nmethod='levels'\nradius=4", "openness"),
        ("op='ambient_occlusion'\nmethod='moments4'\nradius=4", "lower"),
        ("op='gaussian'\nsigma=1.5", "variance"),
        ("op='gradient'\nsize=5", "vector"),
    ];
    let afresh = occlude::run::RunOptions { overwrite: true, ..Default::default() };
    let plain = occlude::run::RunOptions { no_skip: true, ..afresh.clone() };
    for input in ["u1", "u2", "f4", "f8"] {
        for (stage, channel) in stages {
            let text = format!(
                "[run]\nthreads = 2\n[input.a]\npath = '{input}.npy'\n[input.m]\npath = 'm.npy'\n[stage.s]\n{stage}\n\
                 input = 'a'\nwhere = {{ input = 'm', min = 1 }}\n[output.o]\npath = 'o.npy'\nfrom = 's.{channel}'\n"
            );
            let config = parse(dir.path(), &text, &[]);
            run_with(&config, &afresh);
            let boxes = decode(&dir.path().join("o.npy"));
            run_with(&config, &plain);
            assert_same(&format!("{input} {stage}"), &decode(&dir.path().join("o.npy")), &boxes);
        }
    }
}

/// Bricks of one value are one value in every level of an occlusion map; nobody sees that they were not computed.
#[test]
fn constant_bricks_of_occlusion_maps_are_not_computed() {
    let dir = tempfile::tempdir().unwrap();
    let shape = [96, 90, 131];
    let island = |z: usize, y: usize, x: usize| z < 40 && y > 50 && x > 80;
    for (value, nodata) in [(0u16, None), (77, None), (9, Some(9))] {
        let voxel = |z, y, x| if island(z, y, x) { 1000 + ((z * 7 + y * 31 + x * 3) % 5000) as u16 } else { value };
        write_npy(&dir.path().join("vol.npy"), "<u2", shape, &u16_bytes(&fill(shape, voxel)));
        let nodata = nodata.map_or(String::new(), |n: i32| format!("nodata = {n}\n"));
        for (from, dtype) in [("map.mean", "'u8'\nrange = [0, 6000]"), ("map.variance", "'f32'")] {
            let text = format!(
                "[run]\nbrick = 16\n[input.a]\npath = 'vol.npy'\nslope = 0.3\nintercept = 0.1\n{nodata}[stage.map]\n\
                 op = 'occlusion_map'\ninput = 'a'\nstart_level = 0\n[output.o]\npath = 'o.zarr'\nfrom = '{from}'\n\
                 dtype = {dtype}\nchunk = 16\nshard = 32\n"
            );
            let afresh = occlude::run::RunOptions { overwrite: true, ..Default::default() };
            let config = parse(dir.path(), &text, &[]);
            let report = run_with(&config, &afresh);
            assert!(skipped(&report, "constant") > 100, "{:?}", report.bricks);
            let skipping = decode(&dir.path().join("o.zarr"));
            run_with(&config, &occlude::run::RunOptions { no_skip: true, ..afresh });
            assert_same(&text, &decode(&dir.path().join("o.zarr")), &skipping);
        }
    }
}
