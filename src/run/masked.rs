//! Window kernels under a mask: run on boxes around what is needed, where those are cheaper than the whole brick. A result does
//! not depend on the box that it is computed in, so only the time shows.

use super::steps::{Engine, MaskValue, Piece, view_mut};
use super::value::Value;
use super::windowed::Windowed;
use crate::grid::{AnyViewMut, DType, View};
use crate::kernel::mask::{Cost, Part, Sight, boxes};
use crate::kernel::rank;
use crate::plan::graph::{Step, StepKind};

impl Engine<'_> {
    /// Boxes of a step's output to compute: all of it on the GPU, where every submission takes its time.
    pub(super) fn parts(&self, piece: Piece, src: &Windowed) -> Vec<Part> {
        let Piece { id, step, mask, region, .. } = piece;
        match mask {
            MaskValue::Some(needed) if self.skip && !self.plan.on_gpu(id) => {
                let sight = Sight { src: src.view().shape(), at: src.at, reach: step.reach };
                boxes(&View::dense(needed, region.shape()), &sight, &cost(step, src.view().dtype()))
            }
            _ => vec![Part { lo: [0; 3], shape: region.shape() }],
        }
    }
}

/// A component of every output, cut to a part.
pub(super) fn views_of<'v>(outputs: &'v mut [Value], comp: usize, part: &Part) -> Vec<AnyViewMut<'v>> {
    outputs.iter_mut().map(|value| view_mut(value, comp).part(part.lo, part.shape)).collect()
}

/// What a step's kernel takes, from boxes of 4 x 4 x 16 to 128^3 voxels at radius 5 and 10 on noise over waves (2-core Xeon VM, family
/// 6 model 207, AVX-512, 2026-11-27).
fn cost(step: &Step, dtype: DType) -> Cost {
    let [call, made, seen] = match &step.kind {
        StepKind::Rank { params, shape, .. } => rank::cost(dtype, params, *shape),
        StepKind::Levels { .. } => [10e3, 15.0, 2.0],
        StepKind::Moments4 { .. } => [10e3, 22.0, 1.5],
        StepKind::Gaussian { channels, .. } if channels.len() == 1 && !dtype.is_float() => [5e3, 2.5, 0.6],
        StepKind::Gaussian { .. } => [5e3, 7.0, 1.5],
        StepKind::Gradient { size, .. } => [2e3, (size * size) as f64 / 2.0, 0.5],
        _ if dtype.is_float() => [5e3, 8.0, 1.5],
        _ => [5e3, 2.0, 0.5],
    };
    Cost { call, made, seen }
}
