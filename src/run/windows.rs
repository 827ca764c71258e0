//! Display windows for viewers (`omero`): percentiles of the full resolution as it was written. Those of a coarse level, whose
//! means are alike, would leave a third of the voxels of an occlusion map outside.

use crate::brick::Voxels;
use crate::config::{Input, InputKind, Place, Select};
use crate::grid::Region;
use crate::plan::OutputPlan;
use crate::store::Source;
use crate::store::source::ChunkRead;

/// Share of voxels that may lie beyond each end.
const TAIL: f64 = 0.01;
/// Voxels decoded per component at most, about: larger volumes are sampled by whole chunks.
const DECODED: usize = 4 << 20;
/// Values that a window is chosen from, about: each of its percentiles then lies within 0.05 percent of the voxels decoded.
const CHOSEN: usize = 1 << 17;

/// One window per component, in the units of the stored numbers. What cannot be read gets the type's range: a window is a
/// convenience, never a reason to fail.
pub fn of_output(output: &OutputPlan) -> Vec<[f64; 2]> {
    let components = output.spec.components.unwrap_or(1);
    let fallback = if output.spec.dtype.is_float() { [0.0, 1.0] } else { output.spec.dtype.range().into() };
    let source = if output.is_zarr() { Source::open(&written(output)).ok() } else { None };
    let mut windows: Vec<[f64; 2]> =
        (0..components).map(|c| source.as_ref().and_then(|s| window(s, c)).unwrap_or(fallback)).collect();
    share_of_colours(&output.spec.component_names, fallback, &mut windows);
    windows
}

/// The three parts of a colour share one window, which holds `whole`: stretched each for itself they are other colours.
fn share_of_colours(names: &[String], whole: [f64; 2], windows: &mut [[f64; 2]]) {
    let is = |name: &String, part: &str| name.rsplit(' ').next() == Some(part);
    for i in 0..names.len().min(windows.len()).saturating_sub(2) {
        if ["red", "green", "blue"].iter().zip(&names[i..]).all(|(part, name)| is(name, part)) {
            let of = &mut windows[i..i + 3];
            let shared = of.iter().fold(whole, |s, w| [s[0].min(w[0]), s[1].max(w[1])]);
            of.fill(shared);
        }
    }
}

fn written(output: &OutputPlan) -> Input {
    Input {
        name: output.spec.name.clone(),
        place: Place::default(),
        kind: InputKind::Path { path: output.spec.path.clone(), raw: None },
        level: 0,
        array: None,
        channel: Select::All,
        time: Select::Index(0),
        spacing: None,
        unit: None,
        origin: None,
        slope: None,
        intercept: None,
        nodata: None,
    }
}

/// The values that cut off [`TAIL`] at each end.
fn window(source: &Source, component: usize) -> Option<[f64; 2]> {
    let info = source.info();
    let chunk = info.chunk?;
    let whole = Region::whole(info.shape);
    let cells: Vec<[i64; 3]> = whole.cells([0; 3], chunk).iter().collect();
    let step = (info.voxels() / DECODED + 1).min(cells.len().max(1));
    // Odd, so that it meets every column of rows whose length is a power of two.
    let stride = (info.voxels().min(DECODED) / CHOSEN) | 1;
    let mut voxels = Voxels::zeroed(info.dtype, chunk.iter().product());
    let mut values = Vec::new();
    for index in cells.into_iter().step_by(step) {
        let part = Region::of_cell(index, [0; 3], chunk).clip(&whole);
        match source.read_chunk(component, index, &mut voxels).ok()? {
            ChunkRead::Missing(v) => values.extend(std::iter::repeat_n(v, part.voxels().div_ceil(stride))),
            ChunkRead::Data { .. } => {
                let (view, n) = (voxels.view(chunk), part.shape());
                let places = (0..part.voxels()).step_by(stride).map(|i| [i / (n[1] * n[2]), i / n[2] % n[1], i % n[2]]);
                values.extend(places.map(|at| view.at_f64(at)));
            }
        }
    }
    values.retain(|v| v.is_finite());
    let last = values.len().checked_sub(1)?;
    let mut at = |share: f64| *values.select_nth_unstable_by((share * last as f64).round() as usize, f64::total_cmp).1;
    let (lo, hi) = (at(TAIL), at(1.0 - TAIL));
    // Far from 0 one more is no more.
    Some(if hi > lo { [lo, hi] } else { [lo, lo + lo.abs().max(1e6) * 1e-6] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_not_stretched_apart() {
        let names = ["ao.openness", "t.rgb red", "t.rgb green", "t.rgb blue", "red", "green"].map(String::from);
        let own = [[0.4, 0.5], [0.1, 0.2], [-0.5, 0.3], [0.0, 2.0], [0.1, 0.2], [0.3, 0.4]];
        let mut windows = own;
        share_of_colours(&names, [0.0, 1.0], &mut windows);
        assert_eq!(windows, [own[0], [-0.5, 2.0], [-0.5, 2.0], [-0.5, 2.0], own[4], own[5]]);
        share_of_colours(&[], [0.0, 1.0], &mut windows[..1]);
        assert_eq!(windows[0], own[0]);
    }
}
