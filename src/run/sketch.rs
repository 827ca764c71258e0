//! The distribution of a wire's values over the whole volume, from which quantile levels are chosen: exact counts for types
//! of 8 and 16 bits; for the others a sample whose places depend on the voxels' coordinates alone, all values where they are
//! few, and the exact ends. Order never matters, so bricks and threads do not.

use std::sync::Mutex;

use super::compute::Finished;
use super::value::Comp;
use crate::grid::hash::mix;
use crate::grid::{DType, Region, Shape, View};
use crate::kernel::levels::{Coded, Levels, MOST_LEVELS};
use crate::plan::Plan;
use crate::plan::graph::WireId;

/// Voxels of a sample, about.
const SAMPLE: usize = 1 << 17;

/// What was found so far.
#[derive(Debug)]
enum Found {
    /// Voxels by value, from the type's least on.
    Counts(Vec<u64>),
    Sample {
        /// All distinct values, while they are no more than a volume may have levels.
        few: Option<Vec<f64>>,
        least: f64,
        most: f64,
        sample: Vec<f64>,
    },
}

/// Collects a wire's finite values.
#[derive(Debug)]
pub struct Sketch {
    dtype: DType,
    /// Every so many voxels of a row are in the sample.
    stride: usize,
    found: Mutex<Found>,
}

fn nothing(dtype: DType) -> Found {
    if dtype.size() <= 2 {
        Found::Counts(vec![0; 1 << (8 * dtype.size())])
    } else {
        Found::Sample { few: Some(Vec::new()), least: f64::INFINITY, most: f64::NEG_INFINITY, sample: Vec::new() }
    }
}

/// SplitMix64 of a row's place.
fn hash(z: i64, y: i64) -> u64 {
    mix((z as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (y as u64).wrapping_mul(0xd1b5_4a32_d192_ed03))
}

impl Sketch {
    pub fn new(dtype: DType, volume: Shape) -> Sketch {
        let stride = volume.iter().product::<usize>().div_ceil(SAMPLE).max(1);
        Sketch { dtype, stride, found: Mutex::new(nothing(dtype)) }
    }

    /// Takes in a finished brick's wires.
    pub fn add(&self, plan: &Plan, wires: &[WireId], done: &Finished) {
        let mut part = nothing(self.dtype);
        for &w in wires {
            let (value, missing) = (done.value(w), plan.graph.wires[w].missing);
            for (c, comp) in value.comps.iter().enumerate() {
                match comp {
                    Comp::Const(v) => self.constant(*v, missing, done.brick, &mut part),
                    Comp::Voxels(_) => {
                        let view = value.view(c, done.brick);
                        crate::with_view!(AnyView, view, v => self.voxels(v, missing, done.brick, &mut part));
                    }
                }
            }
        }
        merge(&mut self.found.lock().unwrap_or_else(|e| e.into_inner()), part);
    }

    /// Columns of a row that are in the sample.
    fn columns(&self, z: i64, y: i64, brick: &Region) -> impl Iterator<Item = usize> + use<> {
        let first = (hash(z, y) % self.stride as u64) as i64;
        let behind = (brick.lo[2] - first).max(0) as usize;
        let start = first + (behind.div_ceil(self.stride) * self.stride) as i64;
        (start..brick.hi[2]).step_by(self.stride).map({
            let lo = brick.lo[2];
            move |x| (x - lo) as usize
        })
    }

    fn constant(&self, v: f64, missing: Option<i64>, brick: Region, part: &mut Found) {
        if !v.is_finite() || missing.is_some_and(|m| m as f64 == v) {
            return;
        }
        match part {
            Found::Counts(counts) => counts[(v - self.dtype.range().0) as usize] += brick.voxels() as u64,
            Found::Sample { few, least, most, sample } => {
                let v = v + 0.0; // one zero
                note(few, v);
                (*least, *most) = (least.min(v), most.max(v));
                for (z, y) in (brick.lo[0]..brick.hi[0]).flat_map(|z| (brick.lo[1]..brick.hi[1]).map(move |y| (z, y))) {
                    sample.extend(self.columns(z, y, &brick).map(|_| v));
                }
            }
        }
    }

    fn voxels<T: Coded>(&self, view: View<T>, missing: Option<i64>, brick: Region, part: &mut Found) {
        let counts_for = |v: f64| v.is_finite() && missing.is_none_or(|m| m as f64 != v);
        let first = self.dtype.range().0;
        for (z, y) in (0..view.shape[0]).flat_map(|z| (0..view.shape[1]).map(move |y| (z, y))) {
            let row = view.row_at(z, y);
            match part {
                Found::Counts(counts) => tally(row, counts),
                Found::Sample { few, least, most, sample } => {
                    for v in row.iter().map(|v| v.to_f64() + 0.0).filter(|v| counts_for(*v)) {
                        (*least, *most) = (least.min(v), most.max(v));
                        note(few, v);
                    }
                    let places = self.columns(brick.lo[0] + z as i64, brick.lo[1] + y as i64, &brick);
                    sample.extend(places.map(|x| row[x].to_f64() + 0.0).filter(|v| counts_for(*v)));
                }
            }
        }
        if let (Found::Counts(counts), Some(m)) = (part, missing)
            && let Some(lost) = counts.get_mut((m as f64 - first) as usize).filter(|_| m as f64 >= first)
        {
            *lost = 0;
        }
    }

    /// The levels; `flipped` where smaller stored values are denser. `beyond`, the value of a constant border, is one of them:
    /// it may fill most of a window and yet occur nowhere in the volume.
    pub fn levels(self, count: usize, flipped: bool, beyond: Option<f64>) -> Levels {
        let turn = |v: f64| if flipped { 0.0 - v } else { v };
        // As windows see it.
        let beyond = beyond.map(|v| if self.dtype.result() == DType::F32 { f64::from(v as f32) } else { v } + 0.0);
        let (mut values, sampled) = match self.found.into_inner().unwrap_or_else(|e| e.into_inner()) {
            Found::Counts(counts) => {
                let first = self.dtype.range().0;
                let seen = counts.iter().enumerate().filter(|(_, n)| **n > 0);
                (seen.map(|(i, n)| (turn(first + i as f64), *n)).collect::<Vec<_>>(), false)
            }
            Found::Sample { few: Some(few), .. }
                if few.len() + usize::from(beyond.is_some_and(|v| !few.contains(&v))) <= count =>
            {
                (few.iter().map(|v| (turn(*v), 1)).collect(), false)
            }
            Found::Sample { least, most, mut sample, .. } => {
                sample.extend([least, most]);
                (weigh(sample.into_iter().map(turn).collect()), true)
            }
        };
        if let Some(v) = beyond.map(turn) {
            give_weight(&mut values, v, count);
        }
        values.sort_by(|a, b| a.0.total_cmp(&b.0));
        if !sampled {
            return Levels::choose(&values, count);
        }
        // Other values may lie between two of a sample, but not between one and the number before it.
        let total: u64 = values.iter().map(|v| v.1).sum();
        let heavy = values.iter().filter(|v| v.1 > total / count as u64).map(|v| (before(self.dtype, v.0), 0));
        let least = values[0].0;
        let extra: Vec<(f64, u64)> = heavy.filter(|v| v.0 > least && !values.iter().any(|w| w.0 == v.0)).collect();
        values.extend(extra);
        values.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut levels = Levels::choose(&values, count);
        for k in 1..levels.at.len() {
            levels.step[k] = levels.at[k - 1] == before(self.dtype, levels.at[k]);
        }
        levels
    }
}

/// Counts the values of a row. Four equal ones at once: a background is the same count again and again, each add of which waits for
/// the one before.
fn tally<T: Coded>(row: &[T], counts: &mut [u64]) {
    let (fours, rest) = row.as_chunks::<4>();
    for four in fours {
        let [a, b, c, d] = four.map(Coded::place);
        if a == b && b == c && c == d {
            counts[a] += 4;
        } else {
            [a, b, c, d].into_iter().for_each(|place| counts[place] += 1);
        }
    }
    rest.iter().for_each(|v| counts[v.place()] += 1);
}

/// The next smaller number of a type.
fn before(dtype: DType, v: f64) -> f64 {
    match dtype {
        DType::F32 => f64::from((v as f32).next_down()),
        DType::F64 => v.next_down(),
        _ => v - 1.0,
    }
}

/// Adds a value to the distinct ones, unless they are too many.
fn note(few: &mut Option<Vec<f64>>, v: f64) {
    let Some(list) = few else { return };
    if let Err(at) = list.binary_search_by(|w| w.total_cmp(&v)) {
        list.insert(at, v);
        if list.len() > MOST_LEVELS {
            *few = None;
        }
    }
}

fn merge(all: &mut Found, part: Found) {
    match (all, part) {
        (Found::Counts(all), Found::Counts(part)) => all.iter_mut().zip(part).for_each(|(a, p)| *a += p),
        (
            Found::Sample { few, least, most, sample },
            Found::Sample { few: part_few, least: part_least, most: part_most, sample: part_sample },
        ) => {
            match part_few {
                Some(list) => list.into_iter().for_each(|v| note(few, v)),
                None => *few = None,
            }
            (*least, *most) = (least.min(part_least), most.max(part_most));
            sample.extend(part_sample);
        }
        _ => unreachable!("one type has one kind of sketch"),
    }
}

/// Makes a value one of those that more than their share of all have, which are levels.
fn give_weight(values: &mut Vec<(f64, u64)>, v: f64, count: usize) {
    let total: u64 = values.iter().map(|v| v.1).sum();
    let more = total / (count as u64 - 1) + 1;
    match values.iter_mut().find(|w| w.0 == v) {
        Some(known) => known.1 += more,
        None => values.push((v, more)),
    }
}

/// Distinct values with their numbers.
fn weigh(mut all: Vec<f64>) -> Vec<(f64, u64)> {
    all.retain(|v| v.is_finite());
    all.sort_by(f64::total_cmp);
    let mut values: Vec<(f64, u64)> = Vec::new();
    for v in all {
        match values.last_mut() {
            Some((last, n)) if *last == v => *n += 1,
            _ => values.push((v, 1)),
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::Voxels;

    const SHAPE: Shape = [30, 40, 150];

    /// The levels of a volume that arrives in bricks of one edge.
    fn levels(v: &[f32], edge: usize, count: usize, flipped: bool) -> Levels {
        let (whole, all) = (Region::whole(SHAPE), Voxels::F32(v.to_vec()));
        let sketch = Sketch::new(DType::F32, SHAPE);
        for cell in whole.cells([0; 3], [edge; 3]).iter() {
            let brick = Region::of_cell(cell, [0; 3], [edge; 3]).clip(&whole);
            let mut part = Voxels::zeroed(DType::F32, brick.voxels());
            crate::brick::gather::copy_common(all.view(SHAPE), whole, part.view_mut(brick.shape()), brick);
            let Voxels::F32(part) = part else { unreachable!() };
            let mut found = nothing(DType::F32);
            sketch.voxels(View::dense(&part, brick.shape()), None, brick, &mut found);
            merge(&mut sketch.found.lock().unwrap(), found);
        }
        sketch.levels(count, flipped, None)
    }

    #[test]
    fn a_sample_does_not_depend_on_bricks_and_bears_offsets_and_outliers() {
        let n = SHAPE.iter().product::<usize>();
        let mut v: Vec<f32> = (0..n).map(|i| 1e6 + (hash(i as i64, 7) % 4096) as f32 / 16.0).collect();
        (v[5], v[77], v[1234], v[99]) = (1e30, f32::NAN, f32::INFINITY, -3e38);
        for flipped in [false, true] {
            let found = levels(&v, 1000, 32, flipped);
            assert_eq!(found, levels(&v, 7, 32, flipped));
            assert_eq!(found, levels(&v, 64, 32, flipped));
            assert_eq!(found.at.len(), 32);
            let ends = if flipped {
                [-f64::from(1e30f32), f64::from(3e38f32)]
            } else {
                [-f64::from(3e38f32), f64::from(1e30f32)]
            };
            assert_eq!([found.at[0], found.at[31]], ends);
            // Even shares of the noise: 30 levels inside its 256 units.
            let inner: Vec<f64> = found.at[1..31].iter().map(|t| t.abs() - 1e6).collect();
            assert!(inner.iter().all(|t| (0.0..=256.0).contains(t)), "{inner:?}");
            let widest = inner.windows(2).map(|w| (w[1] - w[0]).abs()).fold(0.0, f64::max);
            assert!(widest < 2.0 * 256.0 / 31.0, "{widest}");
        }
    }

    #[test]
    fn the_value_of_a_border_is_a_level() {
        let region = Region::whole([1, 1, 4096]);
        let noise: Vec<f32> = (0..4096).map(|i| (hash(i, 3) % 1000) as f32).collect();
        let found = |v: &[f32], dtype, count, flipped, beyond| {
            let sketch = Sketch::new(dtype, region.shape());
            let mut part = nothing(dtype);
            let codes: Vec<u16> = v.iter().map(|v| *v as u16).collect();
            match dtype {
                DType::F32 => sketch.voxels(View::dense(v, region.shape()), None, region, &mut part),
                _ => sketch.voxels(View::dense(&codes, region.shape()), None, region, &mut part),
            }
            merge(&mut sketch.found.lock().unwrap(), part);
            sketch.levels(count, flipped, Some(beyond))
        };
        for (dtype, flipped) in [(DType::F32, false), (DType::F32, true), (DType::U16, false), (DType::U16, true)] {
            for beyond in [-77.0, 500.0, 333.25, 5000.0] {
                let levels = found(&noise, dtype, 16, flipped, beyond);
                let turned = if flipped { -beyond } else { beyond };
                let at = levels.at.iter().position(|v| *v == turned).expect("the border's value is a level");
                assert!(levels.step[at] && levels.at.len() == 16, "{dtype:?} {beyond}: {levels:?}");
            }
        }
        // With eight values there is room for one more, with nine there is not, and it is a level all the same.
        for kinds in [8, 9] {
            let few: Vec<f32> = (0..4096).map(|i| (i % kinds) as f32).collect();
            for dtype in [DType::F32, DType::U16] {
                let levels = found(&few, dtype, 9, false, 100.5);
                assert!(levels.at.contains(&100.5) && levels.at.len() == 9, "{levels:?}");
                assert!(kinds == 9 || levels.step.iter().all(|s| *s));
            }
        }
    }

    #[test]
    fn few_values_and_atoms_of_floats() {
        let n = SHAPE.iter().product::<usize>();
        let few: Vec<f32> = (0..n).map(|i| (i % 9) as f32 * 0.5).collect();
        assert_eq!(levels(&few, 20, 9, false).at, (0..9).map(|i| f64::from(i) * 0.5).collect::<Vec<_>>());
        assert!(levels(&few, 20, 9, false).step.iter().all(|s| *s));
        // Half of the voxels are 0.25 exactly, inside the noise of the others.
        let atom: Vec<f32> = (0..n)
            .map(|i| if i % 2 == 0 { 0.25 } else { (hash(i as i64, 1) >> 40) as f32 / (1 << 24) as f32 })
            .collect();
        let found = levels(&atom, 50, 16, false);
        let at = found.at.iter().position(|t| *t == 0.25).expect("the atom is a level");
        assert!(found.step[at] && found.at[at - 1] == f64::from(0.25f32.next_down()));
        assert!(!found.step[at + 1]);
    }
}
