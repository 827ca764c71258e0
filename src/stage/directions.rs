//! Sets of sweep directions and the areas of their cells on the sphere (SPEC section 4, obscurance).

use glam::DVec3;

use crate::stage::{DirectionSet, DirectionWeights};

/// Physical unit vectors, `[z, y, x]`. An icosahedral set has 12, 42 or 162 (see [`icosahedron_level`]; another count
/// gives the next larger of them); a Fibonacci set has any count.
pub fn directions(set: DirectionSet, count: usize) -> Vec<[f64; 3]> {
    match set {
        DirectionSet::Icosahedron => icosahedron((0..2).find(|&l| count <= 10 * 4usize.pow(l) + 2).unwrap_or(2)),
        DirectionSet::Fibonacci => fibonacci(count),
    }
}

/// Subdivisions that give an icosahedral set of `count` vertices: 12, 42 or 162.
pub fn icosahedron_level(count: usize) -> Option<u32> {
    (0..3).find(|&l| 10 * 4usize.pow(l) + 2 == count)
}

/// One weight per direction; they sum to the number of directions.
pub fn weights(kind: DirectionWeights, directions: &[[f64; 3]]) -> Vec<f64> {
    match kind {
        DirectionWeights::Uniform => vec![1.0; directions.len()],
        DirectionWeights::Voronoi => {
            let areas: Vec<f64> = (0..directions.len()).map(|i| voronoi_area(directions, i)).collect();
            let scale = directions.len() as f64 / areas.iter().sum::<f64>();
            // Rounded, so that cells that are equal by symmetry have equal weights.
            areas.iter().map(|a| (a * scale * 1e11).round() / 1e11).collect()
        }
    }
}

/// Scaled to length 1. The squares are added in ascending order, so that permuted vectors get permuted results.
fn unit(v: [f64; 3]) -> [f64; 3] {
    let mut squares = v.map(|c| c * c);
    squares.sort_by(f64::total_cmp);
    let length = (squares[0] + squares[1] + squares[2]).sqrt();
    v.map(|c| c / length)
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    DVec3::from(a).dot(b.into())
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    DVec3::from(a).cross(b.into()).into()
}

/// Vertices of the icosahedron after `level` subdivisions, each of which adds the normalised midpoints of all edges.
fn icosahedron(level: u32) -> Vec<[f64; 3]> {
    let g = (1.0 + 5f64.sqrt()) / 2.0;
    let mut points = Vec::new();
    for (a, b) in [(1.0, g), (-1.0, g), (1.0, -g), (-1.0, -g)] {
        // (0, a, b) as (x, y, z) and its cyclic permutations, written z, y, x.
        points.extend([[b, a, 0.0], [0.0, b, a], [a, 0.0, b]].map(unit));
    }
    let mut faces = Vec::new();
    let near = |a: [f64; 3], b: [f64; 3]| dot(a, b) > 0.4; // neighbours: 1/sqrt 5, others negative
    for i in 0..12 {
        for j in i + 1..12 {
            for k in j + 1..12 {
                if near(points[i], points[j]) && near(points[j], points[k]) && near(points[i], points[k]) {
                    faces.push([i, j, k]);
                }
            }
        }
    }
    for _ in 0..level {
        let mut middles = std::collections::BTreeMap::new();
        let mut finer = Vec::with_capacity(4 * faces.len());
        for [a, b, c] in faces {
            let [ab, bc, ca] = [(a, b), (b, c), (c, a)].map(|(p, q)| {
                *middles.entry((p.min(q), p.max(q))).or_insert_with(|| {
                    let (p, q) = (points[p], points[q]);
                    points.push(unit(std::array::from_fn(|i| p[i] + q[i])));
                    points.len() - 1
                })
            });
            finer.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        faces = finer;
    }
    points
}

/// Points of the Fibonacci spiral: half of them and their antipodes for an even count.
fn fibonacci(count: usize) -> Vec<[f64; 3]> {
    let turn = std::f64::consts::TAU * (5f64.sqrt() - 1.0) / 2.0;
    let half = if count.is_multiple_of(2) { count / 2 } else { count };
    let mut points: Vec<[f64; 3]> = (0..half)
        .map(|i| {
            let z = 1.0 - (2 * i + 1) as f64 / count as f64;
            let (sin, cos) = (turn * i as f64).sin_cos();
            let radius = (1.0 - z * z).max(0.0).sqrt();
            [z, radius * sin, radius * cos]
        })
        .collect();
    if count.is_multiple_of(2) {
        points.extend_from_within(..);
        points[half..].iter_mut().for_each(|p| *p = p.map(|c| -c));
    }
    points
}

/// Area on the unit sphere of the points nearer to `points[i]` than to any other (4 pi for a single point): the cell is
/// cut out of the tangent plane at the point, where the bisecting great circles are straight lines.
fn voronoi_area(points: &[[f64; 3]], i: usize) -> f64 {
    let p = points[i];
    let helper = if p[0].abs() < 0.6 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let e1 = unit(cross(p, helper));
    let e2 = cross(p, e1);
    const FAR: f64 = 1e3;
    let mut cell = vec![[-FAR, -FAR], [FAR, -FAR], [FAR, FAR], [-FAR, FAR]];
    for (j, &q) in points.iter().enumerate() {
        if j == i {
            continue;
        }
        // (p + a e1 + b e2) . (p - q) >= 0
        let d: [f64; 3] = std::array::from_fn(|c| p[c] - q[c]);
        let (c0, ca, cb) = (dot(p, d), dot(e1, d), dot(e2, d));
        let side = |v: [f64; 2]| c0 + ca * v[0] + cb * v[1];
        if cell.iter().all(|&v| side(v) >= 0.0) {
            continue;
        }
        let mut cut = Vec::with_capacity(cell.len() + 1);
        for (k, &v) in cell.iter().enumerate() {
            let w = cell[(k + 1) % cell.len()];
            let (sv, sw) = (side(v), side(w));
            if sv >= 0.0 {
                cut.push(v);
            }
            if (sv >= 0.0) != (sw >= 0.0) {
                let t = sv / (sv - sw);
                cut.push([v[0] + t * (w[0] - v[0]), v[1] + t * (w[1] - v[1])]);
            }
        }
        cell = cut;
    }
    let on_sphere = |v: [f64; 2]| unit(std::array::from_fn(|c| p[c] + v[0] * e1[c] + v[1] * e2[c]));
    (0..cell.len()).map(|k| solid_angle(p, on_sphere(cell[k]), on_sphere(cell[(k + 1) % cell.len()]))).sum()
}

/// Solid angle of a spherical triangle (van Oosterom and Strackee 1983).
fn solid_angle(a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> f64 {
    2.0 * dot(a, cross(b, c)).abs().atan2(1.0 + dot(a, b) + dot(b, c) + dot(c, a))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn icosahedral_sets_are_closed_under_negation_and_cyclic_permutation_bit_for_bit() {
        for n in [12, 42, 162] {
            let set = directions(DirectionSet::Icosahedron, n);
            assert_eq!(set.len(), n);
            assert!(icosahedron_level(n).is_some());
            for d in &set {
                assert!((dot(*d, *d) - 1.0).abs() < 1e-15);
                assert!(set.contains(&d.map(|c| -c)), "{d:?} has no antipode");
                assert!(set.contains(&[d[1], d[2], d[0]]), "{d:?} rotated is missing");
            }
        }
        let set = directions(DirectionSet::Icosahedron, 42);
        assert!(set.contains(&[0.0, 0.0, 1.0]) && set.contains(&[0.0, -1.0, 0.0]));
        assert_eq!(icosahedron_level(40), None);
    }

    #[test]
    fn fibonacci_sets_have_antipodes_when_even() {
        for n in [1, 2, 7, 64, 101] {
            let set = directions(DirectionSet::Fibonacci, n);
            assert_eq!(set.len(), n);
            assert!(set.iter().all(|d| (dot(*d, *d) - 1.0).abs() < 1e-14));
            assert_eq!(set.iter().all(|d| set.contains(&d.map(|c| -c))), n % 2 == 0);
        }
        let first = directions(DirectionSet::Fibonacci, 4)[1];
        let azimuth = std::f64::consts::TAU * (5f64.sqrt() - 1.0) / 2.0;
        assert!((first[0] - 0.25).abs() < 1e-15 && (first[1] / first[2] - azimuth.tan()).abs() < 1e-12);
    }

    #[test]
    fn voronoi_cells_tile_the_sphere() {
        for n in [12, 42, 162] {
            let set = directions(DirectionSet::Icosahedron, n);
            let total: f64 = (0..n).map(|i| voronoi_area(&set, i)).sum();
            assert!((total / (2.0 * std::f64::consts::TAU) - 1.0).abs() < 1e-12, "{n}: {total}");
            let w = weights(DirectionWeights::Voronoi, &set);
            assert!((w.iter().sum::<f64>() - n as f64).abs() < 1e-8);
            let mut kinds = w.clone();
            kinds.sort_by(f64::total_cmp);
            kinds.dedup();
            // Orbits of the vertices under the icosahedral group: 1, 2 and 4.
            assert_eq!(kinds.len(), [1, 2, 4][icosahedron_level(n).unwrap() as usize]);
        }
        // Monte Carlo check of one cell of the 42-set: a vertex of degree 5.
        let set = directions(DirectionSet::Icosahedron, 42);
        let probe = directions(DirectionSet::Fibonacci, 200_000);
        let best = |q: &[f64; 3]| (0..42).max_by(|&a, &b| dot(set[a], *q).total_cmp(&dot(set[b], *q)));
        let share = probe.iter().filter(|q| best(q) == Some(0)).count() as f64 / 200_000.0;
        assert!((share * 2.0 * std::f64::consts::TAU - voronoi_area(&set, 0)).abs() < 2e-3);
        let two = weights(DirectionWeights::Voronoi, &directions(DirectionSet::Fibonacci, 9));
        assert!((two.iter().sum::<f64>() - 9.0).abs() < 1e-8);
    }
}
