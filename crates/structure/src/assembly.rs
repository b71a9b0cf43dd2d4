//! Biological assemblies: copies of chains by operators, as a structure file describes them.
//!
//! Dictionary: PDBx/mmCIF, categories `pdbx_struct_assembly_gen` and `pdbx_struct_oper_list`; wwPDB format 3.3,
//! REMARK 350. The tables are stored as in the file; operator expressions are expanded for the selected assembly only.

use std::collections::{HashMap, HashSet};

use indexmap::IndexMap;

/// Maximum number of groups in an expression. Entries of the PDB have at most three.
const MAX_GROUPS: usize = 8;
/// Maximum deviation of a matrix times its transpose from the identity. Files have six digits.
const MAX_SKEW: f64 = 0.01;

/// Maximum deviation of the elements of a matrix from those of a rotation, for instances. It moves an atom that is
/// 1,000 Å from the origin by about 0.1 Å.
const MAX_DEVIATION: f64 = 1e-4;

/// Rotation or reflection, then a translation in Å: rows of a matrix with the translation in the last column.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Operator(pub [[f64; 4]; 3]);

impl Operator {
    /// Operator that leaves every position unchanged.
    pub const IDENTITY: Self = Self([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);

    /// Returns the operator with these rows; `None` if a number is missing or the operator would change lengths.
    pub(super) fn of(rows: [[Option<f64>; 4]; 3]) -> Option<Self> {
        let mut out = Self::IDENTITY;
        for (out, row) in out.0.as_flattened_mut().iter_mut().zip(rows.as_flattened()) {
            *out = (*row).filter(|v| v.is_finite())?;
        }
        let dot = |a: &[f64; 4], b: &[f64; 4]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let keeps_lengths =
            (0..3).all(|i| (0..3).all(|j| (dot(&out.0[i], &out.0[j]) - f64::from(u8::from(i == j))).abs() <= MAX_SKEW));
        keeps_lengths.then_some(out)
    }

    /// Returns the image of a position, Å.
    #[must_use]
    #[inline]
    pub fn apply(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        self.0.map(|[a, b, c, t]| a * x + b * y + c * z + t)
    }

    /// Returns the rotation as a unit quaternion (x, y, z, w); `None` if the matrix is not that of a rotation.
    #[must_use]
    pub fn rotation(&self) -> Option<[f64; 4]> {
        let [[a, b, c, _], [d, e, f, _], [g, h, i, _]] = self.0;
        // Four times each component times x, y, z or w. The row with the largest diagonal is the most precise.
        let products = [
            [1.0 + a - e - i, b + d, c + g, h - f],
            [b + d, 1.0 - a + e - i, f + h, c - g],
            [c + g, f + h, 1.0 - a - e + i, d - b],
            [h - f, c - g, d - b, 1.0 + a + e + i],
        ];
        let largest = (0..4).max_by(|&j, &k| products[j][j].total_cmp(&products[k][k]))?;
        let row = products[largest];
        let length = row.iter().map(|v| v * v).sum::<f64>().sqrt();
        let [x, y, z, w] = row.map(|v| v / length);
        let rotated = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let own = self.0.iter().flat_map(|row| &row[..3]);
        let is_rotation = own.zip(rotated.as_flattened()).all(|(own, rotated)| (own - rotated).abs() <= MAX_DEVIATION);
        is_rotation.then_some([x, y, z, w])
    }

    /// Returns the operator that applies `first`, then this one.
    #[must_use]
    pub fn after(&self, first: &Self) -> Self {
        let column = |k: usize| first.0.map(|row| row[k]);
        let axes = [0, 1, 2].map(column);
        let origin = self.apply(column(3));
        Self([0, 1, 2].map(|i| {
            let [a, b, c, _] = self.0[i];
            let [x, y, z] = axes.map(|v| a * v[0] + b * v[1] + c * v[2]);
            [x, y, z, origin[i]]
        }))
    }
}

/// Rule of an assembly: chains, and the operators that copy them. Texts are those of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Generator {
    /// Id of the assembly.
    pub(super) assembly: String,
    /// Operator expression, such as `1,2,5-9` or `(X0)(1-60)`.
    pub(super) expression: String,
    /// Names of the chains, separated by commas or white space.
    chains: String,
}

impl Generator {
    /// Returns the names of the chains, which may repeat. `NULL` is the blank chain of a PDB file.
    pub(super) fn chains(&self) -> impl Iterator<Item = &str> {
        let names = self.chains.split(|c: char| c == ',' || c.is_whitespace()).filter(|name| !name.is_empty());
        names.map(|name| if name == "NULL" { "" } else { name })
    }

    /// Returns the ids of the chains in order, each once. `ids` are those of each name.
    pub(super) fn chain_ids(&self, ids: &HashMap<&str, Vec<u32>>) -> Vec<u32> {
        // A file may repeat a name any number of times.
        let mut seen = HashSet::new();
        let known = self.chains().filter_map(|name| ids.get_key_value(name));
        let known = known.filter(|(name, _)| seen.insert(**name));
        let mut chains: Vec<u32> = known.flat_map(|(_, ids)| ids).copied().collect();
        chains.sort_unstable();
        chains
    }
}

/// Error of an operator expression or an operator.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct BadExpression {
    pub(super) found: String,
    pub(super) expected: String,
}

impl BadExpression {
    fn new(found: &str, expected: impl Into<String>) -> Self {
        let shown: String = found.chars().take(40).collect();
        Self { found: format!("`{shown}`"), expected: expected.into() }
    }
}

/// Assemblies of a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Assemblies {
    generators: Vec<Generator>,
    /// Operators by id; `None` for those that cannot be used.
    operators: HashMap<String, Option<Operator>>,
}

impl Assemblies {
    pub(super) fn add_generator(&mut self, assembly: String, expression: String, chains: String) {
        self.generators.push(Generator { assembly, expression, chains });
    }

    /// Adds an operator, unless one has the same id.
    pub(super) fn add_operator(&mut self, id: String, operator: Option<Operator>) {
        self.operators.entry(id).or_insert(operator);
    }

    /// Returns the number of operators.
    pub(super) fn n_operators(&self) -> usize {
        self.operators.len()
    }

    /// Returns the memory of the tables, bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let texts = |g: &Generator| g.assembly.len() + g.expression.len() + g.chains.len() + size_of::<Generator>();
        let generators: usize = self.generators.iter().map(texts).sum();
        // Hash tables are at most seven eighths full and double in size.
        let entry = 2 * size_of::<(String, Option<Operator>)>();
        let operators: usize = self.operators.keys().map(|id| id.len() + entry).sum();
        (generators + operators) as u64
    }

    /// Returns the rules of an assembly.
    pub(super) fn generators(&self, assembly: &str) -> impl Iterator<Item = &Generator> {
        self.generators.iter().filter(move |generator| generator.assembly == assembly)
    }

    /// Returns the ids of the assemblies in file order, with their numbers of copies. The number is `None` if an
    /// expression cannot be read, or exceeds `limit`.
    #[must_use]
    pub fn list(&self, limit: u64) -> Vec<(&str, Option<u64>)> {
        let mut all: IndexMap<&str, Option<u64>> = IndexMap::new();
        for generator in &self.generators {
            let copies = all.entry(&generator.assembly).or_insert(Some(0));
            let more = self.count(&generator.expression, limit).ok();
            *copies = copies.and_then(|n| n.checked_add(more?)).filter(|n| *n <= limit);
        }
        all.into_iter().collect()
    }

    /// Returns the number of operators in an expression without expanding it. A number above `limit` is a lower bound.
    pub(super) fn count(&self, expression: &str, limit: u64) -> Result<u64, BadExpression> {
        groups(expression)?.into_iter().try_fold(1_u64, |product, group| {
            let mut n = 0_u64;
            for item in items(group) {
                let known = self.operators.contains_key(item);
                n = n.saturating_add(range(item).filter(|_| !known).map_or(1, |(a, b)| (b - a).saturating_add(1)));
                if n > limit {
                    break;
                }
            }
            Ok(product.saturating_mul(n))
        })
    }

    /// Returns the operators of an expression. The caller has checked their number with [`Self::count`].
    pub(super) fn expand(&self, expression: &str) -> Result<Vec<Operator>, BadExpression> {
        let mut all = vec![Operator::IDENTITY];
        for group in groups(expression)? {
            let mut of_group = Vec::new();
            for item in items(group) {
                match range(item).filter(|_| !self.operators.contains_key(item)) {
                    None => of_group.push(self.operator(item)?),
                    Some((a, b)) => {
                        for number in a..=b {
                            of_group.push(self.operator(itoa::Buffer::new().format(number))?);
                        }
                    }
                }
            }
            // The operators of later groups are applied first.
            all = all.iter().flat_map(|left| of_group.iter().map(|right| left.after(right))).collect();
        }
        Ok(all)
    }

    fn operator(&self, id: &str) -> Result<Operator, BadExpression> {
        match self.operators.get(id) {
            Some(Some(operator)) => Ok(*operator),
            Some(None) => Err(BadExpression::new(
                id,
                "an operator with twelve numbers: a rotation or reflection, and a translation in Å",
            )),
            None => Err(BadExpression::new(id, "the id of an operator of the file")),
        }
    }
}

/// Splits an expression into its parenthesized groups. An expression without parentheses is one group.
fn groups(expression: &str) -> Result<Vec<&str>, BadExpression> {
    let bad = |found| BadExpression::new(found, "groups of operators such as `1,2,5-9` or `(X0)(1-60)`");
    let (mut groups, mut rest) = (Vec::new(), expression.trim());
    while !rest.is_empty() || groups.is_empty() {
        let (group, others) = match rest.strip_prefix('(') {
            Some(inner) => inner.split_once(')').ok_or_else(|| bad(rest))?,
            None => rest.split_at(rest.find('(').unwrap_or(rest.len())),
        };
        if group.contains(['(', ')']) || items(group).any(str::is_empty) {
            return Err(bad(rest));
        }
        if groups.len() == MAX_GROUPS {
            return Err(BadExpression::new(rest, format!("at most {MAX_GROUPS} groups")));
        }
        groups.push(group);
        rest = others.trim_start();
    }
    Ok(groups)
}

fn items(group: &str) -> impl Iterator<Item = &str> {
    group.split(',').map(str::trim)
}

/// Parses a range such as `1-60`.
fn range(item: &str) -> Option<(u64, u64)> {
    let (a, b) = item.split_once('-')?;
    let number = |text: &str| text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse().ok()).flatten();
    Some((number(a)?, number(b)?)).filter(|(a, b)| a <= b)
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    fn shift(x: f64) -> Option<Operator> {
        Some(Operator([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]))
    }

    /// Returns operators 1 to 9, which translate by their number along x, `P`, which turns x to y, and `bad`.
    fn numbered() -> Assemblies {
        let mut all = Assemblies::default();
        for n in 1..10 {
            all.add_operator(n.to_string(), shift(f64::from(n)));
        }
        let turn = Operator([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
        all.add_operator("P".to_owned(), Some(turn));
        all.add_operator("1-bad".to_owned(), None);
        all
    }

    #[test]
    fn expressions_are_lists_ranges_and_products() {
        let all = numbered();
        let images = |expression: &str| {
            assert_eq!(all.count(expression, 100).unwrap(), all.expand(expression).unwrap().len() as u64);
            let moved = all.expand(expression).unwrap().into_iter().map(|operator| operator.apply([0.0, 0.0, 1.0]));
            moved.map(|[x, y, z]| format!("{x} {y} {z}")).collect::<Vec<_>>().join(", ")
        };
        assert_eq!(images("1"), "1 0 1");
        assert_eq!(images(" 1, 3,\n5-6 "), "1 0 1, 3 0 1, 5 0 1, 6 0 1");
        assert_eq!(images("(1-2)(8,9)"), "9 0 1, 10 0 1, 10 0 1, 11 0 1");
        // The group on the right is applied first.
        assert_eq!(images("(P)(2)"), "0 2 1");
        assert_eq!(images("(2)(P)"), "2 0 1");
        assert_eq!(images("P(3) (4)"), "0 7 1");
        for (bad, found) in [
            ("", "``"),
            ("1,", "`1,`"),
            ("(1", "`(1`"),
            ("1)", "`1)`"),
            ("((1))", "`((1))`"),
            ("12", "`12`"),
            ("8-10", "`10`"),
            ("9-1", "`9-1`"),
            ("1-bad", "`1-bad`"),
            ("(1)(1)(1)(1)(1)(1)(1)(1)(1)", "`(1)`"),
        ] {
            assert_eq!(all.expand(bad).unwrap_err().found, found, "{bad}");
        }
    }

    #[test]
    fn large_expressions_are_counted_without_expansion() {
        let all = numbered();
        for large in ["(1-1000000)(1-1000000)", "0-18446744073709551615", "(1-18446744073709551615)(1-9)"] {
            assert!(all.count(large, 1000).unwrap() > 1000, "{large}");
        }
        assert_eq!(all.count("(1-1000)(1-1000)", u64::MAX).unwrap(), 1_000_000);
        // Counting ends at the limit.
        assert_eq!(all.count("1,".repeat(1 << 20).trim_end_matches(','), 10).unwrap(), 11);
    }

    #[test]
    fn assemblies_are_listed_in_file_order_with_their_copies() {
        let mut all = numbered();
        for (id, expression) in [("2", "1-3"), ("PAU", "P"), ("2", "(1,2)(3,4)"), ("3", "1-99999"), ("4", "(")] {
            all.add_generator(id.to_owned(), expression.to_owned(), "A".to_owned());
        }
        assert_eq!(all.list(1000), [("2", Some(7)), ("PAU", Some(1)), ("3", None), ("4", None)]);
    }

    #[test]
    fn rotations_have_quaternions_and_reflections_none() {
        let of = |m: [[f64; 3]; 3]| Operator(m.map(|[a, b, c]| [a, b, c, 7.0])).rotation();
        assert_eq!(Operator::IDENTITY.rotation(), Some([0.0, 0.0, 0.0, 1.0]));
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let near = |found: Option<[f64; 4]>, expected: [f64; 4]| {
            found.is_some_and(|q| q.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9))
        };
        // Quarter turns about z and x, and half turns about each axis.
        assert!(near(of([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [0.0, 0.0, half, half]));
        assert!(near(of([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), [half, 0.0, 0.0, half]));
        assert!(near(of([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]), [1.0, 0.0, 0.0, 0.0]));
        assert!(near(of([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]), [0.0, 1.0, 0.0, 0.0]));
        assert!(near(of([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]), [0.0, 0.0, 1.0, 0.0]));
        // A cyclic exchange of the axes is a third of a turn.
        assert!(near(of([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [0.5, 0.5, 0.5, 0.5]));
        for reflection in [
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
            [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
            [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
            // Lengths change by half a percent.
            [[1.005, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        ] {
            assert_eq!(of(reflection), None, "{reflection:?}");
        }
    }

    #[test]
    fn operators_keep_lengths() {
        let rows = |v: f64| [[Some(v), Some(0.0), Some(0.0), Some(5.0)], [Some(0.0), Some(1.0), Some(0.0), Some(0.0)]];
        let of = |v: f64| {
            let [a, b] = rows(v);
            Operator::of([a, b, [Some(0.0), Some(0.0), Some(1.0), Some(0.0)]])
        };
        assert!(of(1.0).is_some() && of(-1.0).is_some() && of(0.999).is_some());
        assert!(of(1.1).is_none() && of(0.0).is_none() && of(f64::NAN).is_none() && of(f64::INFINITY).is_none());
        assert!(Operator::of([[Some(1.0), Some(0.0), Some(0.0), None]; 3]).is_none());
    }
}
