//! Boxes that hold the voxels that are needed: what a kernel is run on where a mask leaves parts of a brick out.

use crate::grid::{Shape, View};

/// What a kernel takes on a box, in nanoseconds: a figure to weigh boxes by, no promise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cost {
    /// Once.
    pub call: f64,
    /// Per voxel that it writes, of rows filled up to whole vectors.
    pub made: f64,
    /// Per voxel that it sees.
    pub seen: f64,
}

/// A box of a mask: first voxel and extents.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part {
    pub lo: [usize; 3],
    pub shape: Shape,
}

/// Voxels of the least boxes: narrower rows fill no vectors.
const LEAST: Shape = [8, 8, 64];
/// Voxels of a vector.
const LANES: usize = 64;

/// What a kernel is given: its source, the place of the mask's box in it, and how far windows reach.
#[derive(Debug, Clone, Copy)]
pub struct Sight {
    pub src: Shape,
    pub at: [usize; 3],
    pub reach: [usize; 3],
}

impl Sight {
    /// First voxel and extents of what the windows of a part see.
    pub fn of(&self, part: &Part) -> Part {
        let lo: [usize; 3] = std::array::from_fn(|a| (self.at[a] + part.lo[a]).saturating_sub(self.reach[a]));
        let end = |a: usize| (self.at[a] + part.lo[a] + part.shape[a]).saturating_add(self.reach[a]).min(self.src[a]);
        Part { lo, shape: std::array::from_fn(|a| end(a) - lo[a]) }
    }
}

impl Cost {
    fn of(&self, part: &Part, sight: &Sight) -> f64 {
        let [z, y, x] = part.shape;
        let seen: f64 = sight.of(part).shape.iter().map(|&n| n as f64).product();
        self.call + self.made * (z * y * x.next_multiple_of(LANES)) as f64 + self.seen * seen
    }
}

/// Disjoint boxes that together hold every needed voxel (1 in the mask, else 0), and are cheaper than the whole; none where
/// nothing is needed. The mask is halved along its longest axis, again and again, and halves are put together where one box
/// around their needed voxels costs no more than two.
pub fn boxes(needed: &View<u8>, sight: &Sight, cost: &Cost) -> Vec<Part> {
    let mut parts = Vec::new();
    halve(needed, Part { lo: [0; 3], shape: needed.shape }, sight, cost, &mut parts);
    parts
}

/// Appends the boxes of a part of the mask; the box around all of them and what they cost, if there are any.
fn halve(needed: &View<u8>, part: Part, sight: &Sight, cost: &Cost, parts: &mut Vec<Part>) -> Option<(Part, f64)> {
    // In least boxes, so that halves end at vectors.
    let cells: [usize; 3] = std::array::from_fn(|a| part.shape[a].div_ceil(LEAST[a]));
    let longest = (0..3).rev().max_by_key(|&a| cells[a]).filter(|&a| cells[a] > 1);
    let Some(axis) = longest else {
        let tight = tight(needed, part)?;
        parts.push(tight);
        return Some((tight, cost.of(&tight, sight)));
    };
    let middle = cells[axis] / 2 * LEAST[axis];
    let (mut low, mut high) = (part, part);
    low.shape[axis] = middle;
    high.lo[axis] += middle;
    high.shape[axis] -= middle;
    let before = parts.len();
    let halves = [halve(needed, low, sight, cost, parts), halve(needed, high, sight, cost, parts)];
    let [Some((a, cost_a)), Some((b, cost_b))] = halves else { return halves.into_iter().flatten().next() };
    let around = around(&a, &b);
    let whole = cost.of(&around, sight);
    if whole <= cost_a + cost_b {
        parts.truncate(before);
        parts.push(around);
    }
    Some((around, whole.min(cost_a + cost_b)))
}

fn around(a: &Part, b: &Part) -> Part {
    let lo: [usize; 3] = std::array::from_fn(|i| a.lo[i].min(b.lo[i]));
    let end = |i: usize| (a.lo[i] + a.shape[i]).max(b.lo[i] + b.shape[i]);
    Part { lo, shape: std::array::from_fn(|i| end(i) - lo[i]) }
}

/// The least box around the needed voxels of a part no wider than [`LEAST`].
fn tight(needed: &View<u8>, part: Part) -> Option<Part> {
    let (mut columns, mut rows, mut planes) = ([0u8; LEAST[2]], [0u8; LEAST[1]], [0u8; LEAST[0]]);
    let [nz, ny, nx] = part.shape;
    for (z, plane) in planes[..nz].iter_mut().enumerate() {
        for (y, line) in rows[..ny].iter_mut().enumerate() {
            let row = &needed.row_at(part.lo[0] + z, part.lo[1] + y)[part.lo[2]..][..nx];
            let mut any = 0;
            for (column, v) in columns.iter_mut().zip(row) {
                *column |= v;
                any |= v;
            }
            *line |= any;
            *plane |= any;
        }
    }
    let ends = |line: &[u8]| Some((line.iter().position(|&v| v != 0)?, line.iter().rposition(|&v| v != 0)? + 1));
    let (z, y, x) = (ends(&planes)?, ends(&rows)?, ends(&columns)?);
    let lo = [part.lo[0] + z.0, part.lo[1] + y.0, part.lo[2] + x.0];
    Some(Part { lo, shape: [z.1 - z.0, y.1 - y.0, x.1 - x.0] })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PER_VOXEL: Cost = Cost { call: 0.0, made: 100.0, seen: 1.0 };
    const BY_SIGHT: Cost = Cost { call: 0.0, made: 1.0, seen: 1.0 };

    fn mask(shape: Shape, mut wanted: impl FnMut([usize; 3]) -> bool) -> Vec<u8> {
        let [nz, ny, nx] = shape;
        let voxels = (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [z, y, x])));
        voxels.map(|v| u8::from(wanted(v))).collect()
    }

    /// Boxes lie inside, are disjoint, and hold every needed voxel.
    fn check(needed: &[u8], shape: Shape, parts: &[Part]) -> usize {
        let mut covered = vec![0u8; needed.len()];
        for part in parts {
            assert!(
                (0..3).all(|a| part.shape[a] > 0 && part.lo[a] + part.shape[a] <= shape[a]),
                "{part:?} in {shape:?}"
            );
            for z in part.lo[0]..part.lo[0] + part.shape[0] {
                for y in part.lo[1]..part.lo[1] + part.shape[1] {
                    let row = (z * shape[1] + y) * shape[2] + part.lo[2];
                    covered[row..row + part.shape[2]].iter_mut().for_each(|c| *c += 1);
                }
            }
        }
        assert!(covered.iter().all(|&c| c <= 1), "boxes overlap");
        assert!(needed.iter().zip(&covered).all(|(n, c)| n <= c), "a needed voxel is left out");
        covered.iter().map(|&c| usize::from(c)).sum()
    }

    fn sight(shape: Shape, r: usize) -> Sight {
        Sight { src: shape.map(|n| n + 2 * r), at: [r; 3], reach: [r; 3] }
    }

    #[test]
    fn boxes_are_disjoint_and_leave_nothing_out() {
        let mut seed = 7u64;
        for shape in [[1, 1, 1], [5, 9, 70], [33, 17, 130], [64, 64, 128], [1, 1, 1000], [40, 1, 3]] {
            for keep in [1, 2, 60, 4000, 65535] {
                let needed = mask(shape, |_| {
                    seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                    (seed >> 48) as usize % 65536 < keep
                });
                for cost in [PER_VOXEL, BY_SIGHT] {
                    check(&needed, shape, &boxes(&View::dense(&needed, shape), &sight(shape, 5), &cost));
                }
            }
        }
    }

    #[test]
    fn empty_masks_have_no_boxes_and_one_voxel_has_its_own() {
        let shape = [20, 30, 140];
        let mut needed = vec![0u8; 20 * 30 * 140];
        assert_eq!(boxes(&View::dense(&needed, shape), &sight(shape, 3), &PER_VOXEL), []);
        needed[(7 * 30 + 29) * 140 + 100] = 1;
        let one = Part { lo: [7, 29, 100], shape: [1, 1, 1] };
        assert_eq!(boxes(&View::dense(&needed, shape), &sight(shape, 3), &PER_VOXEL), [one]);
    }

    /// A thin sphere in a brick: dear voxels are worth many boxes, cheap ones with a wide sight are not.
    #[test]
    fn cost_decides_how_far_a_shell_is_cut_up() {
        let shape = [96, 96, 192];
        let shell = |[z, y, x]: [usize; 3]| {
            let d = [z as f64 - 48.0, y as f64 - 48.0, (x as f64 - 96.0) / 2.0];
            ((d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt() - 40.0).abs() < 2.0
        };
        let needed = mask(shape, shell);
        let view = View::dense(&needed, shape);
        let parts = boxes(&view, &sight(shape, 5), &PER_VOXEL);
        let covered = check(&needed, shape, &parts);
        assert!(parts.len() > 20 && covered * 2 < needed.len(), "{} boxes of {covered} voxels", parts.len());
        let parts = boxes(&view, &sight(shape, 30), &BY_SIGHT);
        assert_eq!(parts.len(), 1, "one box around the shell");
        check(&needed, shape, &parts);
    }

    #[test]
    fn a_part_sees_its_windows_cut_at_the_source() {
        let sight = Sight { src: [10, 10, 10], at: [2, 0, 5], reach: [3, 2, 20] };
        let part = Part { lo: [0, 4, 1], shape: [2, 3, 2] };
        assert_eq!(sight.of(&part), Part { lo: [0, 2, 0], shape: [7, 7, 10] });
    }
}
