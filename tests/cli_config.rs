//! The configuration as users meet it: defaults, edits, and refusals with their line, key and reason.

use std::path::Path;

use occlude::Error;
use occlude::config::keys::{self, Default, Section};
use occlude::config::tree::{self, Node, Value};
use occlude::config::*;

const FILE: &str = "/configs/job.toml";

fn read(text: &str) -> occlude::Result<Config> {
    parse(text, Path::new(FILE), &[])
}

fn read_with(text: &str, sets: &[&str]) -> occlude::Result<Config> {
    parse(text, Path::new(FILE), &sets.iter().map(|s| s.to_string()).collect::<Vec<_>>())
}

/// A config that is right; its lines are counted on below.
const GOOD: &str = r#"[run]
threads = 2

[input.ct]
path = "ct.nrrd"

[stage.ao]
op = "ambient_occlusion"
input = "ct"
radius = 3
method = "cdf_power"

[stage.stats]
op = "box"
input = "ct"
radius = "2.5 mm"

[output.ao]
path = "out/ao.zarr"
from = "ao"
"#;

/// Replaces one line of [`GOOD`] (from 1).
fn with_line(line: usize, text: &str) -> String {
    let lines = GOOD.lines().enumerate().map(|(i, l)| if i + 1 == line { text } else { l });
    lines.collect::<Vec<_>>().join("\n")
}

#[track_caller]
fn refused(config: &str, line: Option<usize>, key: &str, fragments: &[&str]) {
    match read(config) {
        Ok(_) => panic!("accepted, but `{key}` is wrong in:\n{config}"),
        Err(e) => {
            assert_eq!(e.exit_code(), 2);
            let shown = e.to_string();
            let Error::Config { file, line: at, key: named, message } = e else {
                panic!("not a config error: {shown}")
            };
            assert_eq!(file.as_deref(), Some(Path::new(FILE)), "{shown}");
            assert_eq!((named.as_str(), at), (key, line), "{shown}");
            for fragment in fragments {
                assert!(message.contains(fragment), "{message:?} lacks {fragment:?}");
            }
        }
    }
}

#[test]
fn the_good_config_is_good() {
    let c = read(GOOD).unwrap();
    assert_eq!(c.run.memory, 2 << 30);
    assert_eq!(c.run.threads, 2);
    assert_eq!(c.outputs[0].chunk, [64; 3]);
    assert_eq!(c.outputs[0].shard, Some([256; 3]));
    assert_eq!(c.outputs[0].path, Path::new("/configs/out/ao.zarr"));
    let Op::Box { radius, .. } = &c.stages[1].op else { panic!() };
    assert_eq!(*radius, Length::Physical { value: 2.5, unit: "millimeter".into() });
    assert_eq!(c.stages[0].place.key, "stage.ao");
    assert_eq!(c.stages[0].place.line, Some(7));
    let e = c.stages[0].place.error("radius", "x").located(&c.file, None);
    assert_eq!(e.to_string(), "/configs/job.toml:10: stage.ao.radius: x");
}

#[test]
fn wrong_lines_are_named_with_value_and_what_would_do() {
    // Line that is replaced, line that is named, the replacement, key, parts of the message.
    let cases: &[(usize, usize, &str, &str, &[&str])] = &[
        (2, 2, "thread = 2", "run.thread", &["did you mean \"threads\"?"]),
        (2, 2, "threads = -1", "run.threads", &["got -1", "too small", "0 to 4096"]),
        (2, 2, "threads = 1.5", "run.threads", &["got 1.5", "not a whole number"]),
        (2, 2, "threads = \"four\"", "run.threads", &["got \"four\"", "whole number"]),
        (2, 2, "memory = \"2 QiB\"", "run.memory", &["got \"2 QiB\"", "unknown unit", "2GiB"]),
        (2, 2, "memory = 0", "run.memory", &["got 0"]),
        (2, 2, "device = \"cuda\"", "run.device", &["got \"cuda\"", "\"auto\", \"cpu\", \"gpu\""]),
        (2, 2, "device = \"GPU\"", "run.device", &["did you mean \"gpu\"?"]),
        (2, 2, "brick = 0", "run.brick", &["got 0", "auto"]),
        (2, 2, "brick = [64, 64]", "run.brick", &["got [64, 64]", "2 elements instead of 3"]),
        (2, 2, "region = [[0, 4], [5, 5], [0, 4]]", "run.region", &["[5, 5] is empty"]),
        (2, 2, "region = [[0, 4], [-5, 5], [0, 4]]", "run.region", &["too small"]),
        (2, 2, "region = \"some\"", "run.region", &["\"all\""]),
        (2, 2, "scratch = \"\"", "run.scratch", &["empty"]),
        (2, 2, "lanes = \"both\"", "run.lanes", &["\"pure\" or \"mixed\""]),
        (4, 4, "[inputs.ct]", "inputs", &["did you mean \"input\"?"]),
        (4, 4, "[input.\"a/b\"]", "input.a/b", &["cannot be a name"]),
        (5, 5, "paht = \"ct.nrrd\"", "input.ct.paht", &["did you mean \"path\"?"]),
        (5, 5, "path = 5", "input.ct.path", &["got 5", "a path"]),
        (5, 5, "path = \"\"", "input.ct.path", &["empty"]),
        (5, 4, "path = \"a.raw\"", "input.ct.shape", &["shape = [z, y, x]", "dtype"]),
        (5, 4, "path = \"a.bin.gz\"", "input.ct.shape", &["headerless"]),
        (5, 6, "path = \"a.nrrd\"\nshape = [1, 2, 3]", "input.ct.shape", &["format = \"raw\""]),
        (5, 6, "path = \"a.nrrd\"\nsynthetic = \"sphere\"", "input.ct.synthetic", &["one of them"]),
        (5, 4, "synthetic = \"sphere\"", "input.ct.shape", &["missing"]),
        (5, 6, "path = \"a.nrrd\"\nspacing = [1, 0, 1]", "input.ct.spacing", &["too small", "positive"]),
        (5, 6, "path = \"a.nrrd\"\nspacing = nan", "input.ct.spacing", &["not finite"]),
        (5, 6, "path = \"a.nrrd\"\nunit = \"furlong\"", "input.ct.unit", &["unknown unit", "mm"]),
        (5, 6, "path = \"a.nrrd\"\nchannel = -1", "input.ct.channel", &["index"]),
        (5, 7, "path = \"a.zarr\"\nlevel = 1\narray = \"x\"", "input.ct.array", &["one of them"]),
        (5, 6, "path = \"a.nrrd\"\nseed = 1", "input.ct.seed", &["synthetic"]),
        (5, 6, "path = \"a.raw\"\ndtype = \"u12\"\nshape = [1, 1, 1]", "input.ct.dtype", &["got \"u12\"", "\"u16\""]),
        (7, 7, "[stage.ct]", "stage.ct", &["taken by an input"]),
        (8, 8, "op = \"ambient_oclusion\"", "stage.ao.op", &["did you mean \"ambient_occlusion\"?"]),
        (8, 7, "", "stage.ao.op", &["missing", "\"box\""]),
        (8, 10, "op = \"gaussian\"", "stage.ao.radius", &["op \"gaussian\" has no key \"radius\"", "belongs to box"]),
        (9, 9, "input = \"xt\"", "stage.ao.input", &["no input or stage is named \"xt\"", "did you mean \"ct\"?"]),
        (9, 9, "input = \"ct.mean\"", "stage.ao.input", &["is an input"]),
        (9, 9, "input = \"stats.varianse\"", "stage.ao.input", &["no channel", "did you mean \"variance\"?"]),
        (9, 9, "input = \"ao\"", "stage.ao.input", &["in a circle: ao <- ao"]),
        (9, 7, "", "stage.ao.input", &["missing"]),
        (10, 10, "radius = -3", "stage.ao.radius", &["got -3", "too small"]),
        (10, 10, "radius = 2.5", "stage.ao.radius", &["not a whole number"]),
        (10, 10, "radius = nan", "stage.ao.radius", &["not a whole number"]),
        (10, 10, "radius = \"2.5 furlongs\"", "stage.ao.radius", &["unknown unit \"furlongs\""]),
        (10, 10, "radius = \"2.5\"", "stage.ao.radius", &["unit is missing"]),
        (10, 10, "radius = [1, 2]", "stage.ao.radius", &["2 elements instead of 3"]),
        (10, 10, "radius = true", "stage.ao.radius", &["got true"]),
        (10, 10, "raduis = 3", "stage.ao.raduis", &["did you mean \"radius\"?"]),
        (10, 7, "", "stage.ao.radius", &["missing"]),
        (11, 7, "", "stage.ao.method", &["missing", "\"exact\""]),
        (11, 11, "method = \"cdf\"", "stage.ao.method", &["got \"cdf\"", "\"cdf_power\""]),
        (11, 12, "method = \"chebyshev\"\nregion = \"ball\"", "stage.ao.region", &["exact"]),
        (11, 12, "method = \"exact\"\nlevel_count = 16", "stage.ao.level_count", &["\"levels\" only"]),
        (11, 12, "method = \"levels\"\nlevel_count = 65", "stage.ao.level_count", &["65"]),
        (11, 12, "method = \"moments4\"\nregion = \"ball\"", "stage.ao.region", &["exact"]),
        (11, 12, "method = \"exact\"\nties = \"lt\"", "stage.ao.ties", &["\"le\" or \"mid\""]),
        (11, 12, "method = \"exact\"\nborder = \"wrap\"", "stage.ao.border", &["clip"]),
        (11, 12, "method = \"exact\"\nborder = \"constant\"", "stage.ao.border", &["needs its value"]),
        (11, 12, "method = \"exact\"\nborder = { constant = nan }", "stage.ao.border", &["not finite"]),
        (11, 12, "method = \"exact\"\nfill = inf", "stage.ao.fill", &["not finite"]),
        (11, 12, "method = \"exact\"\nwhere = { min = 1 }", "stage.ao.where.input", &["missing"]),
        (11, 12, "method = \"exact\"\nwhere = { input = \"ct\" }", "stage.ao.where", &["min, max or iso"]),
        (
            11,
            12,
            "method = \"exact\"\nwhere = { input = \"ct\", min = 5, max = 4 }",
            "stage.ao.where.min",
            &["above max"],
        ),
        (
            11,
            12,
            "method = \"exact\"\nwhere = { input = \"ct\", iso = 5, max = 4 }",
            "stage.ao.where.iso",
            &["excludes"],
        ),
        (11, 12, "method = \"exact\"\nwhere = { input = \"ct\", iso = [] }", "stage.ao.where.iso", &["empty"]),
        (11, 12, "method = \"exact\"\nwhere = { input = \"ct\", iso = 5, band = -1 }", "stage.ao.where.band", &["-1"]),
        (
            11,
            12,
            "method = \"exact\"\nwhere = { input = \"ct\", minn = 5 }",
            "stage.ao.where.minn",
            &["did you mean \"min\"?"],
        ),
        (11, 12, "method = \"exact\"\nwhere = { input = \"ao\", min = 5 }", "stage.ao.where", &["circle"]),
        (11, 12, "method = \"exact\"\nwhere = \"ct\"", "stage.ao.where", &["got \"ct\""]),
        (18, 18, "[outputs.ao]", "outputs", &["did you mean \"output\"?"]),
        (19, 18, "", "output.ao.path", &["missing"]),
        (19, 19, "path = \"out/ao.tif\"", "output.ao.path", &["ao.tif", ".zarr", "format"]),
        (19, 19, "path = \"out/ao.nii.gz\"", "output.ao.path", &["gzip is not written"]),
        (19, 19, "path = \"ct.nrrd\"", "output.ao.path", &["path of input \"ct\""]),
        (19, 19, "path = \"x/../ct.nrrd/ao.zarr\"", "output.ao.path", &["inside input \"ct\""]),
        (20, 18, "", "output.ao.from", &["missing"]),
        (20, 20, "from = []", "output.ao.from", &["empty"]),
        (20, 20, "from = [\"ao\", \"aoo\"]", "output.ao.from", &["did you mean \"ao\"?"]),
        (20, 20, "from = \"ao.lower\"", "output.ao.from", &["no channel \"lower\"", "\"cdf_power\"", "moments4"]),
        (20, 20, "from = [\"ao\", \"ao.lowre\"]", "output.ao.from", &["did you mean \"lower\"?"]),
        (20, 21, "from = \"ao\"\ndtype = \"u32\"", "output.ao.dtype", &["\"native\", \"u8\", \"u16\" or \"f32\""]),
        (20, 21, "from = \"ao\"\nrange = [1, 0]", "output.ao.range", &["1 is not below 0"]),
        (20, 18, "from = \"stats\"\ndtype = \"u8\"", "output.ao.range", &["missing", "mean"]),
        (20, 21, "from = \"ao\"\nchunk = 0", "output.ao.chunk", &["got 0"]),
        (20, 21, "from = \"ao\"\nchunk = 99999999999", "output.ao.chunk", &["too large"]),
        (20, 22, "from = \"ao\"\nchunk = 48\nshard = 256", "output.ao.shard", &["multiple of chunk"]),
        (20, 21, "from = \"ao\"\ncodec = \"lzma\"", "output.ao.codec", &["got \"lzma\"", "blosc-lz4"]),
        (20, 21, "from = \"ao\"\ncodec = \"zstd:99\"", "output.ao.codec", &["out of range"]),
        (20, 21, "from = \"ao\"\nlevels = 0", "output.ao.levels", &["got 0"]),
        (20, 21, "from = \"ao\"\nreduce = \"median\"", "output.ao.reduce", &["\"mean\""]),
        (20, 21, "from = \"ao\"\nreduce = \"moments\"", "output.ao.reduce", &["variance and std"]),
        (20, 22, "from = \"ao\"\nformat = \"nii\"\nlevels = 2", "output.ao.levels", &["nii holds level 0 only"]),
        (
            20,
            22,
            "from = \"ao\"\n[output.b]\npath = \"out/x/../ao.zarr\"\nfrom = \"ct\"",
            "output.b.path",
            &["same path"],
        ),
        (
            20,
            22,
            "from = \"ao\"\n[output.b]\npath = \"out/ao.zarr/b.zarr\"\nfrom = \"ct\"",
            "output.b.path",
            &["inside each other"],
        ),
    ];
    for (line, at, text, key, fragments) in cases {
        refused(&with_line(*line, text), Some(*at), key, fragments);
    }
}

#[test]
fn keys_of_other_stages_are_checked_too() {
    let stage = |body: &str| {
        format!("[input.ct]\npath = \"ct.nrrd\"\n[stage.s]\n{body}\n[output.o]\npath = \"o.zarr\"\nfrom = \"s\"\n")
    };
    for (body, line, key, fragment) in [
        ("op = \"gaussian\"\ninput = \"ct\"\nsigma = 0", 6, "stage.s.sigma", "got 0"),
        ("op = \"gaussian\"\ninput = \"ct\"", 3, "stage.s.sigma", "missing"),
        ("op = \"occlusion_map\"\ninput = \"ct\"\nstart_level = 2", 6, "stage.s.start_level", "0 to 1"),
        ("op = \"occlusion_map\"\ninput = \"ct\"\nborder = \"nearest\"", 6, "stage.s.border", "\"clip\""),
        ("op = \"occlusion_map\"\ninput = \"ct\"\nfill = 3", 6, "stage.s.fill", "has no key"),
        ("op = \"obscurance\"\ninput = \"ct\"\ndirections = 13", 6, "stage.s.directions", "12, 42 or 162"),
        ("op = \"obscurance\"\ninput = \"ct\"\nborder = \"clip\"", 6, "stage.s.border", "op \"obscurance\" has no key"),
        ("op = \"obscurance\"\ninput = \"ct\"\nmax_distance = 0", 6, "stage.s.max_distance", "got 0"),
        ("op = \"obscurance\"\ninput = \"ct\"\nmax_distance = [1, 2, 3]", 6, "stage.s.max_distance", "all axes"),
        (
            "op = \"obscurance\"\ninput = \"ct\"\nset = \"fibonacci\"\nweights = \"voronoi\"",
            7,
            "stage.s.weights",
            "icosahedron",
        ),
        ("op = \"obscurance\"\ninput = \"ct\"\ncolour = \"ct\"", 6, "stage.s.colour", "channel rgb"),
        ("op = \"obscurance\"\ninput = \"ct\"\nweight_by_normal = 1", 6, "stage.s.weight_by_normal", "true or false"),
        (
            "op = \"transfer\"\ninput = \"ct\"\npoints = [[0, 0, 0, 0, 0],\n[0, 1, 1, 1, 1]]",
            7,
            "stage.s.points",
            "ascend",
        ),
        ("op = \"transfer\"\ninput = \"ct\"\npoints = [[0, 2, 0, 0, 0]]", 6, "stage.s.points", "0..1"),
        ("op = \"transfer\"\ninput = \"ct\"\npoints = [[0, 1, 0, 0]]", 6, "stage.s.points", "4 elements"),
        ("op = \"transfer\"\ninput = \"ct\"\npoints = []", 6, "stage.s.points", "empty"),
        ("op = \"window\"\ninput = \"ct\"\nlow = 0.9\nhigh = 0.1", 6, "stage.s.low", "above high"),
        ("op = \"gradient\"\ninput = \"ct\"\nsize = 4", 6, "stage.s.size", "5 or 3"),
        ("op = \"saliency\"\ninput = \"ct\"\nscale = \"mean\"", 6, "stage.s.scale", "\"none\" or \"max\""),
        ("op = \"combine\"\nop_kind = \"add\"", 3, "stage.s.inputs", "missing"),
        ("op = \"combine\"\ninputs = [\"ct\"]\nop_kind = \"sub\"", 6, "stage.s.op_kind", "\"add\""),
        ("op = \"combine\"\ninputs = [\"ct\", 5]\nop_kind = \"add\"", 5, "stage.s.inputs", "list"),
        (
            "op = \"opacity_modulation\"\ninput = \"ct\"\nby = \"ct\"\ngain = 1\nsigma_max2 = 2",
            8,
            "stage.s.sigma_max2",
            "one or the other",
        ),
        (
            "op = \"opacity_modulation\"\ninput = \"ct\"\nby = \"ct\"\nsigma_max2 = 0",
            7,
            "stage.s.sigma_max2",
            "above 0",
        ),
        ("op = \"ambient_light\"\ninput = \"ct\"\nrgb = \"s\"\nk = \"1\"", 7, "stage.s.k", "number"),
    ] {
        refused(&stage(body), Some(line), key, &[fragment]);
    }
    let bad_rgb = stage("op = \"obscurance\"\ninput = \"ct\"").replace("from = \"s\"", "from = \"s.rgb\"");
    refused(&bad_rgb, Some(8), "output.o.from", &["only with its key `colour`"]);
    refused("[input.ct]\npath = \"a.nrrd\"\n", None, "output", &["at least one"]);
    refused("a = 1\n[run\n", Some(2), "", &["not valid TOML"]);
    refused("run = 5\n", Some(1), "run", &["got 5", "table"]);
    refused("stage = []\n", Some(1), "stage", &["[stage.NAME]"]);
    refused("[stage]\nao = 1\n[output.o]\n", Some(2), "stage.ao", &["table of keys"]);
    refused(&format!("x = {}{}", "[".repeat(5000), "]".repeat(5000)), Some(1), "", &["not valid TOML"]);
}

#[test]
fn a_circle_of_several_stages_is_told_in_full() {
    let text = "[stage.a]\nop = \"gradient\"\ninput = \"c\"\n[stage.b]\nop = \"gradient\"\ninput = \"a\"\n[stage.c]\nop = \"combine\"\nop_kind = \"add\"\ninputs = [\"b\"]\n[output.o]\npath = \"o.zarr\"\nfrom = \"a\"\n";
    refused(text, Some(3), "stage.a.input", &["a <- c <- b <- a"]);
}

#[test]
fn shards_follow_the_chunk_unless_they_are_given() {
    for (keys, shard) in [
        ("chunk = 32", Some([256; 3])),
        ("chunk = 48", Some([240; 3])),
        ("chunk = 300", Some([300; 3])),
        ("chunk = [1, 48, 64]", Some([256, 240, 256])),
        ("chunk = 32\nshard = 64", Some([64; 3])),
        ("shard = \"none\"", None),
        ("format = \"ome-zarr-0.4\"", None),
    ] {
        let c = read(&with_line(20, &format!("from = \"ao\"\n{keys}"))).unwrap();
        assert_eq!(c.outputs[0].shard, shard, "{keys}");
    }
}

#[test]
fn references_find_their_channels() {
    let text = r#"
[input."my.ct"]
path = "ct.nrrd"
[stage.stats]
op = "box"
input = "my.ct"
radius = 1
[stage.tf]
op = "transfer"
input = "stats.max"
points = [[0, 0, 0, 0, 0]]
[stage.ao]
op = "obscurance"
input = "my.ct"
colour = "tf"
[stage.lit]
op = "ambient_light"
input = "ao"
rgb = "ao"
[stage.mod1]
op = "opacity_modulation"
input = "tf"
by = "stats.variance"
[stage.mod2]
op = "opacity_modulation"
input = "tf"
by = "stats"
[stage.mod3]
op = "opacity_modulation"
input = "tf"
by = "stats"
sigma_max2 = 7
[stage.two]
op = "combine"
input = ["mod1", "mod2"]
op_kind = "max"
[output.a]
path = "a.zarr"
from = ["my.ct", "ao.rgb"]
[output.b]
path = "b.nii"
from = "two"
"#;
    let c = read(text).unwrap();
    let Op::Obscurance(o) = &c.stage("ao").unwrap().op else { panic!() };
    assert_eq!(o.input, Ref { name: "my.ct".into(), channel: None });
    assert_eq!(o.colour, Some(Ref { name: "tf".into(), channel: Some("rgb".into()) }));
    let Op::AmbientLight { rgb, .. } = &c.stage("lit").unwrap().op else { panic!() };
    assert_eq!(rgb.channel.as_deref(), Some("rgb"));
    let rule = |name: &str| match &c.stage(name).unwrap().op {
        Op::OpacityModulation { rule, .. } => *rule,
        _ => panic!(),
    };
    assert_eq!(rule("mod1"), Modulation::Variance { sigma_max2: 5.0 });
    assert_eq!(rule("mod2"), Modulation::Saliency { threshold: 0.2, gain: 1.0 });
    assert_eq!(rule("mod3"), Modulation::Variance { sigma_max2: 7.0 });
    assert_eq!(c.channel_of(&c.outputs[1].from[0]), Some("value"));
    assert_eq!(c.outputs[1].levels, Some(1));
    let needed: Vec<&str> = c.needed_stages().iter().map(|s| s.name.as_str()).collect();
    assert_eq!(needed, ["stats", "tf", "ao", "mod1", "mod2", "two"]);
}

#[test]
fn set_changes_creates_and_is_refused_like_the_file() {
    let c = read_with(
        GOOD,
        &[
            "run.memory=1GiB",
            "stage.ao.radius=5",
            "output.ao.chunk=32",
            "output.ao.path=elsewhere/x.zarr",
            "output.second.path=\"b.nii\"",
            "output.second.from=stats.max",
            "stage.ao.where={ input = \"ct\", min = 1 }",
            "stage.ao.where.max=9",
        ],
    )
    .unwrap();
    assert_eq!(c.run.memory, 1 << 30);
    let Op::AmbientOcclusion { radius, .. } = &c.stages[0].op else { panic!() };
    assert_eq!(*radius, Length::Voxels([5.0; 3]));
    assert_eq!(c.outputs[0].chunk, [32; 3]);
    assert_eq!(c.outputs[0].path, Path::new("/configs/elsewhere/x.zarr"));
    assert_eq!(c.outputs[1].format, OutputFormat::Nifti);
    assert_eq!(c.stages[0].where_.as_ref().unwrap().rule, WhereRule::Range { min: Some(1.0), max: Some(9.0) });
    // The text that outputs keep says the same without the edits.
    let again = read(&c.text).unwrap();
    assert_eq!(config_hash(&again), config_hash(&c));

    for (set, key, fragment) in [
        ("stage.ao.radius=-1", "stage.ao.radius", "got -1 from --set"),
        ("stage.ao.raduis=1", "stage.ao.raduis", "did you mean"),
        ("run.memory.x=1", "run.memory.x", ""),
        ("run.threads.x=1", "run.threads.x", "not a table"),
        ("nonsense", "", "key=value"),
        ("=5", "", "dotted TOML key"),
    ] {
        let e = read_with(GOOD, &[set]);
        if set == "run.memory.x=1" {
            // GOOD has no run.memory, so this makes a table, which is refused as a size.
            assert!(e.unwrap_err().to_string().contains("got a table"));
            continue;
        }
        let Err(Error::Config { key: named, message, .. }) = e else { panic!("{set} was accepted") };
        assert_eq!(named, key, "{message}");
        assert!(message.contains(fragment), "{message:?} lacks {fragment:?}");
    }
}

#[test]
fn the_hash_sees_what_can_change_voxels_and_nothing_else() {
    let hash = |sets: &[&str]| config_hash(&read_with(GOOD, sets).unwrap());
    let base = hash(&[]);
    for same in [
        "run.threads=7",
        "run.memory=1GiB",
        "run.brick=32",
        "run.scratch=/tmp/s",
        "run.device=cpu",
        "output.ao.path=moved/ao.zarr",
        "input.ct.path=moved/ct.nrrd",
        "stage.stats.radius=9",
    ] {
        assert_eq!(hash(&[same]), base, "{same}");
    }
    assert_eq!(config_hash(&read(&format!("# a comment\n\n{GOOD}")).unwrap()), base);
    for other in [
        "run.region=[[0,1],[0,1],[0,1]]",
        "stage.ao.radius=4",
        "stage.ao.method=exact",
        "stage.ao.border=nearest",
        "stage.ao.fill=0.5",
        "stage.ao.where={input=\"ct\", min=1}",
        "output.ao.chunk=32",
        "output.ao.dtype=u16",
        "output.ao.levels=1",
        "input.ct.slope=2",
        "input.ct.level=1",
        "input.ct.nodata=0",
        "output.ao.from=ct",
    ] {
        assert_ne!(hash(&[other]), base, "{other}");
    }
}

fn reference() -> String {
    std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/configs/reference.toml")).unwrap()
}

fn entries(node: &Node) -> &tree::Table {
    match &node.value {
        Value::Table(t) => t,
        _ => panic!("not a table: {node}"),
    }
}

/// Every table of the reference config that holds keys: section, op, table, its text.
fn tables(root: &tree::Table) -> Vec<(Section, String, tree::Table)> {
    let single = |(section, name)| (section, String::new(), entries(tree::find(root, name).unwrap()).clone());
    let mut found: Vec<_> = [(Section::Run, "run"), (Section::Pareto, "pareto")].map(single).into();
    for (kind, section) in [("input", Section::Input), ("stage", Section::Stage), ("output", Section::Output)] {
        for (_, node) in entries(tree::find(root, kind).unwrap()) {
            let t = entries(node).clone();
            let op = match tree::find(&t, "op").map(|n| &n.value) {
                Some(Value::Text(op)) => op.clone(),
                _ => String::new(),
            };
            if let Some(w) = tree::find(&t, "where") {
                found.push((Section::Where, String::new(), entries(w).clone()));
            }
            found.push((section, op, t));
        }
    }
    found
}

#[test]
fn reference_names_every_key_with_its_default() {
    let text = reference();
    let tables = tables(&tree::parse(&text).unwrap());
    for key in keys::KEYS {
        let ops: Vec<&str> = if key.ops.is_empty() { vec![""] } else { key.ops.to_vec() };
        for op in ops {
            let of_op: Vec<_> =
                tables.iter().filter(|(s, o, _)| *s == key.section && (op.is_empty() || o == op)).collect();
            let given: Vec<&Node> = of_op.iter().filter_map(|(_, _, t)| tree::find(t, key.name)).collect();
            let mentioned = text.contains(&format!("# {} = ", key.name))
                || text.lines().any(|l| l.trim_start_matches("# ").split([' ', '=']).next() == Some(key.name))
                || text.contains(&format!("{} = ", key.name));
            assert!(!given.is_empty() || mentioned, "{:?} {op} {} is not in reference.toml", key.section, key.name);
            if let Default::Toml(default) = key.default {
                let default = tree::parse_value(default).unwrap().to_string();
                let shown: Vec<String> = given.iter().map(|n| n.to_string()).collect();
                // `format` cannot be the default where raw keys are shown.
                let fine = shown.contains(&default) || (key.name == "format" && text.contains("default \"auto\""));
                assert!(fine, "{} {op}: {shown:?} holds no default {default}", key.name);
            }
        }
    }
}

#[test]
fn reference_parses_to_the_defaults() {
    let text = reference();
    let whole = parse(&text, Path::new(FILE), &[]).unwrap();
    // Take every key away whose value is its default; nothing may change.
    let mut document: toml_edit::DocumentMut = text.parse().unwrap();
    let mut taken = 0;
    for (kind, section) in [
        ("run", Section::Run),
        ("input", Section::Input),
        ("stage", Section::Stage),
        ("output", Section::Output),
        ("pareto", Section::Pareto),
    ] {
        let table = document[kind].as_table_mut().unwrap();
        let names: Vec<String> = table.iter().map(|(n, _)| n.to_string()).collect();
        let strip = |t: &mut toml_edit::Table| {
            let op = t.get("op").and_then(|o| o.as_str()).unwrap_or("").to_string();
            for key in keys::of(section, &op) {
                // Which rule of modulation applies is said by which keys are there.
                if let Default::Toml(_) = key.default
                    && !(op == "opacity_modulation" || key.name == "format")
                    && t.remove(key.name).is_some()
                {
                    taken += 1;
                }
            }
        };
        if matches!(section, Section::Run | Section::Pareto) {
            Some(table).into_iter().for_each(strip);
        } else {
            let mut strip = strip;
            for name in names {
                strip(table[&name].as_table_mut().unwrap());
            }
        }
    }
    assert!(taken > 40, "only {taken} keys of reference.toml are at their default");
    let bare = parse(&document.to_string(), Path::new(FILE), &[]).unwrap();
    let run = |c: &Config| {
        let r = &c.run;
        format!("{} {} {:?} {:?} {:?} {:?} {:?}", r.memory, r.threads, r.device, r.brick, r.region, r.scratch, r.lanes)
    };
    assert_eq!(run(&whole), run(&bare));
    let plain = |c: &Config| {
        let stages: Vec<String> =
            c.stages.iter().map(|s| format!("{:?} {:?} {:?} {:?}", s.op, s.border, s.where_, s.fill)).collect();
        let no_place = |mut i: Input| {
            i.place = Place::default();
            format!("{i:?}")
        };
        let inputs: Vec<String> = c.inputs.iter().cloned().map(no_place).collect();
        let outputs = c.outputs.iter().cloned().map(|mut o| {
            o.place = Place::default();
            // Not given and given as mean: the same by definition (`None` is mean).
            o.reduce = o.reduce.or(Some(occlude::stage::Reduce::Mean));
            format!("{o:?}")
        });
        (stages, inputs, outputs.collect::<Vec<_>>())
    };
    assert_eq!(plain(&whole), plain(&bare));
}

#[test]
fn defaults_and_ops_of_the_table_are_sound() {
    for key in keys::KEYS {
        if let Default::Toml(text) = key.default {
            tree::parse_value(text).unwrap_or_else(|e| panic!("{}: {e:?}", key.name));
        }
        assert!(key.ops.iter().all(|op| keys::OPS.contains(op)), "{}", key.name);
        assert!(!key.doc.is_empty() && !key.kind.accepts().is_empty());
    }
    assert!(keys::OPS.iter().all(|op| !op_channels(op).is_empty()));
    assert!(op_channels("nothing").is_empty());
    for op in keys::OPS {
        let mut names: Vec<&str> = keys::of(Section::Stage, op).map(|k| k.name).collect();
        let n = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), n, "{op} has a key twice");
    }
}

mod schema_check;

#[test]
fn every_shipped_config_fits_the_schema_and_the_parser() {
    let schema = schema();
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/configs");
    let mut seen = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "toml") {
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap();
        let value = serde_json::to_value(text.parse::<toml::Table>().unwrap()).unwrap();
        schema_check::validate(&schema, &value, "").unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        load(&path, &[]).unwrap_or_else(|e| panic!("{e}"));
        seen += 1;
    }
    assert!(seen >= 1);
}

#[test]
fn the_schema_refuses_what_the_parser_refuses() {
    let schema = schema();
    let check = |text: &str| {
        let value = serde_json::to_value(text.parse::<toml::Table>().unwrap()).unwrap();
        schema_check::validate(&schema, &value, "")
    };
    check(GOOD).unwrap();
    for (line, text) in [
        (2, "thread = 2"),
        (2, "threads = -1"),
        (2, "brick = 0"),
        (5, "path = \"a\"\nsynthetic = \"b\""),
        (8, "op = \"gaussian\""),
        (10, "radius = -3"),
        (10, "radius = 2.5"),
        (11, ""),
        (11, "method = \"cdf\""),
        (19, ""),
        (20, "from = \"ao\"\nlevels = 0"),
    ] {
        let text = with_line(line, text);
        assert!(check(&text).is_err() && read(&text).is_err(), "{text}");
    }
    assert!(check("[run]\n").is_err());
    // Two names of one key: one of them.
    let combine = |keys: &str| {
        format!(
            "[input.a]\npath = \"a.npy\"\n[stage.s]\nop = \"combine\"\nop_kind = \"add\"\n{keys}[output.o]\npath = \"o.npy\"\n\
             from = \"s\"\n"
        )
    };
    for (keys, fits) in [
        ("input = [\"a\", \"a\"]\n", true),
        ("inputs = [\"a\", \"a\"]\n", true),
        ("", false),
        ("input = [\"a\", \"a\"]\ninputs = [\"a\", \"a\"]\n", false),
    ] {
        let text = combine(keys);
        assert_eq!((check(&text).is_ok(), read(&text).is_ok()), (fits, fits), "{text}");
    }
}
