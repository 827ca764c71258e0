//! Estimators that count: `levels` against its formula, and whether the bounds of `moments4` hold the exact count.

use super::exact::place;
use super::fields::Field;
use occlude::brick::{Scratch, Voxels};
use occlude::grid::{Affine, Shape};
use occlude::kernel::levels::{self, Levels};
use occlude::kernel::moments4::{self, BoundOut, Codes};
use occlude::kernel::simd::Level;
use occlude::kernel::{Context, rank};
use occlude::stage::{Bound, Ties, WindowParams, WindowShape};
use occlude::with_view;

/// What was found at the sampled voxels of a field.
#[derive(Debug, Clone, Default)]
pub struct Counted {
    /// Largest difference of `levels` from its formula.
    pub levels: f64,
    /// Voxels whose exact count lies outside the bounds, or that are NaN and should not be, or the reverse.
    pub outside: usize,
    /// Mean difference of the bounds.
    pub width: f64,
    /// Root mean square of the middle's difference from the exact count.
    pub middle: f64,
    pub samples: usize,
}

/// Both methods on the best level of this CPU, ties `mid`.
pub fn measure(field: &Field) -> Counted {
    let (volume, shape) = (field.voxels(), field.shape);
    let params = WindowParams { radius: field.radius, affine: Affine::IDENTITY, missing: None, solid_low: false };
    let values = values(&volume);
    let chosen = Levels::choose(&values, 32);
    let by_levels = run(&volume, |scratch, out| {
        levels::levels(volume.view(shape), &chosen, &params, Ties::Mid, [0; 3], out.view_mut(shape), &mut cx(scratch));
    });
    let exact = run(&volume, |scratch, out| {
        let box_ = WindowShape::Box;
        rank::rank(volume.view(shape), &params, box_, Ties::Mid, [0; 3], out.view_mut(shape), &mut cx(scratch));
    });
    let codes = Codes::new(&Levels::choose(&values, levels::MOST_LEVELS));
    let [lower, middle, upper] = [Bound::Lower, Bound::Openness, Bound::Upper].map(|channel| {
        run(&volume, |scratch, out| {
            let mut outs = [BoundOut { channel, dst: out.view_mut(shape) }];
            moments4::moments4(
                volume.view(shape),
                Some(&codes),
                &params,
                Ties::Mid,
                [0; 3],
                &mut outs,
                &mut cx(scratch),
            );
        })
    });
    let mut found = Counted::default();
    let mut squares = 0.0;
    for i in field.samples() {
        found.samples += 1;
        let (l, m, u, e) = (lower.at(i), middle.at(i), upper.at(i), exact.at(i));
        let formula = formula(&volume, shape, i, &chosen, &params);
        if volume.at(i).is_nan() {
            found.outside += usize::from(!(l.is_nan() && u.is_nan() && m.is_nan()));
            continue;
        }
        found.levels = found.levels.max((by_levels.at(i) - formula).abs());
        let holds = 0.0 <= l && l <= e && e <= u && u <= 1.0 && l <= m && m <= u && !by_levels.at(i).is_nan();
        found.outside += usize::from(!holds);
        found.width += u - l;
        squares += (m - e) * (m - e);
    }
    found.width /= found.samples as f64;
    found.middle = (squares / found.samples as f64).sqrt();
    found
}

fn cx(scratch: &mut Scratch) -> Context<'_> {
    Context { level: Level::detect(), scratch }
}

fn run(volume: &Voxels, kernel: impl FnOnce(&mut Scratch, &mut Voxels)) -> Voxels {
    let mut out = Voxels::zeroed(volume.dtype().result(), volume.len());
    kernel(&mut Scratch::new(), &mut out);
    out
}

fn formula(volume: &Voxels, shape: Shape, i: usize, chosen: &Levels, params: &WindowParams) -> f64 {
    with_view!(AnyView, volume.view(shape), v => levels::reference::voxel(v, place(shape, i), chosen, params, Ties::Mid))
}

/// Finite values with their numbers.
fn values(volume: &Voxels) -> Vec<(f64, u64)> {
    let mut all: Vec<f64> = (0..volume.len()).map(|i| volume.at(i) + 0.0).filter(|v| v.is_finite()).collect();
    all.sort_by(f64::total_cmp);
    all.chunk_by(|a, b| a == b).map(|group| (group[0], group.len() as u64)).collect()
}
