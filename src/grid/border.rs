//! What a window sees beyond the edge of the volume.

/// Border rule of a stage. Applied at the edge of the volume only, never at a brick's.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Border {
    /// Only voxels that exist count.
    #[default]
    Clip,
    /// The nearest voxel that exists.
    Nearest,
    /// Half-sample symmetric: `d c b a | a b c d | d c b a`.
    Reflect,
    /// One value, in scaled units.
    Constant(f64),
}

impl Border {
    /// Index in `0..n` whose voxel stands for index `i` of an axis of `n` voxels; `None` where the rule has no voxel
    /// (`Clip`, `Constant`) beyond the edge.
    pub fn source_index(self, i: i64, n: i64) -> Option<i64> {
        debug_assert!(n > 0);
        if (0..n).contains(&i) {
            return Some(i);
        }
        match self {
            Border::Clip | Border::Constant(_) => None,
            Border::Nearest => Some(i.clamp(0, n - 1)),
            Border::Reflect => {
                let m = i.rem_euclid(2 * n);
                Some(if m < n { m } else { 2 * n - 1 - m })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reflect_repeats_the_edge_voxel_and_wraps_for_any_reach() {
        let at = |i| Border::Reflect.source_index(i, 3).unwrap();
        assert_eq!((-7..10).map(at).collect::<Vec<_>>(), [0, 0, 1, 2, 2, 1, 0, 0, 1, 2, 2, 1, 0, 0, 1, 2, 2]);
        assert!((-5..5).all(|i| Border::Reflect.source_index(i, 1) == Some(0)));
    }
}
