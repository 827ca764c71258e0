//! "Did you mean": the nearest of some words.

/// Edits (insert, delete, replace, swap neighbours) that turn `a` into `b`.
pub fn distance(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let mut rows = vec![vec![0; b.len() + 1]; a.len() + 1];
    for i in 0..=a.len() {
        for j in 0..=b.len() {
            rows[i][j] = if i == 0 || j == 0 {
                i + j
            } else {
                let same = usize::from(a[i - 1] != b[j - 1]);
                let swapped = i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1];
                let swap = if swapped { rows[i - 2][j - 2] + 1 } else { usize::MAX };
                (rows[i - 1][j] + 1).min(rows[i][j - 1] + 1).min(rows[i - 1][j - 1] + same).min(swap)
            };
        }
    }
    rows[a.len()][b.len()]
}

/// The word nearest to `given`, unless even that is far off.
pub fn nearest<'a>(given: &str, words: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    if given.chars().count() > 64 {
        return None;
    }
    let lower = given.to_lowercase();
    let scored =
        words.into_iter().filter(|w| w.chars().count() <= 64).map(|w| (distance(&lower, &w.to_lowercase()), w));
    let (edits, word) = scored.min_by_key(|(d, _)| *d)?;
    let allowed = (given.chars().count().max(word.chars().count()) / 3).max(1);
    (edits <= allowed).then_some(word)
}

/// `; did you mean "word"?`, or nothing.
pub fn hint<'a>(given: &str, words: impl IntoIterator<Item = &'a str>) -> String {
    nearest(given, words).map_or(String::new(), |w| format!("; did you mean {w:?}?"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_words_are_found_and_far_ones_are_not() {
        assert_eq!(distance("radius", "raduis"), 1);
        assert_eq!(distance("", "abc"), 3);
        let words = ["radius", "method", "border", "ties"];
        assert_eq!(nearest("raduis", words), Some("radius"));
        assert_eq!(nearest("Methods", words), Some("method"));
        assert_eq!(nearest("zebra", words), None);
        assert_eq!(nearest("x", words), None);
    }
}
