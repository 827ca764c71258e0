//! What a filter gives that keeps running sums of v and v^2 in f32 and takes E[v^2] - E[v]^2, as the papers print it.

use occlude::brick::Voxels;
use occlude::grid::Shape;

/// Mean and variance of every window.
pub fn running(volume: &Voxels, shape: Shape, radius: [usize; 3]) -> [Vec<f32>; 2] {
    let v: Vec<f32> = (0..volume.len()).map(|i| volume.at(i) as f32).collect();
    let squares: Vec<f32> = v.iter().map(|v| v * v).collect();
    let sums = [v, squares].map(|s| (0..3).rev().fold(s, |s, axis| slide(&s, shape, axis, radius[axis])));
    let mut out = [0, 1].map(|_| Vec::with_capacity(volume.len()));
    for (i, (v, square)) in sums[0].iter().zip(&sums[1]).enumerate() {
        let c = super::exact::place(shape, i);
        let n: usize = (0..3).map(|a| (c[a] + radius[a] + 1).min(shape[a]) - c[a].saturating_sub(radius[a])).product();
        let (mean, square) = (v / n as f32, square / n as f32);
        out[0].push(mean);
        out[1].push(square - mean * mean);
    }
    out
}

/// Sums along one axis: the voxel that enters is added, the one that leaves subtracted.
fn slide(v: &[f32], shape: Shape, axis: usize, radius: usize) -> Vec<f32> {
    let stride = [shape[1] * shape[2], shape[2], 1][axis];
    let len = shape[axis];
    let mut out = vec![0.0; v.len()];
    for start in (0..v.len()).filter(|i| (i / stride).is_multiple_of(len)) {
        let at = |k: usize| v[start + k * stride];
        let mut sum: f32 = (0..radius.min(len)).map(at).sum();
        for k in 0..len {
            if k + radius < len {
                sum += at(k + radius);
            }
            if k > radius {
                sum -= at(k - radius - 1);
            }
            out[start + k * stride] = sum;
        }
    }
    out
}
