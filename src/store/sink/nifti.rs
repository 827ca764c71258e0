//! NIfTI headers: version 1, or 2 where an axis is longer than 32767.
//!
//! Components are the fourth axis (`dim[4]`), the slowest, which every reader shows as a 4-D image.

use serde_json::Value;

use super::SinkSpec;
use super::header::config_hash;
use crate::grid::DType;

fn type_code(dtype: DType) -> i16 {
    match dtype {
        DType::U8 => 2,
        DType::I16 => 4,
        DType::I32 => 8,
        DType::F32 => 16,
        DType::F64 => 64,
        DType::I8 => 256,
        DType::U16 => 512,
        DType::U32 => 768,
    }
}

/// Code of the unit to write and what one of ours is in it; 0 = unknown.
fn unit_code(unit: Option<&str>) -> (u8, f64) {
    match unit {
        Some("meter") => (1, 1.0),
        Some("centimeter") => (2, 10.0),
        Some("millimeter") => (2, 1.0),
        Some("micrometer") => (3, 1.0),
        Some("nanometer") => (3, 1e-3),
        _ => (0, 1.0),
    }
}

/// The header with its empty extension block: 352 or 544 bytes.
pub fn nifti(spec: &SinkSpec, occlude: Option<&Value>) -> Vec<u8> {
    let [z, y, x] = spec.pyramid.levels[0].shape;
    let fourth = spec.components.unwrap_or(1);
    let dim = [if spec.components.is_some() { 4 } else { 3 }, x, y, z, fourth, 1, 1, 1];
    let (units, per) = unit_code(spec.unit.as_deref());
    let [sz, sy, sx] = spec.pyramid.levels[0].scale.map(|s| s * per);
    // World matrix in RAS, the only space that the format has.
    let space = spec.orientation.as_ref().map(|o| o.space.as_str());
    let flip = |row: usize| match space {
        Some("LPS" | "left-posterior-superior") if row < 2 => -per,
        Some("LAS" | "left-anterior-superior") if row == 0 => -per,
        _ => per,
    };
    let mut matrix = spec.placed_matrix();
    matrix.iter_mut().enumerate().for_each(|(r, row)| row.iter_mut().for_each(|v| *v *= flip(r)));
    let quatern = quaternion(&matrix);
    // 1: the scanner's coordinates; 2: some other lattice that the volume is aligned with.
    let code: i16 = if spec.orientation.is_some() { 1 } else { 2 };
    let (qcode, [b, c, d], qfac) = quatern.map_or((0, [0.0; 3], 1.0), |(q, f)| (code, q, f));
    let pixdim = [qfac, sx, sy, sz, 1.0, 1.0, 1.0, 1.0];
    let offset = [matrix[0][3], matrix[1][3], matrix[2][3]];
    let mut descrip = format!("occlude {}", config_hash(occlude).unwrap_or_default()).into_bytes();
    descrip.resize(80, 0);
    let bits = 8 * spec.dtype.size() as i16;
    let mut h = Header(Vec::with_capacity(544));
    if dim.iter().any(|&n| n > i16::MAX as usize) {
        h.put(&540i32.to_le_bytes()).put(b"n+2\0\r\n\x1a\n");
        h.put(&type_code(spec.dtype).to_le_bytes()).put(&bits.to_le_bytes());
        for n in dim {
            h.put(&(n as i64).to_le_bytes());
        }
        h.zeros(24).f64s(&pixdim).put(&544i64.to_le_bytes()).f64s(&[1.0, 0.0]);
        h.zeros(16 + 16 + 16).put(&descrip).zeros(24);
        h.put(&i32::from(qcode).to_le_bytes()).put(&i32::from(code).to_le_bytes()).f64s(&[b, c, d]).f64s(&offset);
        h.f64s(matrix.as_flattened());
        h.zeros(4).put(&i32::from(units).to_le_bytes()).zeros(4 + 16 + 1 + 15);
    } else {
        h.put(&348i32.to_le_bytes()).zeros(35).put(&[0]);
        for n in dim {
            h.put(&(n as i16).to_le_bytes());
        }
        h.zeros(14).put(&type_code(spec.dtype).to_le_bytes()).put(&bits.to_le_bytes()).zeros(2);
        h.f32s(&pixdim).f32s(&[352.0, 1.0, 0.0]).zeros(3).put(&[units]).zeros(8 + 8 + 8).put(&descrip).zeros(24);
        h.put(&qcode.to_le_bytes()).put(&code.to_le_bytes()).f32s(&[b, c, d]).f32s(&offset);
        h.f32s(matrix.as_flattened());
        h.zeros(16).put(b"n+1\0");
    }
    h.zeros(4);
    h.0
}

struct Header(Vec<u8>);

impl Header {
    fn put(&mut self, bytes: &[u8]) -> &mut Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn zeros(&mut self, n: usize) -> &mut Self {
        self.0.resize(self.0.len() + n, 0);
        self
    }

    fn f32s(&mut self, v: &[f64]) -> &mut Self {
        v.iter().for_each(|v| self.0.extend((*v as f32).to_le_bytes()));
        self
    }

    fn f64s(&mut self, v: &[f64]) -> &mut Self {
        v.iter().for_each(|v| self.0.extend(v.to_le_bytes()));
        self
    }
}

/// Quaternion (b, c, d) and qfac of the directions, by the formulas of the NIfTI-1 standard; `None` for matrices that are
/// no rotation with or without a mirror (those have the sform alone).
fn quaternion(matrix: &[[f64; 4]; 3]) -> Option<([f64; 3], f64)> {
    let norm = |a: usize| (0..3).map(|r| matrix[r][a] * matrix[r][a]).sum::<f64>().sqrt();
    let mut m: [[f64; 3]; 3] = std::array::from_fn(|r| std::array::from_fn(|a| matrix[r][a] / norm(a)));
    let dot = |a: usize, b: usize| (0..3).map(|r| m[r][a] * m[r][b]).sum::<f64>();
    // NaN (an axis of length 0) must fail, too.
    let orthogonal = [dot(0, 1), dot(0, 2), dot(1, 2)].iter().all(|d| d.abs() < 1e-5);
    if !orthogonal {
        return None;
    }
    let det = m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
    let qfac = if det < 0.0 { -1.0 } else { 1.0 };
    m.iter_mut().for_each(|row| row[2] *= qfac);
    let [[r11, r12, r13], [r21, r22, r23], [r31, r32, r33]] = m;
    let trace = r11 + r22 + r33 + 1.0;
    let (a, q) = if trace > 0.5 {
        let a = 0.5 * trace.sqrt();
        (a, [0.25 * (r32 - r23) / a, 0.25 * (r13 - r31) / a, 0.25 * (r21 - r12) / a])
    } else {
        let [x, y, z] = [1.0 + r11 - (r22 + r33), 1.0 + r22 - (r11 + r33), 1.0 + r33 - (r11 + r22)];
        if x > 1.0 {
            let b = 0.5 * x.sqrt();
            (0.25 * (r32 - r23) / b, [b, 0.25 * (r12 + r21) / b, 0.25 * (r13 + r31) / b])
        } else if y > 1.0 {
            let c = 0.5 * y.sqrt();
            (0.25 * (r13 - r31) / c, [0.25 * (r12 + r21) / c, c, 0.25 * (r23 + r32) / c])
        } else {
            let d = 0.5 * z.sqrt();
            (0.25 * (r21 - r12) / d, [0.25 * (r13 + r31) / d, 0.25 * (r23 + r32) / d, d])
        }
    };
    Some((q.map(|v| if a < 0.0 { -v } else { v }), qfac))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rotation of a quaternion, the standard's formula.
    fn rotation([b, c, d]: [f64; 3], qfac: f64) -> [[f64; 3]; 3] {
        let a = (1.0 - (b * b + c * c + d * d)).max(0.0).sqrt();
        let mut m = [
            [a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
            [2.0 * (b * c + a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d - a * b)],
            [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), a * a + d * d - c * c - b * b],
        ];
        m.iter_mut().for_each(|row| row[2] *= qfac);
        m
    }

    #[test]
    fn quaternions_give_the_matrix_back() {
        let axes = [
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]],
            [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
            [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
            [[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, -1.0]],
        ];
        for m in axes {
            let scaled = m.map(|r| [2.0 * r[0], 3.0 * r[1], 0.5 * r[2], 7.0]);
            let (q, f) = quaternion(&scaled).unwrap();
            let back = rotation(q, f);
            assert!((0..9).all(|i| (back[i / 3][i % 3] - m[i / 3][i % 3]).abs() < 1e-12), "{m:?} {back:?}");
        }
        assert!(quaternion(&[[1.0, 0.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]).is_none());
        assert!(quaternion(&[[0.0; 4]; 3]).is_none());
    }
}
