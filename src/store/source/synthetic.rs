//! Synthetic fields: closed forms of the voxel's index, the same on every machine and for every box.
//!
//! Fields with values in `[0, 1]` are stored by integer types as `round(v * max)`, by floats as they are.

use std::f64::consts::TAU;

use crate::config::Input;
use crate::grid::hash::mix;
use crate::grid::{AnyViewMut, DType, Region, Shape, ViewMut, Voxel};
use crate::store::VolumeInfo;
use crate::{Error, Result, with_view};

use super::planar::{components, key};

/// A field and its lattice.
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    pub kind: Kind,
    pub shape: Shape,
    pub dtype: DType,
    pub seed: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// `max(0, 1 - d / R)`: d the distance from the middle in voxels, R half the shortest axis over 1. Isosurfaces are spheres.
    Sphere,
    /// 1 where `2 z >= nz`, else 0: solid matter in the upper half of z.
    Plane,
    /// `(g / 1.5 + 1) / 2` with `g = sin X cos Y + sin Y cos Z + sin Z cos X`, period 32 voxels.
    Gyroid,
    /// A hash of index and seed: uniform over the whole range of an integer type, over `[0, 1)` for floats.
    Noise,
    /// From 0 at x = 0 to 1 at the last x.
    Ramp,
    /// An empty box (0) with three opaque faces, as in the test of paper B: 1 at x = 0, else 2 at y = 0, else 3 at the
    /// floor z = 0, for a transfer function to colour (green, blue, white). Not scaled for integers.
    Phantom,
    /// 0.5 everywhere.
    Constant,
}

const NAMES: [(&str, Kind); 7] = [
    ("sphere", Kind::Sphere),
    ("plane", Kind::Plane),
    ("gyroid", Kind::Gyroid),
    ("noise", Kind::Noise),
    ("ramp", Kind::Ramp),
    ("phantom", Kind::Phantom),
    ("constant", Kind::Constant),
];

/// Period of the gyroid in voxels.
const PERIOD: f64 = 32.0;

/// A field by name; the lattice is checked.
pub fn open(input: &Input, name: &str, shape: Shape, dtype: DType, seed: u64) -> Result<(VolumeInfo, Field)> {
    let Some((_, kind)) = NAMES.into_iter().find(|(n, _)| *n == name) else {
        let names: Vec<_> = NAMES.iter().map(|n| n.0).collect();
        return Err(Error::config(
            key(input, "synthetic"),
            format!("`{name}` is no field; known are {}", names.join(", ")),
        ));
    };
    let bytes = shape.iter().try_fold(dtype.size(), |n, d| n.checked_mul(*d)).filter(|n| *n > 0 && *n < 1 << 60);
    if bytes.is_none() || shape.iter().any(|n| *n > 1 << 40) {
        return Err(Error::config(
            key(input, "shape"),
            format!("{shape:?}: every axis needs at least 1 voxel, and fewer than 2^60 bytes in all"),
        ));
    }
    components(input, 1, 1, &[])?;
    let info = VolumeInfo::plain(shape, dtype, format!("synthetic {name}"));
    Ok((info, Field { kind, shape, dtype, seed }))
}

/// A well-mixed 64-bit hash of two numbers (splitmix64's finaliser, applied to each).
fn hash(seed: u64, index: u64) -> u64 {
    mix(mix(seed.wrapping_add(0x9e37_79b9_7f4a_7c15)) ^ index.wrapping_mul(0x9e37_79b9_7f4a_7c15))
}

/// Sine and cosine of an index in a gyroid.
fn turn(i: i64) -> (f64, f64) {
    (i as f64 / PERIOD * TAU).sin_cos()
}

fn gyroid([(sz, cz), (sy, cy), (sx, cx)]: [(f64, f64); 3]) -> f64 {
    ((sx * cy + sy * cz + sz * cx) / 3.0 + 0.5).clamp(0.0, 1.0)
}

impl Field {
    /// Value of a voxel in `[0, 1]` (phantom: 0 to 3; noise: see [`Field::noise`]).
    pub fn value(&self, [z, y, x]: [i64; 3]) -> f64 {
        let n = self.shape.map(|n| n as f64);
        match self.kind {
            Kind::Sphere => {
                let axes =
                    [z as f64 - (n[0] - 1.0) / 2.0, y as f64 - (n[1] - 1.0) / 2.0, x as f64 - (n[2] - 1.0) / 2.0];
                let radius = n.into_iter().filter(|n| *n > 1.0).fold(f64::INFINITY, f64::min) / 2.0;
                let distance = axes.iter().map(|d| d * d).sum::<f64>().sqrt();
                (1.0 - distance / radius).max(0.0)
            }
            Kind::Plane => (2 * z >= self.shape[0] as i64) as u8 as f64,
            Kind::Gyroid => gyroid([z, y, x].map(turn)),
            Kind::Ramp => x as f64 / (n[2] - 1.0).max(1.0),
            Kind::Phantom if x == 0 => 1.0,
            Kind::Phantom if y == 0 => 2.0,
            Kind::Phantom if z == 0 => 3.0,
            Kind::Phantom => 0.0,
            Kind::Constant => 0.5,
            Kind::Noise => self.noise([z, y, x]),
        }
    }

    /// Stored value of the noise.
    fn noise(&self, [z, y, x]: [i64; 3]) -> f64 {
        let index = (z as u64 * self.shape[1] as u64 + y as u64) * self.shape[2] as u64 + x as u64;
        let h = hash(self.seed, index);
        match self.dtype {
            DType::F32 => (h >> 40) as f64 / (1u64 << 24) as f64,
            DType::F64 => (h >> 11) as f64 / (1u64 << 53) as f64,
            _ => (h >> (64 - 8 * self.dtype.size())) as f64 + self.dtype.range().0,
        }
    }

    /// Fills `dst`, which covers `region`.
    pub fn read(&self, region: Region, mut dst: AnyViewMut) {
        with_view!(AnyViewMut, &mut dst, v => self.fill(region, v));
    }

    fn fill<T: Voxel>(&self, region: Region, dst: &mut ViewMut<T>) {
        let scale = match self.kind {
            Kind::Noise | Kind::Phantom => 1.0,
            _ if self.dtype.is_float() => 1.0,
            _ => self.dtype.range().1,
        };
        let [nz, ny, _] = dst.shape;
        // Sines and cosines once per row and column: they are all of the work.
        let turns: Vec<(f64, f64)> = match self.kind {
            Kind::Gyroid => (region.lo[2]..region.hi[2]).map(turn).collect(),
            _ => Vec::new(),
        };
        for z in 0..nz {
            for y in 0..ny {
                let at = [region.lo[0] + z as i64, region.lo[1] + y as i64];
                if self.kind == Kind::Gyroid {
                    let [tz, ty] = at.map(turn);
                    let row = dst.row_at(z, y).iter_mut().zip(&turns);
                    row.for_each(|(d, tx)| *d = T::from_f64(gyroid([tz, ty, *tx]) * scale));
                    continue;
                }
                for (x, d) in dst.row_at(z, y).iter_mut().enumerate() {
                    *d = T::from_f64(self.value([at[0], at[1], region.lo[2] + x as i64]) * scale);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::Voxels;

    fn field(kind: Kind, shape: Shape, dtype: DType) -> Field {
        Field { kind, shape, dtype, seed: 7 }
    }

    #[test]
    fn a_box_holds_what_the_whole_holds() {
        for (_, kind) in NAMES {
            for dtype in DType::ALL {
                let f = field(kind, [6, 5, 9], dtype);
                let whole = Region::whole(f.shape);
                let mut all = Voxels::zeroed(dtype, whole.voxels());
                f.read(whole, all.view_mut(f.shape));
                let part = Region::new([1, 2, 3], [6, 4, 8]);
                let mut some = Voxels::zeroed(dtype, part.voxels());
                f.read(part, some.view_mut(part.shape()));
                for (i, [z, y, x]) in part.iter().enumerate() {
                    assert_eq!(some.at(i), all.at(((z * 5 + y) * 9 + x) as usize), "{kind:?} {dtype}");
                }
            }
        }
    }

    #[test]
    fn rows_of_a_gyroid_hold_its_values() {
        for (dtype, top) in [(DType::U8, 255.0), (DType::I16, 32767.0), (DType::F32, 1.0), (DType::F64, 1.0)] {
            let f = field(Kind::Gyroid, [7, 40, 70], dtype);
            let part = Region::new([1, 3, 5], [7, 37, 70]);
            let mut all = Voxels::zeroed(dtype, part.voxels());
            f.read(part, all.view_mut(part.shape()));
            let mut one = Voxels::zeroed(dtype, 1);
            for (i, q) in part.iter().enumerate() {
                one.fill(f.value(q) * top);
                assert_eq!(all.at(i), one.at(0), "{dtype} {q:?}");
            }
        }
    }

    #[test]
    fn the_phantom_has_three_faces_and_nothing_inside() {
        let f = field(Kind::Phantom, [4, 4, 4], DType::U8);
        assert_eq!(
            [[2, 2, 0], [2, 0, 2], [0, 2, 2], [2, 2, 2], [0, 0, 0]].map(|i| f.value(i)),
            [1.0, 2.0, 3.0, 0.0, 1.0]
        );
    }

    #[test]
    fn noise_is_uniform_over_the_type() {
        for dtype in DType::ALL {
            let f = field(Kind::Noise, [32, 32, 32], dtype);
            let mut v = Voxels::zeroed(dtype, 32768);
            f.read(Region::whole(f.shape), v.view_mut(f.shape));
            let (lo, hi) = if dtype.is_float() { (0.0, 1.0) } else { dtype.range() };
            let mean = (0..v.len()).map(|i| (v.at(i) - lo) / (hi - lo)).sum::<f64>() / 32768.0;
            let min = (0..v.len()).map(|i| (v.at(i) - lo) / (hi - lo)).fold(1.0, f64::min);
            let max = (0..v.len()).map(|i| (v.at(i) - lo) / (hi - lo)).fold(0.0, f64::max);
            assert!((mean - 0.5).abs() < 0.01 && min < 0.01 && max > 0.99, "{dtype}: {mean} {min} {max}");
        }
    }
}
