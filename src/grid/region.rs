//! Half-open boxes of voxels and their algebra.

use std::fmt;

/// Voxels per axis, `[z, y, x]`.
pub type Shape = [usize; 3];

/// Half-open box `lo..hi` in global voxel indices, `[z, y, x]`. Signed, so that a box may be grown past the volume.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Region {
    pub lo: [i64; 3],
    pub hi: [i64; 3],
}

impl Region {
    pub fn new(lo: [i64; 3], hi: [i64; 3]) -> Region {
        Region { lo, hi }
    }

    /// The whole volume of a shape.
    pub fn whole(shape: Shape) -> Region {
        Region { lo: [0; 3], hi: shape.map(|n| n as i64) }
    }

    pub fn is_empty(&self) -> bool {
        (0..3).any(|a| self.hi[a] <= self.lo[a])
    }

    /// Voxels per axis; an empty box has zeros.
    pub fn shape(&self) -> Shape {
        std::array::from_fn(|a| (self.hi[a] - self.lo[a]).max(0) as usize)
    }

    pub fn voxels(&self) -> usize {
        self.shape().iter().product()
    }

    /// Grown by `by` voxels on both sides of each axis.
    pub fn grow(&self, by: [usize; 3]) -> Region {
        Region {
            lo: std::array::from_fn(|a| self.lo[a] - by[a] as i64),
            hi: std::array::from_fn(|a| self.hi[a] + by[a] as i64),
        }
    }

    /// The common part, possibly empty.
    pub fn clip(&self, to: &Region) -> Region {
        let lo: [i64; 3] = std::array::from_fn(|a| self.lo[a].max(to.lo[a]));
        Region { lo, hi: std::array::from_fn(|a| self.hi[a].min(to.hi[a]).max(lo[a])) }
    }

    /// The least box that holds both; an empty one counts for nothing.
    pub fn union(&self, other: &Region) -> Region {
        if self.is_empty() {
            return *other;
        }
        if other.is_empty() {
            return *self;
        }
        Region {
            lo: std::array::from_fn(|a| self.lo[a].min(other.lo[a])),
            hi: std::array::from_fn(|a| self.hi[a].max(other.hi[a])),
        }
    }

    pub fn shift(&self, by: [i64; 3]) -> Region {
        Region { lo: std::array::from_fn(|a| self.lo[a] + by[a]), hi: std::array::from_fn(|a| self.hi[a] + by[a]) }
    }

    pub fn contains(&self, other: &Region) -> bool {
        other.is_empty() || (0..3).all(|a| self.lo[a] <= other.lo[a] && other.hi[a] <= self.hi[a])
    }

    /// Offset of `inner.lo` from `self.lo`. Panics if `inner` starts before `self`.
    pub fn offset_of(&self, inner: &Region) -> [usize; 3] {
        std::array::from_fn(|a| usize::try_from(inner.lo[a] - self.lo[a]).expect("the inner box starts inside"))
    }

    /// Cells of the regular grid (edge `cell`, anchored at `origin`) that touch this box, as a box of cell indices.
    pub fn cells(&self, origin: [i64; 3], cell: Shape) -> Region {
        if self.is_empty() {
            return Region::new([0; 3], [0; 3]);
        }
        Region {
            lo: std::array::from_fn(|a| (self.lo[a] - origin[a]).div_euclid(cell[a] as i64)),
            hi: std::array::from_fn(|a| (self.hi[a] - 1 - origin[a]).div_euclid(cell[a] as i64) + 1),
        }
    }

    /// The box of grid cell `index` (edge `cell`, anchored at `origin`), not clipped.
    pub fn of_cell(index: [i64; 3], origin: [i64; 3], cell: Shape) -> Region {
        let lo: [i64; 3] = std::array::from_fn(|a| origin[a] + index[a] * cell[a] as i64);
        Region { lo, hi: std::array::from_fn(|a| lo[a] + cell[a] as i64) }
    }

    /// All indices of the box, x fastest.
    pub fn iter(&self) -> impl Iterator<Item = [i64; 3]> + use<> {
        let r = *self;
        (r.lo[0]..r.hi[0])
            .flat_map(move |z| (r.lo[1]..r.hi[1]).flat_map(move |y| (r.lo[2]..r.hi[2]).map(move |x| [z, y, x])))
    }
}

impl fmt::Debug for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [z, y, x] = std::array::from_fn(|a| (self.lo[a], self.hi[a]));
        write!(f, "[{}..{}, {}..{}, {}..{}]", z.0, z.1, y.0, y.1, x.0, x.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clip_of_disjoint_boxes_is_empty_and_has_no_negative_size() {
        let a = Region::new([0, 0, 0], [4, 4, 4]);
        let b = Region::new([6, 0, 0], [9, 4, 4]);
        assert!(a.clip(&b).is_empty());
        assert_eq!(a.clip(&b).voxels(), 0);
    }

    #[test]
    fn cells_cover_the_box_exactly() {
        let r = Region::new([-3, 5, 64], [1, 6, 129]);
        assert_eq!(r.cells([0; 3], [64; 3]), Region::new([-1, 0, 1], [1, 1, 3]));
        let covered = r.cells([0; 3], [64; 3]).iter().map(|i| Region::of_cell(i, [0; 3], [64; 3]).clip(&r).voxels());
        assert_eq!(covered.sum::<usize>(), r.voxels());
    }
}
