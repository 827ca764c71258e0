//! The dataflow graph by index: wires (one channel each) and the steps that make them. Pruned to what outputs read;
//! stages that share a pass are one step.

use std::sync::Arc;

use crate::config::WhereRule;
use crate::grid::{Affine, Border, DType};
use crate::kernel::obscurance::Prepared;
use crate::stage::{
    Bound, CombineKind, GradientWeight, Ties, TransferPoint, WindowChannel, WindowMode, WindowParams, WindowShape,
};

/// Index into [`Graph::wires`].
pub type WireId = usize;
/// Index into [`Graph::steps`].
pub type StepId = usize;
/// Index into [`super::Plan::prepasses`]: a number known only after a pass over the whole volume.
pub type GlobalId = usize;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Producer {
    /// Index into the config's inputs.
    Input(usize),
    Step(StepId),
}

/// One channel on its way between stages.
#[derive(Debug, Clone)]
pub struct Wire {
    /// As the user writes it: `ct`, `stats.variance`.
    pub name: String,
    /// The channel's own name: `variance`; an input's is `value`.
    pub channel: String,
    pub producer: Producer,
    pub components: usize,
    pub component_names: Vec<String>,
    pub dtype: DType,
    /// Stored to scaled values; not the identity only on inputs.
    pub affine: Affine,
    /// Stored value of missing voxels of integer inputs.
    pub missing: Option<i64>,
    /// Value of voxels that the stage's `where` excludes.
    pub fill: f64,
    /// The wire's lattice: index into [`Graph::lattices`].
    pub lattice: usize,
    /// Voxels beyond the brick that outputs need: an occlusion map makes its levels of them.
    pub sink_halo: [usize; 3],
    /// Voxels beyond the brick that consumers need, outputs among them.
    pub halo: [usize; 3],
}

impl Wire {
    /// The stored value beyond the edge of the volume for a constant border, and whether this wire's type cannot hold it
    /// (the window then runs on floats).
    pub fn beyond(&self, border: Border) -> (f64, bool) {
        let Border::Constant(v) = border else { return (0.0, false) };
        let stored = self.affine.invert(v);
        let (lo, hi) = self.dtype.range();
        let whole = stored.fract() == 0.0 && (lo..=hi).contains(&stored);
        (stored, !self.dtype.is_float() && (!whole || self.missing == Some(stored as i64)))
    }

    /// Element type of the scaled values, with NaN for missing voxels where there may be any.
    pub fn scaled_dtype(&self) -> DType {
        if self.affine.is_identity() && self.missing.is_none() { self.dtype } else { self.dtype.result() }
    }
}

/// A stage's mask, prepared.
#[derive(Debug, Clone, PartialEq)]
pub struct Mask {
    pub wire: WireId,
    pub rule: WhereRule,
    /// Voxels of the mask's wire needed beyond the masked box.
    pub reach: [usize; 3],
}

/// One pass over a brick.
#[derive(Debug, Clone)]
pub struct Step {
    /// Names of the stages that it serves.
    pub stages: Vec<String>,
    pub kind: StepKind,
    pub inputs: Vec<WireId>,
    pub outputs: Vec<WireId>,
    /// Voxels of input needed beyond the output box.
    pub reach: [usize; 3],
    pub border: Border,
    pub mask: Option<Mask>,
    /// Voxels beyond the brick that the step computes: the largest of its outputs'.
    pub halo: [usize; 3],
    /// The first input is read box by box while the step runs, instead of with its reach, out of this wire: itself, or the
    /// input that a transfer makes it of. See [`super::streams`].
    pub streamed: Option<WireId>,
}

/// What a step computes; `channel` lists go with [`Step::outputs`].
#[derive(Debug, Clone)]
pub enum StepKind {
    Window {
        params: WindowParams,
        channels: Vec<WindowChannel>,
    },
    Rank {
        params: WindowParams,
        shape: WindowShape,
        ties: Ties,
    },
    /// Openness by quantile levels that a pre-pass found.
    Levels {
        params: WindowParams,
        levels: GlobalId,
        ties: Ties,
    },
    /// Openness and its bounds from four power moments.
    Moments4 {
        params: WindowParams,
        /// Levels from which codes are made, where the type is wider than 16 bits.
        codes: Option<GlobalId>,
        ties: Ties,
        channels: Vec<Bound>,
    },
    Gaussian {
        sigma: [f64; 3],
        channels: Vec<Moment>,
    },
    Gradient {
        size: usize,
        weight: GradientWeight,
        spacing: [f64; 3],
        channels: Vec<GradientChannel>,
        /// Of stored values (for normals, whose sign the sweep takes from its own parameters), not of scaled ones.
        stored: bool,
    },
    Transfer {
        points: Vec<TransferPoint>,
        channels: Vec<TransferChannel>,
    },
    OpennessWindow {
        low: f64,
        high: f64,
        mode: WindowMode,
    },
    ModulateByVariance {
        sigma_max2: f64,
    },
    ModulateBySaliency {
        threshold: f64,
        gain: f64,
    },
    AmbientLight {
        k: f64,
    },
    Combine {
        kind: CombineKind,
    },
    /// Inputs: density, then colour and normal where present.
    Obscurance {
        /// Made for this volume: planning asks it again and again.
        sweep: Arc<Prepared>,
        channels: Vec<ObscuranceChannel>,
        colour: Option<WireId>,
        normal: Option<WireId>,
    },
    /// Divides by a number from a pre-pass (0 stays 0).
    Divide {
        by: GlobalId,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    Mean,
    Variance,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GradientChannel {
    Magnitude,
    Vector,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransferChannel {
    Opacity,
    Rgb,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ObscuranceChannel {
    Openness,
    Rgb,
}

/// Where voxels lie.
#[derive(Debug, Clone, PartialEq)]
pub struct Lattice {
    /// The input that it came from.
    pub input: usize,
    pub shape: [usize; 3],
    pub spacing: [f64; 3],
    pub origin: [f64; 3],
    pub unit: Option<String>,
}

#[derive(Debug, Clone, Default)]
pub struct Graph {
    pub wires: Vec<Wire>,
    /// In an order in which every step follows those that it reads.
    pub steps: Vec<Step>,
    pub lattices: Vec<Lattice>,
}

impl Graph {
    /// Demands halos from consumers to producers: a wire's halo is the largest of its consumers' plus their reach.
    pub fn demand_halos(&mut self) {
        self.wires.iter_mut().for_each(|w| w.halo = w.sink_halo);
        self.steps.iter_mut().for_each(|s| s.halo = [0; 3]);
        for s in (0..self.steps.len()).rev() {
            let outputs = self.steps[s].outputs.clone();
            let mut halo = self.steps[s].halo;
            for w in outputs {
                halo = max3(halo, self.wires[w].halo);
            }
            self.steps[s].halo = halo;
            let reach = self.steps[s].reach;
            // Colour is read where occluders are, a normal only where the output is.
            let point = match &self.steps[s].kind {
                StepKind::Obscurance { normal, .. } => *normal,
                _ => None,
            };
            let fetched = self.steps[s].streamed.map(|_| self.steps[s].inputs[0]);
            for w in self.steps[s].inputs.clone() {
                let need = if Some(w) == point || Some(w) == fetched { halo } else { add3(halo, reach) };
                self.wires[w].halo = max3(self.wires[w].halo, need);
            }
            if let Some(mask) = &self.steps[s].mask {
                let (w, need) = (mask.wire, add3(halo, mask.reach));
                self.wires[w].halo = max3(self.wires[w].halo, need);
            }
        }
    }
}

pub fn max3(a: [usize; 3], b: [usize; 3]) -> [usize; 3] {
    std::array::from_fn(|i| a[i].max(b[i]))
}

pub fn add3(a: [usize; 3], b: [usize; 3]) -> [usize; 3] {
    std::array::from_fn(|i| a[i] + b[i])
}

impl StepKind {
    /// Short name for plans, reports and traces.
    pub fn name(&self) -> &'static str {
        match self {
            StepKind::Window { .. } => "window",
            StepKind::Rank { .. } => "rank",
            StepKind::Levels { .. } => "levels",
            StepKind::Moments4 { .. } => "moments4",
            StepKind::Gaussian { .. } => "gaussian",
            StepKind::Gradient { .. } => "gradient",
            StepKind::Transfer { .. } => "transfer",
            StepKind::OpennessWindow { .. } => "openness_window",
            StepKind::ModulateByVariance { .. } => "modulate_by_variance",
            StepKind::ModulateBySaliency { .. } => "modulate_by_saliency",
            StepKind::AmbientLight { .. } => "ambient_light",
            StepKind::Combine { .. } => "combine",
            StepKind::Obscurance { .. } => "obscurance",
            StepKind::Divide { .. } => "divide",
        }
    }
}
