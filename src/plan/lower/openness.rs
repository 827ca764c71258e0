//! Stages of ambient occlusion: which kernel serves a method.

use super::{Lowering, lengths};
use crate::Result;
use crate::config::{AoRegion, Op, StageNode};
use crate::grid::Border;
use crate::kernel::levels::MOST_LEVELS;
use crate::kernel::moments4;
use crate::plan::PrepassKind;
use crate::plan::graph::StepKind;
use crate::plan::memory::window_dtype;
use crate::stage::{Bound, Method, WindowChannel, WindowShape};

impl Lowering<'_> {
    /// A stage whose `op` is [`Op::AmbientOcclusion`].
    pub(super) fn openness(&mut self, index: usize, node: &StageNode, wanted: &[&'static str]) -> Result<()> {
        let Op::AmbientOcclusion { input, radius, method, ties, region, solid_low, level_count } = &node.op else {
            unreachable!("the caller looked at the op")
        };
        let src = self.wire(input, &node.place)?;
        let key = format!("{}.radius", node.place.key);
        let mut radius = lengths::radius(radius, self.lattice(src), &key)?;
        if *region == AoRegion::EqualVolume {
            radius = lengths::equal_volume(radius);
        }
        self.check_window(src, radius, node.border, &key)?;
        let (params, ties) = (self.window_params(src, radius, *solid_low), *ties);
        let kind = match method {
            Method::Exact => {
                let shape = if *region == AoRegion::Ball { WindowShape::Ball } else { WindowShape::Box };
                StepKind::Rank { params, shape, ties }
            }
            Method::Levels => {
                let wire = &self.out.graph.wires[src];
                let beyond = matches!(node.border, Border::Constant(_)).then(|| wire.beyond(node.border).0);
                let kind = PrepassKind::Levels { count: *level_count, flipped: params.flipped(), beyond };
                StepKind::Levels { params, levels: self.prepass(src, kind), ties }
            }
            Method::Moments4 => {
                let wide = moments4::needs_codes(window_dtype(self.out.graph.wires[src].dtype, node.border));
                let kind = PrepassKind::Levels { count: MOST_LEVELS, flipped: false, beyond: None };
                let codes = wide.then(|| self.prepass(src, kind));
                let channels = wanted.iter().map(|c| bound(c)).collect();
                StepKind::Moments4 { params, codes, ties, channels }
            }
            _ => {
                let channels = vec![("openness", WindowChannel::Openness(*method, ties))];
                return self.window(index, node, src, radius, *solid_low, channels);
            }
        };
        self.push_step(index, node, kind, vec![src], radius, node.border, wanted)
    }
}

fn bound(name: &str) -> Bound {
    match name {
        "lower" => Bound::Lower,
        "upper" => Bound::Upper,
        _ => Bound::Openness,
    }
}
