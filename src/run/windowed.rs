//! What windows see: a step's input grown by its reach, clipped to the volume or extended by the border rule.

use super::steps::{Engine, Piece};
use super::value::Value;
use crate::brick::{Pool, Voxels, gather};
use crate::grid::{Affine, AnyView, AnyViewMut, Border, Region, Shape, Voxel};
use crate::kernel::mask::{Part, Sight};
use crate::kernel::pointwise;

/// A kernel's input with the place of the output box in it.
pub(super) struct Windowed<'a> {
    src: Src<'a>,
    pub at: [usize; 3],
    /// The output box's first voxel in the volume.
    pub voxel: [i64; 3],
    pub affine: Affine,
    pub missing: Option<i64>,
}

enum Src<'a> {
    Borrowed(AnyView<'a>),
    Owned(Voxels, Shape),
}

impl Windowed<'_> {
    pub fn view(&self) -> AnyView<'_> {
        match &self.src {
            Src::Borrowed(v) => *v,
            Src::Owned(v, shape) => v.view(*shape),
        }
    }

    /// What the windows of a part of the output box see.
    pub fn part(&self, part: &Part, reach: [usize; 3]) -> Windowed<'_> {
        let seen = Sight { src: self.view().shape(), at: self.at, reach }.of(part);
        Windowed {
            src: Src::Borrowed(self.view().part(seen.lo, seen.shape)),
            at: std::array::from_fn(|a| self.at[a] + part.lo[a] - seen.lo[a]),
            voxel: std::array::from_fn(|a| self.voxel[a] + part.lo[a] as i64),
            ..*self
        }
    }

    pub fn recycle(self, pool: &Pool) {
        if let Src::Owned(v, _) = self.src {
            pool.put(v);
        }
    }
}

impl Engine<'_> {
    /// The input of a window kernel: the box grown by the reach, clipped or extended by the border rule. Where the step's
    /// border makes floats of the voxels it does so everywhere, so that a brick at the edge has the bits of one inside.
    /// `border` is the step's, or what stands for it around a constant.
    pub(super) fn windowed<'v>(&self, piece: Piece, border: Border, value: &'v Value, comp: usize) -> Windowed<'v> {
        let Piece { step, region, volume, .. } = piece;
        let wire = &self.plan.graph.wires[step.inputs[0]];
        let wanted = region.grow(step.reach);
        let inside = wanted.clip(&volume);
        let whole = Windowed {
            src: Src::Borrowed(value.view(comp, inside)),
            at: inside.offset_of(&region),
            voxel: region.lo,
            affine: wire.affine,
            missing: wire.missing,
        };
        let (outside, promote) = wire.beyond(step.border);
        if !promote && (border == Border::Clip || wanted == inside) {
            return whole;
        }
        // What the rule reads lies in the value's box: clamped and mirrored indices stay within the reach of the edge.
        let src = value.view(comp, value.region);
        let at = wanted.offset_of(&region);
        let mut padded;
        let (dtype, missing) = if promote { (wire.dtype.result(), None) } else { (wire.dtype, wire.missing) };
        if promote {
            let mut floats = self.pool.take(dtype, value.region.voxels());
            pointwise::scale(src, Affine::IDENTITY, wire.missing, floats.view_mut(value.region.shape()));
            padded = self.pool.take(dtype, wanted.voxels());
            extend_any(floats.view(value.region.shape()), value.region, &mut padded, wanted, volume, border, outside);
            self.pool.put(floats);
        } else {
            padded = self.pool.take(dtype, wanted.voxels());
            extend_any(src, value.region, &mut padded, wanted, volume, border, outside);
        }
        Windowed { src: Src::Owned(padded, wanted.shape()), at, voxel: region.lo, affine: wire.affine, missing }
    }
}

fn extend_any(
    src: AnyView,
    src_box: Region,
    dst: &mut Voxels,
    dst_box: Region,
    volume: Region,
    border: Border,
    outside: f64,
) {
    macro_rules! arms {
        ($($t:ident: $ty:ty),*) => {
            match (src, dst.view_mut(dst_box.shape())) {
                $((AnyView::$t(s), AnyViewMut::$t(d)) => {
                    gather::extend(s, src_box, d, dst_box, volume, border, <$ty>::from_f64(outside))
                })*
                _ => unreachable!("a padded brick has its input's type"),
            }
        };
    }
    arms!(U8: u8, I8: i8, U16: u16, I16: i16, U32: u32, I32: i32, F32: f32, F64: f64)
}
