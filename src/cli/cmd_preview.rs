//! `occlude preview`.

use super::args::{MapArg, PreviewArgs};
use super::draw::{Canvas, ColourMap, GLYPH, GREY, MAGMA, VIRIDIS};
use super::reader::{self, Volume};
use super::{human, messages, refuse_overwriting, usage, write_whole};
use crate::Result;
use crate::grid::Region;

/// Pixels between pictures and at the edge.
const GAP: usize = 8;
/// Longest side of one picture.
const LONGEST: f64 = 1600.0;
/// Pictures are enlarged to about this size.
const COMFORTABLE: f64 = 256.0;

/// One slice: values of each component, rows of columns, and the physical size of a pixel.
struct Slice {
    label: String,
    rows: usize,
    columns: usize,
    components: Vec<Vec<f64>>,
    /// Physical height and width of a voxel.
    step: [f64; 2],
    /// The first row is drawn lowest.
    flipped: bool,
}

/// Draws slices, upright where the file says which way a body lies in it.
pub fn run(args: &PreviewArgs) -> Result<()> {
    let cancel = messages::interrupts();
    let volume = Volume::open(&args.path, args.level, &args.raw, &cancel)?;
    let files = volume.source.paths();
    refuse_overwriting("OUT", &args.out, files.iter().chain([&args.path]).map(|p| p.as_path()))?;
    let shape = volume.info().shape;
    let wanted = match args.slice {
        None => [0, 1, 2].map(|axis| (axis, shape[axis] / 2)).to_vec(),
        Some((axis, index)) if index < shape[axis] => vec![(axis, index)],
        Some((axis, index)) => {
            let name = ["z", "y", "x"][axis];
            return Err(usage("--slice", format!("got {name}={index}; expected {name}=0 to {}", shape[axis] - 1)));
        }
    };
    let components = components(&volume, args.component)?;
    let mut slices = Vec::new();
    for (axis, index) in wanted {
        cancel.check()?;
        slices.push(slice(&volume, axis, index, &components)?);
    }
    let range = args.range.unwrap_or_else(|| range(&slices, volume.attributes.is_openness()));
    let map = match args.map {
        MapArg::Grey => GREY,
        MapArg::Viridis => VIRIDIS,
        MapArg::Magma => MAGMA,
    };
    write_whole(&args.out, &draw(&slices, range, &map).png()?)
}

/// Three components are a colour.
fn components(volume: &Volume, chosen: Option<usize>) -> Result<Vec<usize>> {
    let n = volume.info().components.max(1);
    match chosen {
        Some(c) if c >= n => Err(usage("--component", format!("got {c}; expected 0 to {}", n - 1))),
        Some(c) => Ok(vec![c]),
        None if n == 3 => Ok(vec![0, 1, 2]),
        None => Ok(vec![0]),
    }
}

fn slice(volume: &Volume, axis: usize, index: usize, components: &[usize]) -> Result<Slice> {
    let info = volume.info();
    let mut region = Region::whole(info.shape);
    region.lo[axis] = index as i64;
    region.hi[axis] = index as i64 + 1;
    let [row, column] = [[1, 2], [0, 2], [0, 1]][axis];
    let upward = volume.orientation().and_then(|o| o.upward(row));
    let up = upward.map_or(String::new(), |(toward, _)| format!(" up={toward}"));
    let values = components.iter().map(|&c| reader::read_box(volume, c, region)).collect::<Result<_>>()?;
    Ok(Slice {
        label: format!("{}={index}{up}", ["z", "y", "x"][axis]),
        rows: info.shape[row],
        columns: info.shape[column],
        components: values,
        step: [info.spacing[row], info.spacing[column]],
        flipped: upward.is_some_and(|(_, grows)| grows),
    })
}

/// Least and largest finite value shown; openness, and colours from 0 to 1, are shown whole.
fn range(slices: &[Slice], openness: bool) -> [f64; 2] {
    if openness {
        return [0.0, 1.0];
    }
    let values = slices.iter().flat_map(|s| s.components.iter().flatten()).copied().filter(|v| v.is_finite());
    let ends = values.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], v| [lo.min(v), hi.max(v)]);
    let colours = slices.iter().all(|s| s.components.len() == 3);
    if colours && ends[0] >= 0.0 && ends[1] <= 1.0 {
        return [0.0, 1.0];
    }
    if ends[0] <= ends[1] { ends } else { [0.0, 1.0] }
}

/// Pixels per physical unit: the finest axis gets whole pixels where that is not too large.
fn scale(slices: &[Slice]) -> f64 {
    let finest = slices.iter().flat_map(|s| s.step).fold(f64::INFINITY, f64::min);
    let longest = slices.iter().map(Slice::physical).fold(0.0, |m, [h, w]| f64::max(m, h.max(w)));
    let pixels = longest / finest;
    let zoom = if pixels > LONGEST { LONGEST / pixels } else { (COMFORTABLE / pixels).ceil().clamp(1.0, 16.0) };
    zoom / finest
}

impl Slice {
    /// Height and width.
    fn physical(&self) -> [f64; 2] {
        [self.rows as f64 * self.step[0], self.columns as f64 * self.step[1]]
    }

    /// Colour of a voxel.
    fn colour(&self, at: usize, [lo, hi]: [f64; 2], map: &ColourMap) -> [u8; 3] {
        let t = |v: f64| if hi > lo { (v - lo) / (hi - lo) } else { 0.0 * v };
        match self.components.as_slice() {
            [r, g, b] => [r, g, b].map(|c| (t(c[at]).clamp(0.0, 1.0) * 255.0).round() as u8),
            [one, ..] => map.at(t(one[at])),
            [] => [0; 3],
        }
    }
}

/// Pictures side by side, below them the colour map with its ends.
fn draw(slices: &[Slice], range: [f64; 2], map: &ColourMap) -> Canvas {
    let scale = scale(slices);
    let sizes: Vec<[usize; 2]> =
        slices.iter().map(|s| s.physical().map(|p| ((p * scale).round() as usize).max(1))).collect();
    let line = GLYPH[1] * 2;
    let ends = range.map(human::number);
    let footer: usize = 12 * ends.iter().map(|e| e.len()).sum::<usize>() + 64 + 4 * GAP;
    // A narrow picture is given the room of its label.
    let across = |slice: &Slice, width: usize| width.max(12 * slice.label.len()) + GAP;
    let width = (slices.iter().zip(&sizes).map(|(s, size)| across(s, size[1])).sum::<usize>() + GAP).max(footer);
    let tallest = sizes.iter().map(|s| s[0]).max().unwrap_or(1);
    let mut canvas = Canvas::new(width, tallest + 5 * GAP + 2 * line, 24);
    let mut left = GAP;
    for (slice, [height, width]) in slices.iter().zip(&sizes) {
        canvas.text(left, GAP, &slice.label, 2, [220; 3]);
        for (y, x) in (0..*height).flat_map(|y| (0..*width).map(move |x| (y, x))) {
            // The voxel under the middle of the pixel.
            let row = ((2 * y + 1) * slice.rows / (2 * height)).min(slice.rows - 1);
            let row = if slice.flipped { slice.rows - 1 - row } else { row };
            let column = ((2 * x + 1) * slice.columns / (2 * width)).min(slice.columns - 1);
            let rgb = slice.colour(row * slice.columns + column, range, map);
            canvas.set(left + x, 2 * GAP + line + y, rgb);
        }
        left += across(slice, *width);
    }
    legend(&mut canvas, 3 * GAP + line + tallest, &ends, map);
    canvas
}

fn legend(canvas: &mut Canvas, top: usize, ends: &[String; 2], map: &ColourMap) {
    let start = 2 * GAP + canvas.text(GAP, top, &ends[0], 2, [220; 3]);
    let stop = canvas.width.saturating_sub(2 * GAP + 12 * ends[1].len()).min(start + 512);
    for x in start..stop {
        let rgb = map.at((x - start) as f64 / (stop - start).max(2) as f64);
        (0..GLYPH[1] * 2).for_each(|y| canvas.set(x, top + y, rgb));
    }
    canvas.text(stop.max(start) + GAP, top, &ends[1], 2, [220; 3]);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn test_slice(rows: usize, columns: usize, step: [f64; 2]) -> Slice {
        let values = (0..rows * columns).map(|i| i as f64).collect();
        Slice { label: "z=1".into(), rows, columns, components: vec![values], step, flipped: false }
    }

    #[test]
    fn voxels_keep_their_proportions() {
        let slices = [test_slice(100, 200, [2.0, 1.0]), test_slice(10, 200, [4.0, 1.0])];
        let k = scale(&slices);
        let sizes: Vec<[f64; 2]> = slices.iter().map(|s| s.physical().map(|p| p * k)).collect();
        assert_eq!(sizes[0][0], sizes[0][1]);
        assert_eq!(sizes[1][1] / sizes[1][0], 5.0);
        assert!((sizes[0][1] - 400.0).abs() < 1e-9, "{sizes:?}");
        let large = [test_slice(1, 1, [1.0, 1.0]), Slice { rows: 100_000, ..test_slice(1, 1, [1.0, 1.0]) }];
        assert!((scale(&large) * 100_000.0 - LONGEST).abs() < 1e-6);
    }

    #[test]
    fn a_body_stands_upright() {
        let mut s = test_slice(2, 1, [1.0, 1.0]);
        for (flipped, top) in [(false, 0), (true, 255)] {
            s.flipped = flipped;
            let canvas = draw(std::slice::from_ref(&s), [0.0, 1.0], &GREY);
            assert_eq!(canvas.pixels[((2 * GAP + 14) * canvas.width + GAP) * 3], top);
        }
    }

    #[test]
    fn ranges_and_pictures_of_odd_values() {
        let mut s = test_slice(1, 3, [1.0, 1.0]);
        s.components[0] = vec![f64::NAN, f64::INFINITY, 2.0];
        assert_eq!(range(&[s], false), [2.0, 2.0]);
        let mut s = test_slice(2, 2, [1.0, 1.0]);
        assert_eq!(range(std::slice::from_ref(&s), false), [0.0, 3.0]);
        assert_eq!(s.colour(3, [0.0, 3.0], &GREY), [255; 3]);
        s.components = vec![vec![0.0; 4], vec![0.5; 4], vec![1.0; 4]];
        assert_eq!(s.colour(0, [0.0, 1.0], &GREY), [0, 128, 255]);
        let pale = Slice { components: vec![vec![0.25; 4], vec![0.5; 4], vec![0.75; 4]], ..test_slice(2, 2, [1.0; 2]) };
        assert_eq!(range(&[pale], false), [0.0, 1.0]);
        let canvas = draw(&[s], [0.0, 1.0], &VIRIDIS);
        assert_eq!(canvas.pixels.len(), canvas.width * canvas.height * 3);
        let lit = |x: usize, y: usize| canvas.pixels[(y * canvas.width + x) * 3 + 2];
        assert_eq!(lit(GAP + 5, 2 * GAP + 14 + 5), 255);
    }
}
