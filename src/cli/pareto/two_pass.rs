//! Means and variances of weighted windows by two passes in f64 over the voxels of each window: slow, and short enough to
//! check by reading.

use crate::grid::{Border, Region, Shape};

/// Which voxels of one axis a window holds, and how they weigh.
pub type Taps = Vec<(usize, f64)>;

/// Windows of the truth that are separable in their weights.
#[derive(Debug, Clone, PartialEq)]
pub enum Windows {
    Box {
        radius: [usize; 3],
        border: Border,
    },
    Gaussian {
        sigma: [f64; 3],
        border: Border,
    },
    /// Cells of an occlusion map: voxels, or where an axis was halved once, two blurred cells.
    Map {
        halved: [bool; 3],
    },
}

/// What is asked of a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    Mean,
    Variance,
    Std,
    /// E[v^2].
    Second,
}

impl Windows {
    /// Voxels of axis `a`, which has `n`, that the window about output `i` holds.
    fn taps(&self, a: usize, i: usize, n: usize) -> Taps {
        let around = |reach: usize, border: Border, weight: &dyn Fn(i64) -> f64| {
            let reach = reach as i64;
            let at = |d: i64| border.source_index(i as i64 + d, n as i64).map(|p| (p as usize, weight(d)));
            (-reach..=reach).filter_map(at).collect()
        };
        match self {
            Windows::Box { radius, border } => {
                // Beyond the axis a clipped window holds nothing.
                let reach = if *border == Border::Clip { radius[a].min(n) } else { radius[a] };
                around(reach, *border, &|_| 1.0)
            }
            Windows::Gaussian { sigma, border } => {
                let reach = ((3.0 * sigma[a]).ceil() as usize).min(if *border == Border::Clip { n } else { 1 << 20 });
                around(reach, *border, &|d| (-0.5 * (d as f64 / sigma[a]).powi(2)).exp())
            }
            Windows::Map { halved } if halved[a] => {
                let blurred = |j: usize| {
                    let taps = [1.0, 4.0, 6.0, 4.0, 1.0].into_iter().zip(-2i64..).map(|(w, d)| (j as i64 + d, w));
                    let taps: Vec<(i64, f64)> = taps.filter(|(p, _)| (0..n as i64).contains(p)).collect();
                    let total: f64 = taps.iter().map(|t| t.1).sum();
                    taps.into_iter().map(move |(p, w)| (p as usize, w / total))
                };
                (2 * i..(2 * i + 2).min(n)).flat_map(blurred).collect()
            }
            Windows::Map { .. } => vec![(i, 1.0)],
        }
    }

    /// Whether a missing voxel (NaN) leaves the others of its window as they are; a map's axes are renormalised one by one.
    fn bears_gaps(&self) -> bool {
        !matches!(self, Windows::Map { .. })
    }

    /// Box of the volume that the windows about a box of outputs see.
    pub fn sees(&self, outputs: Region, volume: Shape) -> Region {
        let ends = |a: usize| {
            let seen = (outputs.lo[a]..outputs.hi[a]).flat_map(|i| self.taps(a, i as usize, volume[a]));
            seen.fold((i64::MAX, 0), |(lo, hi), (p, _)| (lo.min(p as i64), hi.max(p as i64 + 1)))
        };
        let ends = [0, 1, 2].map(ends);
        Region::new(ends.map(|e| e.0), ends.map(|e| e.1))
    }

    /// Moments about a box of outputs, from the `values` of the box `seen` of the volume; missing voxels are NaN.
    pub fn moments(&self, outputs: Region, moment: Moment, values: &[f64], seen: Region, volume: Shape) -> Vec<f64> {
        let shape = seen.shape();
        let taps = |a: usize| -> Vec<Taps> {
            let own = |i: i64| self.taps(a, i as usize, volume[a]);
            let local = |t: Taps| t.into_iter().map(|(p, w)| (p - seen.lo[a] as usize, w)).collect();
            (outputs.lo[a]..outputs.hi[a]).map(|i| local(own(i))).collect()
        };
        let [zs, ys, xs] = [taps(0), taps(1), taps(2)];
        let mut out = Vec::with_capacity(outputs.voxels());
        for (z, y) in zs.iter().flat_map(|z| ys.iter().map(move |y| (z, y))) {
            let mut x = 0;
            while x < xs.len() {
                let window = Window { values, shape, z, y, x: &xs[x] };
                if alike(&xs[x..]) {
                    out.extend(window.moments::<LANES>(moment));
                    x += LANES;
                } else {
                    out.extend(window.moments::<1>(moment));
                    x += 1;
                }
            }
        }
        self.without_gaps(&mut out, outputs, values, seen, volume);
        out
    }

    /// No truth where the centre is missing, or where a missing voxel weighs in a way of its own.
    fn without_gaps(&self, out: &mut [f64], outputs: Region, values: &[f64], seen: Region, volume: Shape) {
        if !values.iter().any(|v| v.is_nan()) {
            return;
        }
        let shape = seen.shape();
        for (o, c) in out.iter_mut().zip(outputs.iter()) {
            let lost = |p: [usize; 3]| {
                let p: [usize; 3] = std::array::from_fn(|a| p[a] - seen.lo[a] as usize);
                values[(p[0] * shape[1] + p[1]) * shape[2] + p[2]].is_nan()
            };
            let gone = if self.bears_gaps() {
                lost(c.map(|i| i as usize))
            } else {
                let at = |a: usize| self.taps(a, c[a] as usize, volume[a]);
                let ([zs, ys], xs) = ([at(0), at(1)], at(2));
                zs.iter().any(|z| ys.iter().any(|y| xs.iter().any(|x| lost([z.0, y.0, x.0]))))
            };
            if gone {
                *o = f64::NAN;
            }
        }
    }
}

/// Windows side by side that are summed at once: sums of one window after the other wait for each addition.
const LANES: usize = 16;

/// Whether the next windows of a row are the first one moved along.
fn alike(xs: &[Taps]) -> bool {
    let moved = |lane: usize, taps: &Taps| {
        taps.len() == xs[0].len() && taps.iter().zip(&xs[0]).all(|(t, first)| *t == (first.0 + lane, first.1))
    };
    xs.len() >= LANES && xs[..LANES].iter().enumerate().all(|(lane, taps)| moved(lane, taps))
}

/// A window, and those that it becomes one, two, ... voxels further along x.
struct Window<'a> {
    values: &'a [f64],
    shape: Shape,
    z: &'a Taps,
    y: &'a Taps,
    x: &'a Taps,
}

impl Window<'_> {
    fn moments<const L: usize>(&self, moment: Moment) -> [f64; L] {
        let mean = self.average::<L>(|_, v| v);
        let about = |lane: usize, v: f64| (v - mean[lane]) * (v - mean[lane]);
        match moment {
            Moment::Mean => mean,
            Moment::Variance => self.average(about),
            Moment::Std => self.average(about).map(f64::sqrt),
            Moment::Second => self.average(|_, v| v * v),
        }
    }

    /// Weighted averages of a term over the voxels that exist.
    #[inline(always)]
    fn average<const L: usize>(&self, term: impl Fn(usize, f64) -> f64) -> [f64; L] {
        let (mut sums, mut weights) = ([0.0; L], [0.0; L]);
        for ((zi, zw), (yi, yw)) in self.z.iter().flat_map(|z| self.y.iter().map(move |y| (z, y))) {
            let row = &self.values[(zi * self.shape[1] + yi) * self.shape[2]..][..self.shape[2]];
            for (x, xw) in self.x {
                let w = zw * yw * xw;
                for (lane, v) in row[*x..x + L].iter().enumerate() {
                    let there = !v.is_nan();
                    sums[lane] += if there { w * term(lane, *v) } else { 0.0 };
                    weights[lane] += if there { w } else { 0.0 };
                }
            }
        }
        std::array::from_fn(|lane| sums[lane] / weights[lane])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: Shape = [3, 4, 5];

    fn all(w: &Windows, moment: Moment, values: &[f64], outputs: Shape) -> Vec<f64> {
        let whole = Region::whole(outputs);
        let seen = w.sees(whole, SHAPE);
        assert_eq!(seen, Region::whole(SHAPE));
        w.moments(whole, moment, values, seen, SHAPE)
    }

    #[test]
    fn closed_forms_of_a_ramp() {
        // v = x: a whole row's mean is 2, its variance 2, E[v^2] 6, about any offset.
        let ramp = |at: f64| -> Vec<f64> { (0..60).map(|i| at + f64::from(i % 5)).collect() };
        let clip = Windows::Box { radius: [1, 1, 9], border: Border::Clip };
        assert!(all(&clip, Moment::Mean, &ramp(0.0), SHAPE).iter().all(|v| *v == 2.0));
        assert!(all(&clip, Moment::Variance, &ramp(1e9), SHAPE).iter().all(|v| *v == 2.0));
        assert!(all(&clip, Moment::Std, &ramp(0.0), SHAPE).iter().all(|v| *v == 2f64.sqrt()));
        assert!(all(&clip, Moment::Second, &ramp(0.0), SHAPE).iter().all(|v| *v == 6.0));
        let nearest = Windows::Box { radius: [0, 0, 1], border: Border::Nearest };
        let means = all(&nearest, Moment::Mean, &ramp(0.0), SHAPE);
        assert_eq!(means[..5], [1.0 / 3.0, 1.0, 2.0, 3.0, 11.0 / 3.0]);
        let narrow = Windows::Gaussian { sigma: [1e-9, 1e-9, 1e-9], border: Border::Clip };
        assert_eq!(all(&narrow, Moment::Mean, &ramp(0.0), SHAPE), ramp(0.0));
        let wide = Windows::Gaussian { sigma: [1.0, 1.0, 50.0], border: Border::Reflect };
        assert!(all(&wide, Moment::Mean, &ramp(0.0), SHAPE).iter().all(|v| (v - 2.0).abs() < 0.05));
    }

    #[test]
    fn cells_of_a_map_weigh_as_the_chain_does() {
        // One voxel of 1 at x = 2: weights (1 5 10 10 5 1)/32 away from the ends, here over 5 voxels.
        let mut one = vec![0.0; 60];
        (0..12).for_each(|row| one[row * 5 + 2] = 1.0);
        let map = Windows::Map { halved: [false, false, true] };
        let got = all(&map, Moment::Mean, &one, [3, 4, 3]);
        let expect = [(1.0 / 11.0 + 4.0 / 15.0) / 2.0, (6.0 / 16.0 + 4.0 / 15.0) / 2.0, 1.0 / 11.0];
        assert!(got.chunks(3).all(|row| row.iter().zip(&expect).all(|(g, e)| (g - e).abs() < 1e-15)), "{got:?}");
        let same = Windows::Map { halved: [false; 3] };
        assert_eq!(all(&same, Moment::Variance, &one, SHAPE), vec![0.0; 60]);
    }

    #[test]
    fn missing_voxels_do_not_count() {
        let mut values: Vec<f64> = (0..60).map(|i| f64::from(i % 5)).collect();
        values[4] = f64::NAN;
        let row = Windows::Box { radius: [0, 0, 9], border: Border::Clip };
        let got = all(&row, Moment::Mean, &values, SHAPE);
        assert_eq!((got[0], got[5]), (1.5, 2.0));
        assert!(got[4].is_nan() && got.iter().filter(|v| v.is_nan()).count() == 1);
        let map = Windows::Map { halved: [false, false, true] };
        let got = all(&map, Moment::Mean, &values, [3, 4, 3]);
        assert!(got[..3].iter().all(|v| v.is_nan()) || got[1].is_nan() && got[2].is_nan(), "{got:?}");
        assert!(got[3..].iter().all(|v| !v.is_nan()));
    }
}
