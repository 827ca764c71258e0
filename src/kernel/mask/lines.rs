//! Rows of places and distances: pure functions over slices, for [`super::distances`].

/// Distances of a row's voxels to the crossings on its edges.
#[inline(always)]
pub(super) fn walk_row(line: &mut [f64], [least, most]: &[&mut [f64]; 2], steps: usize) {
    let n = line.len();
    line.fill(f64::INFINITY);
    if steps < TAPS {
        for k in 0..=steps.min(n - 2) {
            lower(&mut line[..n - 1 - k], &least[k..n - 1], k as f64);
            for (d, t) in line[k + 1..].iter_mut().zip(&most[..n - 1 - k]) {
                *d = lesser(*d, (k + 1) as f64 - *t);
            }
        }
        return;
    }
    let mut d = f64::INFINITY;
    for (x, t) in most[..n - 1].iter().enumerate() {
        d = lesser(d + 1.0, 1.0 - *t);
        line[x + 1] = d;
    }
    d = f64::INFINITY;
    for (x, t) in least[..n - 1].iter().enumerate().rev() {
        d = lesser(d + 1.0, *t);
        line[x] = lesser(line[x], d);
    }
}

/// Steps from which one walk along a row, where every voxel waits for the one before it, is faster than as many passes over it.
const TAPS: usize = 16;

/// Where crossings lie on the edges from the voxels of one row to those of another: the least and the largest place, from 0
/// (at `a`) to 1 (at `b`); infinite and minus infinite where there is none. Returns whether there is one.
#[inline(always)]
pub(super) fn find(a: &[f64], b: &[f64], iso: &[f64], [least, most]: &mut [&mut [f64]; 2]) -> bool {
    let n = a.len();
    let (b, least, most) = (&b[..n], &mut least[..n], &mut most[..n]);
    let mut any = false;
    for &level in iso {
        for from in (0..n).step_by(CHUNK) {
            let chunk = from..(from + CHUNK).min(n);
            let mut crosses = false;
            for i in chunk.clone() {
                crosses |= sides_differ(a[i], b[i], level);
            }
            if !crosses {
                continue;
            }
            if !any {
                least.fill(f64::INFINITY);
                most.fill(f64::NEG_INFINITY);
                any = true;
            }
            for i in chunk {
                let (t, crosses) = (place(a[i], b[i], level), sides_differ(a[i], b[i], level));
                least[i] = lesser(least[i], if crosses { t } else { f64::INFINITY });
                most[i] = -lesser(-most[i], if crosses { -t } else { f64::INFINITY });
            }
        }
    }
    any
}

/// Edges looked at together for a crossing.
const CHUNK: usize = 16;

/// Whether a surface lies between two neighbours: one value is below `level`, the other one at or above it.
#[inline(always)]
fn sides_differ(a: f64, b: f64, level: f64) -> bool {
    ((a >= level) & (b < level)) | ((a < level) & (b >= level))
}

/// Where it lies, from 0 (at `a`) to 1 (at `b`): at the finite one beside an infinity, in the middle between two. Halved, so that
/// extremes do not overflow.
#[inline(always)]
fn place(a: f64, b: f64, level: f64) -> f64 {
    let t = (level * 0.5 - a * 0.5) / (b * 0.5 - a * 0.5);
    // Infinity over infinity: `a` is one.
    let t = if t.is_nan() { if b.is_finite() { 1.0 } else { 0.5 } } else { t };
    let t = if t > 0.0 { t } else { 0.0 };
    lesser(t, 1.0)
}

/// Moves a row's distances on by one step, past the edges just looked at. `age` is the number of steps since a crossing: beyond
/// `steps` the row is infinite and left alone.
#[inline(always)]
pub(super) fn step(
    row: &mut [f64],
    [least, most]: &[&mut [f64]; 2],
    crossed: bool,
    age: &mut u32,
    steps: usize,
    up: bool,
) {
    *age = if crossed { 0 } else { age.saturating_add(1) };
    if crossed && up {
        for (d, t) in row.iter_mut().zip(&**most) {
            *d = lesser(*d + 1.0, 1.0 - *t);
        }
    } else if crossed {
        for (d, t) in row.iter_mut().zip(&**least) {
            *d = lesser(*d + 1.0, *t);
        }
    } else if (*age as usize) <= steps {
        for d in row.iter_mut() {
            *d += 1.0;
        }
    } else if *age as usize == steps.saturating_add(1) {
        row.fill(f64::INFINITY);
    }
}

/// Lowers a row to another one plus a constant.
#[inline(always)]
pub(super) fn lower(row: &mut [f64], to: &[f64], add: f64) {
    for (d, s) in row.iter_mut().zip(to) {
        *d = lesser(*d, *s + add);
    }
}

#[inline(always)]
fn lesser(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

/// Squares of distances in voxels of this length.
#[inline(always)]
pub(super) fn square_of(squares: &mut [f64], distances: &[f64], unit: f64) {
    for (s, d) in squares.iter_mut().zip(distances) {
        *s = (*d * unit) * (*d * unit);
    }
}
