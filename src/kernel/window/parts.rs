//! How windows along one axis are put together from lines: in which order, written once for moments and for their counts.
//!
//! Outputs come in blocks of eight, aligned to the volume ([`super::Place`]). The windows of a block share the lines
//! between the last start and the first end; these are read as groups of eight, which neighbouring blocks share, and a
//! few single lines. From this core a chain of lines goes back to each start, and one goes on to each end. The order of
//! merges depends on the window and the place in the volume alone, never on brick or tile; a line takes part in at most
//! `w / 8 + 20` merges.

use super::merge::Weight;

/// Outputs made together, and lines of a group.
pub const BLOCK: usize = 8;

/// Lines, groups of them and what joins two neighbours.
pub trait Parts {
    type Part: Copy;
    /// Line `i` of the block.
    fn line(&self, i: usize) -> Self::Part;
    /// Lines `8 q..8 q + 8` of the block, merged by [`octet`].
    fn group(&self, q: usize) -> Self::Part;
    /// Merges the next two parts; calls come in an order that depends on the window alone.
    fn merge(&mut self, a: Self::Part, b: Self::Part) -> Self::Part;
}

/// Groups that all windows of a block hold.
pub fn groups(w: usize) -> usize {
    w.saturating_sub(BLOCK) / BLOCK
}

/// Merges of [`octet`].
pub const OCTET: usize = BLOCK - 1;

/// Merges of [`block`].
pub fn merges(w: usize) -> usize {
    if w < BLOCK { BLOCK * (w - 1) } else { groups(w) + (w - BLOCK) % BLOCK - 1 + BLOCK + 2 * BLOCK - 3 }
}

/// Lines `0..8`.
#[inline(always)]
pub fn octet<P: Parts>(p: &mut P) -> P::Part {
    macro_rules! pair {
        ($a:expr, $b:expr) => {{
            let (a, b) = ($a, $b);
            p.merge(a, b)
        }};
    }
    let low = pair!(pair!(p.line(0), p.line(1)), pair!(p.line(2), p.line(3)));
    let high = pair!(pair!(p.line(4), p.line(5)), pair!(p.line(6), p.line(7)));
    p.merge(low, high)
}

/// Windows of `w` lines (odd): output `k` holds lines `k..k + w`.
#[inline(always)]
pub fn block<P: Parts>(p: &mut P, w: usize) -> [P::Part; BLOCK] {
    if w < BLOCK {
        let mut out = [p.line(0); BLOCK];
        // Written out as well: through a closure, which is not compiled for its caller's level, short windows took 30 times
        // as long (variance of f32, radius 3: 199 ns per voxel).
        macro_rules! windows {
            ($($k:literal)*) => {$(
                let mut part = p.line($k);
                for i in 1..w {
                    part = p.merge(part, p.line($k + i));
                }
                out[$k] = part;
            )*};
        }
        windows!(0 1 2 3 4 5 6 7);
        return out;
    }
    let groups = groups(w);
    let mut from = BLOCK * (1 + groups);
    let mut core = match groups {
        0 => {
            from += 1;
            p.line(BLOCK)
        }
        _ => p.group(1),
    };
    for q in 2..=groups {
        core = p.merge(core, p.group(q));
    }
    for i in from..w {
        core = p.merge(core, p.line(i));
    }
    // Chains are written out: as loops they would stay in memory.
    let mut out = [core; BLOCK];
    let mut left = core;
    macro_rules! starts {
        ($($k:literal)*) => {$(
            left = p.merge(left, p.line($k));
            out[$k] = left;
        )*};
    }
    starts!(7 6 5 4 3 2 1 0);
    let mut right = p.line(w);
    out[1] = p.merge(out[1], right);
    macro_rules! ends {
        ($($k:literal)*) => {$(
            right = p.merge(right, p.line(w + $k - 1));
            out[$k] = p.merge(out[$k], right);
        )*};
    }
    ends!(2 3 4 5 6 7);
    out
}

/// Lines of one axis: those that exist have a number in `0..extent`.
#[derive(Debug, Clone, Copy)]
pub struct Axis {
    /// Number of the first line of the first block; negative in front of the volume.
    pub first: isize,
    pub extent: usize,
    /// Lines of a window.
    pub window: usize,
    /// Blocks of outputs.
    pub blocks: usize,
}

impl Axis {
    /// Lines `from..to` that exist.
    fn existing(&self, from: usize, to: usize) -> f64 {
        let at = |i: usize| (self.first + i as isize).clamp(0, self.extent as isize);
        (at(to) - at(from)) as f64
    }

    /// Lines that exist in the window of output `k`, at least 1 so that it may divide.
    pub fn count(&self, k: usize) -> f64 {
        self.existing(k, k + self.window).max(1.0)
    }

    /// Groups from 0 on that blocks may ask for.
    pub fn groups(&self) -> usize {
        if groups(self.window) == 0 { 0 } else { self.blocks + groups(self.window) }
    }
}

/// Counts of existing lines; remembers the weights of merges.
struct Counting<'a> {
    axis: Axis,
    /// First line.
    start: usize,
    weights: &'a mut [Weight],
    at: usize,
}

impl Parts for Counting<'_> {
    type Part = f64;
    fn line(&self, i: usize) -> f64 {
        self.axis.existing(self.start + i, self.start + i + 1)
    }
    fn group(&self, q: usize) -> f64 {
        self.axis.existing(self.start + BLOCK * q, self.start + BLOCK * (q + 1))
    }
    fn merge(&mut self, a: f64, b: f64) -> f64 {
        self.weights[self.at] = Weight::of(a, b);
        self.at += 1;
        a + b
    }
}

/// Weights of all merges along one axis where no voxel is missing: those of groups and of blocks. Blocks that lie alike
/// share theirs.
pub struct Weights<'a> {
    groups: &'a mut [Weight],
    blocks: &'a mut [Weight],
    /// Which of the distinct ones a block has.
    kind: &'a mut [u32],
    window: usize,
}

impl<'a> Weights<'a> {
    /// Elements: weights of groups, of distinct blocks, and blocks, for `blocks` blocks.
    pub fn lens(w: usize, blocks: usize) -> [usize; 3] {
        let groups = if groups(w) == 0 { 0 } else { blocks + groups(w) };
        // Blocks that reach beyond one end or the other differ from each other; those between are alike.
        let distinct = blocks.min(2 * (w / BLOCK + 3) + 1);
        [groups * OCTET, distinct * merges(w), blocks]
    }

    pub fn new(w: usize, groups: &'a mut [Weight], blocks: &'a mut [Weight], kind: &'a mut [u32]) -> Self {
        Weights { groups, blocks, kind, window: w }
    }

    /// Works the weights out for lines that lie so.
    pub fn fill(&mut self, axis: Axis) {
        assert_eq!(axis.window, self.window);
        for q in 1..axis.groups() {
            let weights = &mut self.groups[q * OCTET..][..OCTET];
            octet(&mut Counting { axis, start: q * BLOCK, weights, at: 0 });
        }
        let size = merges(self.window);
        let mut kinds = 0;
        let mut inner = None;
        for b in 0..axis.blocks {
            let start = b * BLOCK;
            let reach = BLOCK + self.window - 1;
            let whole = axis.existing(start, start + reach) == reach as f64;
            let kind = match inner.filter(|_| whole) {
                Some(kind) => kind,
                None => {
                    let weights = &mut self.blocks[kinds * size..][..size];
                    block(&mut Counting { axis, start, weights, at: 0 }, self.window);
                    kinds += 1;
                    kinds as u32 - 1
                }
            };
            if whole {
                inner = Some(kind);
            }
            self.kind[b] = kind;
        }
    }

    /// Of the merges of block `b`.
    pub fn of_block(&self, b: usize) -> &[Weight] {
        let size = merges(self.window);
        &self.blocks[self.kind[b] as usize * size..][..size]
    }

    /// Of the merges of group `q`.
    pub fn of_group(&self, q: usize) -> &[Weight] {
        &self.groups[q * OCTET..][..OCTET]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Parts as the sets of lines that they hold, in a bit mask.
    struct Sets {
        merged: usize,
    }

    impl Parts for Sets {
        type Part = u128;
        fn line(&self, i: usize) -> u128 {
            1 << i
        }
        fn group(&self, q: usize) -> u128 {
            0xff << (BLOCK * q)
        }
        fn merge(&mut self, a: u128, b: u128) -> u128 {
            self.merged += 1;
            assert!(a & b == 0, "a line counts once");
            a | b
        }
    }

    #[test]
    fn blocks_hold_the_lines_of_their_windows() {
        for w in (1..=111).step_by(2) {
            let mut sets = Sets { merged: 0 };
            for (k, set) in block(&mut sets, w).into_iter().enumerate() {
                assert_eq!(set, ((1u128 << w) - 1) << k, "{w} {k}");
            }
            assert_eq!(sets.merged, merges(w), "{w}");
        }
        let mut sets = Sets { merged: 0 };
        assert_eq!((octet(&mut sets), sets.merged), (0xff, OCTET));
    }

    #[test]
    fn distinct_weights_fit_their_room_and_interior_blocks_share_theirs() {
        for w in [1, 3, 7, 9, 15, 17, 21, 129] {
            for extent in [1, 5, 20, 200, 1000] {
                for phase in 0..BLOCK {
                    let blocks = (extent + phase).div_ceil(BLOCK);
                    let axis = Axis { first: -((w / 2 + phase) as isize), extent, window: w, blocks };
                    let [g, b, k] = Weights::lens(w, blocks);
                    let (mut g, mut b, mut k) = (vec![Weight::default(); g], vec![Weight::default(); b], vec![0; k]);
                    let mut weights = Weights::new(w, &mut g, &mut b, &mut k);
                    weights.fill(axis);
                    assert!((0..blocks).all(|b| weights.of_block(b).len() == merges(w)));
                    for k in phase..(phase + extent) {
                        let centre = k - phase;
                        let count = (centre + w / 2 + 1).min(extent) - centre.saturating_sub(w / 2);
                        assert_eq!(axis.count(k), count as f64);
                    }
                }
            }
        }
    }
}
