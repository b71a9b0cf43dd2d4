//! Search for the known name most similar to an unknown one, for error messages. Uses the edit distance.

/// Returns the candidate with the fewest edits (insertions, deletions, replacements, swaps of adjacent bytes) from
/// `name`, and the first of several. Returns `None` if it differs by more than a third of the longer name plus one.
#[must_use]
pub fn nearest<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let name = name.to_ascii_lowercase();
    candidates
        .into_iter()
        .map(|candidate| (distance(&name, candidate), candidate))
        .filter(|(edits, candidate)| *edits <= candidate.len().max(name.len()) / 3 + 1)
        .min_by_key(|(edits, _)| *edits)
        .map(|(_, candidate)| candidate)
}

/// Returns the optimal string alignment distance in bytes. Compares at most 64 bytes, since longer names are not typos.
fn distance(a: &str, b: &str) -> usize {
    let (a, b) = (&a.as_bytes()[..a.len().min(64)], &b.as_bytes()[..b.len().min(64)]);
    let mut before = vec![0; b.len() + 1];
    let mut last: Vec<usize> = (0..=b.len()).collect();
    for i in 1..=a.len() {
        let mut row = vec![i; b.len() + 1];
        for j in 1..=b.len() {
            let replace = last[j - 1] + usize::from(a[i - 1] != b[j - 1]);
            row[j] = replace.min(last[j] + 1).min(row[j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                row[j] = row[j].min(before[j - 2] + 1);
            }
        }
        before = std::mem::replace(&mut last, row);
    }
    last[b.len()]
}

#[cfg(test)]
mod tests {
    use super::{distance, nearest};

    #[test]
    fn distances() {
        for (a, b, edits) in
            [("", "", 0), ("abc", "", 3), ("kernel", "kernal", 1), ("ab", "ba", 1), ("kitten", "sitting", 3)]
        {
            assert_eq!(distance(a, b), edits, "{a} {b}");
        }
    }

    #[test]
    fn finds_typos_and_ignores_unrelated_names() {
        let names = ["resolution", "radius_scale", "chains"];
        assert_eq!(nearest("resolutoin", names), Some("resolution"));
        assert_eq!(nearest("Chain", names), Some("chains"));
        assert_eq!(nearest("zzzzzzzzzz", names), None);
    }
}
