//! What window kernels leave to the graph: how a missing voxel is marked in an integer channel, and the `fill` of an
//! openness that nothing defines.

use super::value::{Comp, Value};
use crate::brick::Voxels;
use crate::grid::{AnyView, Region, Voxel};
use crate::plan::graph::Wire;

/// Integer outputs (min, max) of a missing voxel hold the missing value, so that later stages see it as missing.
pub fn missing(wires: &[&Wire], input: &Value, comp: usize, input_wire: &Wire, outputs: &mut [Value], region: Region) {
    let Some(missing) = input_wire.missing else { return };
    for (wire, value) in wires.iter().zip(outputs) {
        if wire.dtype.is_float() || wire.missing.is_none() {
            continue;
        }
        if let Comp::Voxels(out) = &mut value.comps[comp] {
            replace(out, input.view(comp, region), region, missing as f64, |_, v| v == missing as f64);
        }
    }
}

/// Openness that no limit defines (both infinities in its window) is `fill`: NaN stands for missing voxels alone.
pub fn undefined(
    wires: &[&Wire],
    input: &Value,
    comp: usize,
    input_wire: &Wire,
    outputs: &mut [Value],
    region: Region,
) {
    if !input_wire.dtype.is_float() {
        return;
    }
    for (wire, value) in wires.iter().zip(outputs).filter(|(w, _)| w.channel == "openness" && w.dtype.is_float()) {
        match &mut value.comps[comp] {
            Comp::Voxels(out) if any_nan(out) => {
                replace(out, input.view(comp, region), region, wire.fill, |o, v| o.is_nan() && !v.is_nan());
            }
            _ => {}
        }
    }
}

fn any_nan(voxels: &Voxels) -> bool {
    crate::with_voxels!(voxels, v => v.iter().fold(false, |any, o| any | o.to_f64().is_nan()))
}

/// Sets `out` where `wanted` says so of its value and the input's.
fn replace(out: &mut Voxels, src: AnyView, region: Region, value: f64, wanted: impl Fn(f64, f64) -> bool) {
    fn set<T: Voxel>(out: &mut [T], src: AnyView, shape: [usize; 3], value: f64, wanted: impl Fn(f64, f64) -> bool) {
        let [nz, ny, nx] = shape;
        let voxels = (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [z, y, x])));
        for (o, at) in out.iter_mut().zip(voxels) {
            if wanted(o.to_f64(), src.at_f64(at)) {
                *o = T::from_f64(value);
            }
        }
    }
    crate::with_voxels!(out, v => set(v, src, region.shape(), value, wanted));
}
