//! Numbers that need a pass over the whole volume: largest value, value range.

use std::sync::Mutex;

use super::compute::Finished;
use super::sketch::Sketch;
use super::value::Comp;
use crate::grid::{AnyView, Region, Shape, Voxel};
use crate::kernel::values::missing_as;
use crate::plan::graph::WireId;
use crate::plan::{Plan, Prepass, PrepassKind};

/// What a pre-pass collects.
#[derive(Debug)]
pub enum Finder {
    MinMax(MinMax),
    Levels(Sketch),
}

impl Finder {
    pub fn new(plan: &Plan, prepass: &Prepass, volume: Shape) -> Finder {
        match prepass.kind {
            PrepassKind::Levels { .. } => Finder::Levels(Sketch::new(plan.graph.wires[prepass.wires[0]].dtype, volume)),
            PrepassKind::Max | PrepassKind::MinMax => Finder::MinMax(MinMax::default()),
        }
    }

    /// Takes in a finished brick's wires.
    pub fn add(&self, plan: &Plan, wires: &[WireId], done: &Finished) {
        match self {
            Finder::MinMax(found) => found.add(plan, wires, done),
            Finder::Levels(sketch) => sketch.add(plan, wires, done),
        }
    }

    /// The numbers that steps and outputs read.
    pub fn result(self, kind: PrepassKind) -> Vec<f64> {
        match (self, kind) {
            (Finder::Levels(sketch), PrepassKind::Levels { count, flipped, beyond }) => {
                sketch.levels(count, flipped, beyond).to_numbers()
            }
            (Finder::MinMax(found), kind) => found.result(kind).to_vec(),
            (Finder::Levels(_), _) => Vec::new(),
        }
    }
}

/// Least and largest value so far of finite voxels that are not missing: an infinity would leave nothing of all others.
/// Order never matters.
#[derive(Debug)]
pub struct MinMax(Mutex<[f64; 2]>);

impl Default for MinMax {
    fn default() -> Self {
        MinMax(Mutex::new([f64::INFINITY, f64::NEG_INFINITY]))
    }
}

impl MinMax {
    /// Takes in a finished brick's wires.
    pub fn add(&self, plan: &Plan, wires: &[WireId], done: &Finished) {
        let mut found = [f64::INFINITY, f64::NEG_INFINITY];
        for &w in wires {
            let (value, wire) = (done.value(w), &plan.graph.wires[w]);
            for (c, comp) in value.comps.iter().enumerate() {
                let part = match comp {
                    Comp::Const(v) => {
                        (v.is_finite() && wire.missing.is_none_or(|m| m as f64 != *v)).then_some([*v, *v])
                    }
                    Comp::Voxels(_) => extremes(value.view(c, done.brick), wire.missing),
                };
                if let Some([a, b]) = part.map(|p| p.map(|v| wire.affine.apply(v))) {
                    found = [found[0].min(a).min(b), found[1].max(a).max(b)];
                }
            }
        }
        let mut all = self.0.lock().unwrap_or_else(|e| e.into_inner());
        *all = [all[0].min(found[0]), all[1].max(found[1])];
    }

    /// The result; `Max` of nothing is 0.
    pub fn result(self, kind: PrepassKind) -> [f64; 2] {
        let found = self.0.into_inner().unwrap_or_else(|e| e.into_inner());
        match (kind, found[0] <= found[1]) {
            (_, true) => found,
            (PrepassKind::Max, false) => [0.0, 0.0],
            (_, false) => [0.0, 1.0],
        }
    }
}

/// Least and largest stored value of a view, or `None` where nothing counts.
fn extremes(view: AnyView, missing: Option<i64>) -> Option<[f64; 2]> {
    fn run<T: Voxel>(v: crate::grid::View<T>, missing: Option<i64>) -> Option<[f64; 2]> {
        let missing = missing_as::<T>(missing);
        let mut found: Option<[T; 2]> = None;
        for i in Region::new([0; 3], [v.shape[0] as i64, v.shape[1] as i64, 1]).iter() {
            for &x in v.row_at(i[0] as usize, i[1] as usize) {
                if !x.to_f64().is_finite() || missing == Some(x) {
                    continue;
                }
                found = Some(match found {
                    None => [x, x],
                    Some([a, b]) => [if x < a { x } else { a }, if x > b { x } else { b }],
                });
            }
        }
        found.map(|f| f.map(T::to_f64))
    }
    crate::with_view!(AnyView, view, v => run(v, missing))
}
