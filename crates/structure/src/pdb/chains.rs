//! Meaning of column 21 of ATOM records: the fourth letter of a residue name, or the first letter of a chain name.
//!
//! Programs that write many chains put two-letter names into columns 21 and 22. Simulation programs put four-letter
//! residue names into columns 18 to 21. `HISA` of chain `A` and `HIS` of chain `AA` look the same. A single row is
//! ambiguous, but the whole file is not: within a chain with a two-letter name, column 21 is always the same letter.
//! Four-letter residue names change that letter, or leave it blank.

use std::collections::{HashMap, HashSet};

use super::super::residue::{is_four_letters, is_polymer, is_water};
use super::card::{Card, card, expand_tabs, residue_number};
use super::lines::Lines;

/// Columns 21 and 22.
type ChainLetters = [u8; 2];

/// Chains of two letters, in columns 21 and 22.
#[derive(Debug, Default)]
pub(super) struct TwoLetterChains {
    /// Pairs for which the file has evidence; true for chain names.
    is_chain_name: HashMap<ChainLetters, bool>,
    /// True if all these pairs are chain names, false if none is; `None` otherwise.
    all: Option<bool>,
}

impl TwoLetterChains {
    /// Collects the evidence in a file.
    pub(super) fn find(text: &[u8]) -> Self {
        let mut evidence = Evidence::default();
        Lines::new(text).for_each(|(start, end)| evidence.line(&text[start..end]));
        let is_chain_name = evidence.chain_names();
        let first = is_chain_name.values().next().copied();
        let all = first.filter(|first| is_chain_name.values().all(|chain| chain == first));
        Self { is_chain_name, all }
    }

    /// Returns true if column 21 of an ATOM record, given by its columns 18 to 22, belongs to the chain name. Column 21
    /// must not be blank.
    pub(super) fn has(&self, columns: [u8; 5]) -> bool {
        let [a, b, c, first, second] = columns;
        if second <= b' ' {
            return false;
        }
        if let Some(&chain) = self.is_chain_name.get(&[first, second]) {
            return chain;
        }
        // Without evidence for this pair, the residue name determines it. Short names are right-aligned in columns 18
        // to 20.
        let (three, four) = (NameLists::of(&[a, b, c]), NameLists::of(&columns[..4]));
        if [a, b, c].contains(&b' ') {
            self.all != Some(false)
        } else if four.four_letters {
            three.polymer && self.all == Some(true)
        } else {
            three.polymer || three.water || self.all == Some(true)
        }
    }
}

/// Lists of residue names that contain a name.
#[derive(Debug, Clone, Copy, Default)]
struct NameLists {
    polymer: bool,
    water: bool,
    four_letters: bool,
}

impl NameLists {
    fn of(columns: &[u8]) -> Self {
        let Ok(name) = std::str::from_utf8(columns.trim_ascii()) else { return Self::default() };
        Self { polymer: is_polymer(name), water: is_water(name), four_letters: is_four_letters(name) }
    }
}

/// Columns 18-27 of a residue: name, chain and number.
type ResidueText = [u8; 10];

/// Evidence on pairs of letters, from the residues and SEQRES records of a file.
#[derive(Debug, Default)]
struct Evidence {
    /// For each pair, how often the next residue of a chain has the same pair, and how often another one.
    counts: HashMap<ChainLetters, [u64; 2]>,
    /// Pairs named by SEQRES records.
    listed: HashSet<ChainLetters>,
    /// Residue of the previous ATOM record; `None` where a chain may end.
    before: Option<ResidueText>,
}

impl Evidence {
    fn line(&mut self, line: &[u8]) {
        if line.starts_with(b"ATOM") && line.len() >= 54 {
            if line.contains(&b'\t') {
                self.atom(&card(&expand_tabs(line).0));
            } else if let Some(card) = line.first_chunk() {
                self.atom(card);
            } else {
                self.atom(&card(line));
            }
            return;
        }
        match line {
            [b'S', b'E', b'Q', b'R', b'E', b'S', _, _, _, _, first, second, ..]
                if first.is_ascii_alphanumeric() && second.is_ascii_alphanumeric() =>
            {
                self.listed.insert([*first, *second]);
            }
            _ if [&b"TER"[..], b"END", b"MODEL", b"HETATM"].iter().any(|record| line.starts_with(record)) => {
                self.before = None;
            }
            _ => {}
        }
    }

    #[inline]
    fn atom(&mut self, card: &Card) {
        let mut here = ResidueText::default();
        here.copy_from_slice(&card[17..27]);
        if self.before != Some(here) {
            if let Some(before) = self.before {
                self.step(before, here);
            }
            self.before = Some(here);
        }
    }

    /// Counts a pair of consecutive residues, if their numbers are consecutive too.
    fn step(&mut self, before: ResidueText, here: ResidueText) {
        let letters = [before[3], here[3]].map(|b| if b <= b' ' { b' ' } else { b });
        if before[4] != here[4] || letters == [b' '; 2] || before[..4] == here[..4] {
            return;
        }
        let (Some(m), Some(n)) = (number(before), number(here)) else { return };
        if n != m + 1 {
            return;
        }
        let names = [before, here].map(|residue| NameLists::of(&residue[..3]));
        if names.iter().any(|name| name.water) {
            return;
        }
        if letters[0] == letters[1] {
            // Four-letter names may follow each other: lipids POPC and DOPC, residues GLUH and LYSH.
            let four = [before, here].map(|residue| NameLists::of(&residue[..4]).four_letters);
            if names.iter().all(|name| name.polymer) && four != [true; 2] {
                self.counts.entry([letters[0], here[4]]).or_default()[0] += 1;
            }
        } else {
            for letter in letters.into_iter().filter(|&letter| letter != b' ') {
                self.counts.entry([letter, here[4]]).or_default()[1] += 1;
            }
        }
    }

    fn chain_names(self) -> HashMap<ChainLetters, bool> {
        let counted = self.counts.into_iter().map(|(pair, [stays, changes])| (pair, stays > changes));
        counted.chain(self.listed.into_iter().map(|pair| (pair, true))).collect()
    }
}

fn number(residue: ResidueText) -> Option<i64> {
    let mut card = [b' '; 80];
    card[17..27].copy_from_slice(&residue);
    residue_number(&card).ok().map(|(number, _)| number.into())
}
