//! Weights and places of the taps of a pass.

use super::rows::Real;

/// exp(-k^2 / 2 sigma^2).
pub(super) fn bell(sigma: f64, k: usize) -> f64 {
    let x = k as f64 / sigma;
    if k == 0 { 1.0 } else { (-0.5 * x * x).exp() }
}

/// Sum of the bell over the taps that exist, given how many voxels there are on both sides.
pub(super) fn total(bell: impl Fn(usize) -> f64, radius: usize, before: usize, after: usize) -> f64 {
    (1..=radius).fold(bell(0), |sum, k| sum + bell(k) * (f64::from(k <= before) + f64::from(k <= after)))
}

/// Taps of one row of results: other rows of a buffer, by where they start.
pub(super) struct Taps<'a, F> {
    pub centre: usize,
    /// For k = 1, 2, ...: the rows k steps before and after, while both exist.
    pub pairs: &'a [[u32; 2]],
    /// Then those on the one side that goes on.
    pub singles: &'a [[u32; 2]],
    /// Of the centre, the pairs (each of its two), the singles.
    pub weights: &'a [F],
}

impl<F> Taps<'_, F> {
    /// Whether every tap of `n` voxels lies inside a buffer of `len`.
    pub fn inside(&self, n: usize, len: usize) -> bool {
        let places = self.pairs.as_flattened().iter().chain(self.singles.iter().map(|[p, _]| p));
        let last = places.fold(self.centre, |last, p| last.max(*p as usize));
        last + n <= len && self.weights.len() > self.pairs.len() + self.singles.len()
    }
}

/// Taps of consecutive positions of one axis.
pub(super) struct Table<'a, F> {
    pub radius: usize,
    /// exp(-k^2 / 2 sigma^2).
    pub bell: &'a mut [f64],
    /// By position: `radius + 1`.
    pub weights: &'a mut [F],
    /// By position: `radius`.
    pub places: &'a mut [[u32; 2]],
    /// By position: the centre's place, how many pairs, how many singles.
    pub counts: &'a mut [[u32; 2]],
}

impl<F: Real> Table<'_, F> {
    /// Sets entry `i`: taps about position `p` of an axis of `n`; `place` tells where a position's row starts.
    pub fn set(&mut self, i: usize, p: usize, n: usize, place: impl Fn(usize) -> usize) {
        let r = self.radius;
        let (before, after) = (p.min(r), (n - 1 - p).min(r));
        let (both, most) = (before.min(after), before.max(after));
        let total = total(|k| self.bell[k], r, before, after);
        let weights = &mut self.weights[i * (r + 1)..][..r + 1];
        weights.iter_mut().zip(&*self.bell).for_each(|(w, b)| *w = F::narrow(b / total));
        let places = &mut self.places[i * r..][..r];
        for (k, at) in (1..=both).zip(places.iter_mut()) {
            *at = [place(p - k) as u32, place(p + k) as u32];
        }
        for k in both + 1..=most {
            places[k - 1] = [place(if before > after { p - k } else { p + k }) as u32; 2];
        }
        self.counts[i] = [both as u32, most as u32];
    }

    /// Entry `i`, whose centre stands at `centre`.
    pub fn taps(&self, i: usize, centre: usize) -> Taps<'_, F> {
        let r = self.radius;
        let [both, most] = self.counts[i].map(|n| n as usize);
        let (pairs, singles) = self.places[i * r..][..most].split_at(both);
        Taps { centre, pairs, singles, weights: &self.weights[i * (r + 1)..][..r + 1] }
    }
}

/// Along x, where every lane of a tile near an end of the axis has taps and weights of its own.
pub(super) struct Edges<'a, F> {
    /// Lane after lane for k = 0, then for k = 1, ...
    pub weights: &'a mut [F],
    /// One more than the voxels before, and after, each lane.
    pub room: [&'a mut [F]; 2],
}

impl<F: Real> Edges<'_, F> {
    /// Sets all lanes; the first stands at position `p` of an axis of `n`. Lanes beyond the axis are as the last.
    pub fn set(&mut self, p: usize, n: usize, bell: &[f64]) {
        let [room_before, room_after] = &mut self.room;
        let lanes = room_before.len();
        for lane in 0..lanes {
            let before = (p + lane).min(n - 1);
            let after = n - 1 - before;
            let total = total(|k| bell[k], bell.len() - 1, before, after);
            for (k, b) in bell.iter().enumerate() {
                self.weights[k * lanes + lane] = F::narrow(b / total);
            }
            room_before[lane] = F::narrow((before + 1) as f64);
            room_after[lane] = F::narrow((after + 1) as f64);
        }
    }

    /// Weights and both rooms for rows of `n` lanes. Panics unless they cover the taps.
    pub fn lanes(&self, taps: &Taps<F>, n: usize) -> [&[F]; 3] {
        let [before, after] = &self.room;
        assert!(
            before.len() == n && after.len() == n && self.weights.len() > taps.pairs.len() * n,
            "weights of every lane"
        );
        [&*self.weights, before, after]
    }
}
