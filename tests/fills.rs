//! What stands in outputs where no value is: missing voxels in integer outputs, and fills that a channel cannot hold.

mod common;

use common::*;

/// The voxels of a `.npy` of u8 or u16.
fn npy(path: &std::path::Path, size: usize, n: usize) -> Vec<u16> {
    let bytes = std::fs::read(path).unwrap();
    let voxels = &bytes[bytes.len() - n * size..];
    voxels.chunks(size).map(|c| c.iter().rev().fold(0, |v, b| v << 8 | *b as u16)).collect()
}

#[test]
fn missing_voxels_of_a_plain_pyramid_hold_the_fill_of_its_type() {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("v.npy"), "|u1", [1, 2, 4], &[255, 5, 7, 255, 255, 255, 9, 3]);
    let text = |range: &str, dtype: &str, more: &str| {
        format!(
            "[input.v]\npath = 'v.npy'\nnodata = 255\n{more}[stage.m]\nop = 'box'\ninput = 'v'\nradius = 0\n\
             [output.plain]\npath = 'plain.npy'\nfrom = 'v'\ndtype = '{dtype}'\n{range}\n\
             [output.stage]\npath = 'stage.npy'\nfrom = 'm.max'\ndtype = '{dtype}'\n{range}\n\
             [output.levels]\npath = 'levels.zarr'\nfrom = 'v'\ndtype = '{dtype}'\n{range}\nlevels = 2\n"
        )
    };
    for (range, dtype, more, want) in [
        ("range = [0, 10]", "u8", "", vec![0, 128, 178, 0, 0, 0, 230, 76]),
        ("range = [0, 10]", "u16", "", vec![0, 32768, 45874, 0, 0, 0, 58982, 19660]),
        // 0 has a code of its own.
        ("range = [-10, 10]", "u8", "", vec![128, 191, 217, 128, 128, 128, 242, 166]),
        ("range = 'auto'", "u8", "", vec![0, 85, 170, 0, 0, 0, 255, 0]),
        ("range = [0, 20]", "u8", "slope = 2\n", vec![0, 128, 178, 0, 0, 0, 230, 76]),
    ] {
        run(dir.path(), &text(range, dtype, more), &[]);
        let size = if dtype == "u8" { 1 } else { 2 };
        for name in ["plain.npy", "stage.npy"] {
            assert_eq!(npy(&dir.path().join(name), size, 8), want, "{name}, {range}, {dtype}, {more}");
        }
        // A cell covers what is valid of its voxels: 5, then 7, 9 and 3.
        let (shape, cells) = &decode(&dir.path().join("levels.zarr"))["level 1 component 0"];
        assert_eq!(shape, &[1, 1, 2]);
        let cells: Vec<u16> = cells.iter().map(|v| f64::from_bits(*v) as u16).collect();
        let mean = [want[1], ((want[2] as u32 + want[6] as u32 + want[7] as u32) as f64 / 3.0).round() as u16];
        assert!(cells.iter().zip(mean).all(|(a, b)| a.abs_diff(b) <= 1), "{cells:?} {mean:?}, {range}, {dtype}");
    }
    // A copy in the input's own type stays one.
    run(dir.path(), &text("", "native", ""), &[]);
    assert_eq!(npy(&dir.path().join("plain.npy"), 1, 8), [255, 5, 7, 255, 255, 255, 9, 3]);
}

#[test]
fn a_fill_that_the_channel_cannot_hold_is_told() {
    let dir = tempfile::tempdir().unwrap();
    write_npy(&dir.path().join("v.npy"), "|u1", [1, 2, 4], &[1, 2, 3, 4, 5, 6, 7, 8]);
    let text = |channel: &str, fill: &str| {
        format!(
            "[input.v]\npath = 'v.npy'\n[stage.m]\nop = 'box'\ninput = 'v'\nradius = 1\nfill = {fill}\n\
             where = {{ input = 'v', min = 5 }}\n[output.o]\npath = 'o.npy'\nfrom = 'm.{channel}'\n"
        )
    };
    let told = |channel: &str, fill: &str| {
        let says = format!("stage.m.fill: {fill} is given, and m.{channel} (u8) holds a whole number from 0 to 255");
        occlude::plan::explain(&parse(dir.path(), &text(channel, fill), &[])).unwrap().0.contains(&says)
    };
    for (fill, stored) in [("-5", 0), ("300", 255), ("2.5", 2), ("255", 255)] {
        assert_eq!(told("min", fill), fill != "255", "{fill}");
        run(dir.path(), &text("min", fill), &[]);
        assert_eq!(npy(&dir.path().join("o.npy"), 1, 8)[0], stored, "{fill}");
        // What nobody reads need not hold it, and floats do.
        assert!(!told("mean", fill));
    }
}

#[test]
fn an_infinity_takes_no_range_from_the_others() {
    let dir = tempfile::tempdir().unwrap();
    let shape = [8, 8, 8];
    let text = "[input.v]\npath = 'v.npy'\n[stage.s]\nop = 'saliency'\ninput = 'v'\nscale = 'max'\nsize = 3\n\
                [output.codes]\npath = 'codes.npy'\nfrom = 'v'\ndtype = 'u8'\nrange = 'auto'\n\
                [output.s]\npath = 's.npy'\nfrom = 's'\n";
    for infinity in [f32::INFINITY, f32::NEG_INFINITY] {
        let volume = fill(shape, |z, y, x| if [z, y, x] == [4, 4, 4] { infinity } else { (z * 64 + y * 8 + x) as f32 });
        write_npy(&dir.path().join("v.npy"), "<f4", shape, &f32_bytes(&volume));
        run(dir.path(), text, &[]);
        let codes = npy(&dir.path().join("codes.npy"), 1, 512);
        assert_eq!((codes[0], codes[511], codes[73]), (0, 255, (73.0f32 * 255.0 / 511.0).round() as u16));
        assert_eq!(codes[4 * 64 + 4 * 8 + 4], if infinity > 0.0 { 255 } else { 0 });
        let (_, saliency) = &decode(&dir.path().join("s.npy"))["level 0 component 0"];
        let most = saliency.iter().map(|v| f64::from_bits(*v)).filter(|v| v.is_finite()).fold(0.0, f64::max);
        assert_eq!(most, 1.0, "{infinity}");
        ["codes.npy", "s.npy"].iter().for_each(|f| std::fs::remove_file(dir.path().join(f)).unwrap());
    }
}
