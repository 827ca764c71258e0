//! The full regression, for windows with missing voxels: weighted least squares of f ~ A z + B y + C x + D.

use super::Table;

/// Gradient (z, y, x; physical) over the valid voxels of the window about `centre`, which is valid itself; `value` is NaN
/// where a voxel is missing. Zero where the voxels that are left do not determine a plane; `None` if none is missing.
///
/// Offsets are whole voxels and values are taken relative to the centre's, so that a constant window gives exactly zero and
/// nothing depends on where the brick starts.
pub(super) fn fit(table: &Table, centre: [usize; 3], value: impl Fn(usize, usize, usize) -> f64) -> Option<[f64; 3]> {
    let half = table.half as i64;
    let origin = value(centre[0], centre[1], centre[2]);
    // sums of w, of w times each offset, of w times pairs of offsets; last entry of each: times the value
    let (mut total, mut first, mut second) = (0.0, [0.0; 4], [[0.0; 4]; 3]);
    let mut gap = false;
    for (z, y, x) in
        (-half..=half).flat_map(|z| (-half..=half).flat_map(move |y| (-half..=half).map(move |x| (z, y, x))))
    {
        let place = |a: usize, d: i64| centre[a].wrapping_add_signed(d as isize);
        let v = value(place(0, z), place(1, y), place(2, x));
        if v.is_nan() {
            gap = true;
            continue;
        }
        let w = table.weight[z.unsigned_abs() as usize][y.unsigned_abs() as usize][x.unsigned_abs() as usize];
        if w == 0.0 {
            continue;
        }
        let row = [z as f64, y as f64, x as f64, v - origin];
        total += w;
        for j in 0..4 {
            first[j] += w * row[j];
            for i in 0..3 {
                second[i][j] += w * row[i] * row[j];
            }
        }
    }
    if !gap {
        return None;
    }
    let mut system = [[0.0; 4]; 3];
    for i in 0..3 {
        for j in 0..4 {
            system[i][j] = second[i][j] - first[i] * first[j] / total;
        }
    }
    let slopes = solve(system).unwrap_or([0.0; 3]);
    Some(std::array::from_fn(|a| slopes[a] / table.spacing[a]))
}

/// Solves a symmetric positive definite 3x3 system (last column: the right side) by elimination with the largest diagonal
/// entry first; `None` if it is singular. Offsets are at most 2, so an honest pivot is no smaller than 1e-9 of the trace.
#[allow(clippy::needless_range_loop)] // rows and columns are both wanted by index
fn solve(mut m: [[f64; 4]; 3]) -> Option<[f64; 3]> {
    let trace = m[0][0] + m[1][1] + m[2][2];
    let mut done = [false; 3];
    for _ in 0..3 {
        let p = (0..3).filter(|&i| !done[i]).max_by(|&i, &j| m[i][i].total_cmp(&m[j][j]))?;
        let pivot = m[p][p];
        if pivot.is_nan() || pivot <= 1e-9 * trace {
            return None;
        }
        done[p] = true;
        for i in 0..3 {
            if i != p {
                let factor = m[i][p] / pivot;
                for j in 0..4 {
                    m[i][j] -= factor * m[p][j];
                }
            }
        }
    }
    Some(std::array::from_fn(|i| m[i][3] / m[i][i]))
}
