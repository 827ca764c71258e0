//! Which quantile levels stand for a volume: a pure function of its values and how often each occurs.

/// Levels of a volume, ascending in the order of density (`solid` and a negative slope turn values around).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Levels {
    /// Turned values: negated where smaller stored values are denser.
    pub at: Vec<f64>,
    /// Whether no voxel lies strictly between a level and the one before it: there the distribution is a step, not a slope.
    pub step: Vec<bool>,
}

impl Levels {
    /// As the numbers that a pre-pass keeps.
    pub fn to_numbers(&self) -> Vec<f64> {
        self.at.iter().zip(&self.step).flat_map(|(t, s)| [*t, f64::from(u8::from(*s))]).collect()
    }

    pub fn from_numbers(numbers: &[f64]) -> Levels {
        let pairs = || numbers.chunks_exact(2);
        Levels { at: pairs().map(|p| p[0]).collect(), step: pairs().map(|p| p[1] != 0.0).collect() }
    }

    /// At most `count` levels of `values`, ascending turned values with weights above 0. As many values as levels: each is
    /// a level, and everything is exact. Else the ends; values that more than a fair share of the voxels have, each with the
    /// value before it, so that what they add is a step; and quantiles of the others.
    pub fn choose(values: &[(f64, u64)], count: usize) -> Levels {
        if values.len() <= count {
            return Levels { at: values.iter().map(|v| v.0).collect(), step: vec![true; values.len()] };
        }
        let mut chosen = vec![false; values.len()];
        chosen[0] = true;
        chosen[values.len() - 1] = true;
        let atoms = atoms(values, count);
        let mut free = count.saturating_sub(2);
        for &i in &atoms {
            let new = [i, i.saturating_sub(1)].into_iter().filter(|&i| !chosen[i]).count();
            if new <= free {
                free -= new;
                (chosen[i], chosen[i.saturating_sub(1)]) = (true, true);
            }
        }
        quantiles(values, &atoms, free, &mut chosen);
        let left = count - chosen.iter().filter(|c| **c).count();
        (0..left).for_each(|_| split_heaviest(values, &mut chosen));
        let picked: Vec<usize> = (0..values.len()).filter(|&i| chosen[i]).collect();
        let step = (0..picked.len()).map(|k| k == 0 || picked[k] == picked[k - 1] + 1).collect();
        Levels { at: picked.iter().map(|&i| values[i].0).collect(), step }
    }
}

/// Values with more than their share of the weight, the heaviest first, ties by value.
fn atoms(values: &[(f64, u64)], count: usize) -> Vec<usize> {
    let total: u64 = values.iter().map(|v| v.1).sum();
    let mut heavy: Vec<usize> = (0..values.len()).filter(|&i| values[i].1 > total / count as u64).collect();
    heavy.sort_by_key(|&i| (std::cmp::Reverse(values[i].1), i));
    heavy
}

/// Marks values that cut the weight of all but the atoms into `free + 1` equal parts.
fn quantiles(values: &[(f64, u64)], atoms: &[usize], free: usize, chosen: &mut [bool]) {
    let weight = |i: usize| if atoms.contains(&i) { 0 } else { values[i].1 };
    let total: u64 = (0..values.len()).map(weight).sum();
    let (mut below, mut next) = (0u128, 1u128);
    for (i, chosen) in chosen.iter_mut().enumerate() {
        below += u128::from(weight(i));
        while next <= free as u128 && below * (free as u128 + 1) >= u128::from(total) * next {
            *chosen = true;
            next += 1;
        }
    }
}

/// Marks one value more: the middle of the weight between the two neighbouring levels that have most in between.
fn split_heaviest(values: &[(f64, u64)], chosen: &mut [bool]) {
    let picked: Vec<usize> = (0..values.len()).filter(|&i| chosen[i]).collect();
    let inside = |p: &[usize]| values[p[0] + 1..p[1]].iter().map(|v| v.1).sum::<u64>();
    let Some(gap) = picked.windows(2).filter(|p| p[1] > p[0] + 1).max_by_key(|p| (inside(p), std::cmp::Reverse(p[0])))
    else {
        return;
    };
    let half = inside(gap).div_ceil(2);
    let mut below = 0;
    for i in gap[0] + 1..gap[1] {
        below += values[i].1;
        if below >= half {
            chosen[i] = true;
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_values_are_all_levels() {
        let levels = Levels::choose(&[(-3.0, 5), (0.0, 1), (7.0, 90)], 8);
        assert_eq!(levels, Levels { at: vec![-3.0, 0.0, 7.0], step: vec![true; 3] });
        assert_eq!(Levels::from_numbers(&levels.to_numbers()), levels);
        assert_eq!(Levels::choose(&[], 8), Levels::default());
    }

    #[test]
    fn even_weights_give_even_levels_with_both_ends() {
        let values: Vec<(f64, u64)> = (0..1000).map(|i| (f64::from(i), 3)).collect();
        for count in [8, 31, 32, 64] {
            let levels = Levels::choose(&values, count);
            assert_eq!(levels.at.len(), count);
            assert_eq!((levels.at[0], levels.at[count - 1]), (0.0, 999.0));
            let widest = levels.at.windows(2).map(|w| w[1] - w[0]).fold(0.0, f64::max);
            assert!(widest <= 2.0 * 1000.0 / count as f64, "{count}: {widest}");
            assert!(levels.step[1..].iter().all(|s| !s));
        }
    }

    #[test]
    fn an_atom_is_a_step() {
        let mut values: Vec<(f64, u64)> = (0..100).map(|i| (f64::from(i) * 2.0, 10)).collect();
        values[40].1 = 5000;
        let levels = Levels::choose(&values, 16);
        assert_eq!(levels.at.len(), 16);
        let at = levels.at.iter().position(|t| *t == 80.0).expect("the atom is a level");
        assert!(levels.step[at] && levels.at[at - 1] == 78.0);
        assert!(levels.at.is_sorted());
    }

    #[test]
    fn many_atoms_take_no_more_than_there_is() {
        let values: Vec<(f64, u64)> = (0..40).map(|i| (f64::from(i), if i % 2 == 0 { 1000 } else { 1 })).collect();
        for count in 8..40 {
            let levels = Levels::choose(&values, count);
            assert_eq!(levels.at.len(), count, "{count}");
            assert!(levels.at.windows(2).all(|w| w[0] < w[1]));
        }
    }
}
