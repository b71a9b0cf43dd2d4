//! Conditions on atoms, in a canonical form: expressions that differ only in order, repetition or parentheses are
//! equal.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use super::parse::{self, BadExpression};
use crate::KindSet;
use crate::element::symbol;

/// Expression that selects atoms, such as `protein and chain A`. The default is `polymer`.
///
/// `docs/atoms.md` describes the language.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Expression {
    pub(super) condition: Condition,
    /// True if the expression mentions hydrogens, which are then meshed as well.
    pub(super) hydrogens: bool,
}

impl Expression {
    /// Returns true if an atom is selected by its distance from others.
    #[must_use]
    pub fn has_within(&self) -> bool {
        self.condition.has_within()
    }
}

impl Default for Expression {
    fn default() -> Self {
        Self { condition: Condition::Kinds(KindSet::POLYMER), hydrogens: false }
    }
}

impl FromStr for Expression {
    type Err = BadExpression;

    fn from_str(text: &str) -> Result<Self, BadExpression> {
        parse::expression(text)
    }
}

/// Writes the canonical form, which parses to the same expression. Equal expressions give the same text.
impl fmt::Display for Expression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.condition {
            Condition::Kinds(set) if *set == KindSet::ALL && self.hydrogens => f.write_str("all"),
            condition if self.hydrogens => write!(f, "{condition},hydrogens"),
            condition => write!(f, "{condition}"),
        }
    }
}

/// Condition on an atom. The variants are in canonical order.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Condition {
    /// One of these kinds.
    Kinds(KindSet),
    /// One of these author names of chains; the empty string and `_` are the blank chain.
    Chains(BTreeSet<String>),
    /// In one of these ranges of residue numbers.
    Residues(BTreeSet<ResidueRange>),
    /// One of these residue names, in upper case.
    ResidueNames(BTreeSet<String>),
    /// One of these atom names, in upper case.
    AtomNames(BTreeSet<String>),
    /// One of these atomic numbers.
    Elements(BTreeSet<u8>),
    /// At most this far from an atom that matches the condition.
    Within(Distance, Box<Self>),
    /// In a residue with an atom that matches the condition.
    ByResidue(Box<Self>),
    /// Does not match the condition.
    Not(Box<Self>),
    /// Matches all conditions.
    And(BTreeSet<Self>),
    /// Matches at least one condition.
    Or(BTreeSet<Self>),
}

/// Range of residue numbers with insertion codes, inclusive. Code 0 is none, and 255 is after all others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct ResidueRange {
    pub(super) first: (i32, u8),
    pub(super) last: (i32, u8),
}

/// Code at the end of a range that contains all insertion codes.
pub(super) const ANY_CODE: u8 = u8::MAX;

/// Distance in steps of 0.001 Å.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Distance(pub(super) u32);

impl Distance {
    /// Returns the distance in Å.
    pub(super) fn angstrom(self) -> f64 {
        f64::from(self.0) / 1000.0
    }
}

impl Condition {
    /// Returns the condition that an atom matches at least one of `all`.
    pub(super) fn or(all: impl IntoIterator<Item = Self>) -> Self {
        let mut parts = BTreeSet::new();
        for condition in all {
            match condition {
                Self::Or(others) => others.into_iter().for_each(|other| unite(&mut parts, other)),
                condition => unite(&mut parts, condition),
            }
        }
        single(parts).unwrap_or_else(Self::Or)
    }

    /// Returns the condition that an atom matches all of `all`.
    pub(super) fn and(all: impl IntoIterator<Item = Self>) -> Self {
        let (mut parts, mut kinds) = (BTreeSet::new(), None);
        let mut add = |condition| match condition {
            Self::Kinds(set) => kinds = Some(kinds.map_or(set, |known: KindSet| known.and(set))),
            condition => _ = parts.insert(condition),
        };
        for condition in all {
            match condition {
                Self::And(others) => others.into_iter().for_each(&mut add),
                condition => add(condition),
            }
        }
        parts.extend(kinds.map(Self::Kinds));
        single(parts).unwrap_or_else(Self::And)
    }

    /// Returns the opposite condition.
    pub(super) fn negated(self) -> Self {
        match self {
            Self::Not(condition) => *condition,
            Self::Kinds(set) => Self::Kinds(set.complement()),
            condition => Self::Not(Box::new(condition)),
        }
    }

    /// Returns the condition for hydrogen and deuterium.
    pub(super) fn hydrogen() -> Self {
        Self::Elements(BTreeSet::from([1]))
    }

    /// Returns the operands.
    pub(super) fn parts(&self) -> Vec<&Self> {
        match self {
            Self::Within(_, part) | Self::ByResidue(part) | Self::Not(part) => vec![&**part],
            Self::And(parts) | Self::Or(parts) => parts.iter().collect(),
            _ => Vec::new(),
        }
    }

    fn has_within(&self) -> bool {
        matches!(self, Self::Within(..)) || self.parts().into_iter().any(Self::has_within)
    }

    /// Returns true if the result for an atom depends on other atoms.
    pub(super) fn depends_on_others(&self) -> bool {
        matches!(self, Self::Within(..) | Self::ByResidue(_)) || self.parts().into_iter().any(Self::depends_on_others)
    }

    /// Adds all chain names in the condition to `names`.
    pub(super) fn chains<'a>(&'a self, names: &mut Vec<&'a str>) {
        if let Self::Chains(own) = self {
            names.extend(own.iter().map(String::as_str));
        }
        self.parts().into_iter().for_each(|part| part.chains(names));
    }
}

/// Adds an operand of `or`. Merges it with an operand of the same variant, if that has values.
fn unite(parts: &mut BTreeSet<Condition>, condition: Condition) {
    use Condition::{AtomNames, Chains, Elements, Kinds, ResidueNames, Residues};
    let same = |part: &&Condition| std::mem::discriminant(*part) == std::mem::discriminant(&condition);
    let Some(known) = parts.iter().find(same).cloned() else {
        parts.insert(condition);
        return;
    };
    let joined = match (known.clone(), condition) {
        (Kinds(a), Kinds(b)) => Kinds(a.or(b)),
        (Chains(a), Chains(b)) => Chains(&a | &b),
        (Residues(a), Residues(b)) => Residues(&a | &b),
        (ResidueNames(a), ResidueNames(b)) => ResidueNames(&a | &b),
        (AtomNames(a), AtomNames(b)) => AtomNames(&a | &b),
        (Elements(a), Elements(b)) => Elements(&a | &b),
        (_, other) => {
            parts.insert(other);
            return;
        }
    };
    parts.remove(&known);
    parts.insert(joined);
}

/// Returns the only element of a set, or the set as an error.
fn single(mut parts: BTreeSet<Condition>) -> Result<Condition, BTreeSet<Condition>> {
    if parts.len() == 1 { parts.pop_first().ok_or(parts) } else { Err(parts) }
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Kinds(set) => f.write_str(&kinds(*set)),
            Self::Chains(names) => write!(f, "chain {}", values(names)),
            Self::Residues(ranges) => {
                let ranges: Vec<String> = ranges.iter().map(ResidueRange::to_string).collect();
                write!(f, "resi {}", ranges.join(","))
            }
            Self::ResidueNames(names) => write!(f, "resn {}", values(names)),
            Self::AtomNames(names) => write!(f, "name {}", values(names)),
            Self::Elements(numbers) => {
                let symbols: Vec<&str> = numbers.iter().map(|&number| symbol(number)).collect();
                write!(f, "elem {}", symbols.join(","))
            }
            Self::Within(distance, of) => write!(f, "within {} of ({of})", distance.angstrom()),
            Self::ByResidue(of) => write!(f, "byres ({of})"),
            Self::Not(of) => write!(f, "not ({of})"),
            Self::And(parts) => f.write_str(&joined(parts, " and ")),
            Self::Or(parts) => f.write_str(&joined(parts, " or ")),
        }
    }
}

fn joined(parts: &BTreeSet<Condition>, word: &str) -> String {
    parts.iter().map(|part| format!("({part})")).collect::<Vec<_>>().join(word)
}

/// Writes a set of kinds as a union of names.
fn kinds(set: KindSet) -> String {
    let mut names: Vec<String> = Vec::new();
    for (group, members) in [
        (KindSet::POLYMER, ["protein", "nucleic"].as_slice()),
        (KindSet::LIGAND, &["cofactor", "glycan"]),
        (KindSet::POLYMER.or(KindSet::LIGAND).complement(), &["ion", "water"]),
    ] {
        let of = |wanted: bool| {
            members
                .iter()
                .filter(move |name| KindSet::named(name).is_some_and(|kind| (set.and(kind) == kind) == wanted))
        };
        let known = members.iter().filter_map(|name| KindSet::named(name)).fold(KindSet::default(), KindSet::or);
        let others = group.and(known.complement());
        let name = KindSet::NAMED.into_iter().find(|(_, named)| *named == group).map(|(name, _)| name);
        match name {
            // The group contains a kind without a name of its own.
            Some(name) if set.and(others) == others => {
                let without: Vec<String> = of(false).map(|member| format!(" and not {member}")).collect();
                names.push(if without.is_empty() { name.to_owned() } else { format!("({name}{})", without.concat()) });
            }
            _ => names.extend(of(true).map(|member| (*member).to_owned())),
        }
    }
    if names.is_empty() { "(water and not water)".to_owned() } else { names.join(" or ") }
}

impl fmt::Display for ResidueRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let code = |code: u8| if code == 0 || code == ANY_CODE { String::new() } else { char::from(code).to_string() };
        let Self { first, last } = self;
        write!(f, "{}{}", first.0, code(first.1))?;
        if first == last { Ok(()) } else { write!(f, "-{}{}", last.0, code(last.1)) }
    }
}

fn values(names: &BTreeSet<String>) -> String {
    let quoted = names.iter().map(|name| {
        let plain = |c: char| c.is_alphanumeric() || matches!(c, '_' | '\'' | '*');
        if !name.is_empty() && name.chars().all(plain) && !parse::is_keyword(name) {
            name.clone()
        } else {
            format!("\"{}\"", name.replace('"', "\"\""))
        }
    });
    quoted.collect::<Vec<_>>().join(",")
}
