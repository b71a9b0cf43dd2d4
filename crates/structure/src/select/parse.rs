//! Parser of selection expressions. Errors name the character and the expected content.

use std::collections::BTreeSet;

use thiserror::Error;

use super::expression::{ANY_CODE, Condition, Distance, Expression, ResidueRange};
use crate::KindSet;
use crate::element::atomic_number;

/// Maximum nesting depth of parentheses, `not`, `byres` and `within`.
pub const MAX_DEPTH: usize = 16;
/// Maximum number of `within` in an expression.
pub const MAX_WITHIN: usize = 8;
/// Maximum distance of `within`, Å.
pub const MAX_DISTANCE: u32 = 50;

/// Syntax error of an expression.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("character {column}: found {found}, expected {expected}")]
pub struct BadExpression {
    /// Position of the error in characters, from 1.
    pub column: usize,
    /// Content found there, at most 40 characters.
    pub found: String,
    /// Expected content.
    pub expected: String,
}

/// Keywords that begin a list of values, with their synonyms.
const PROPERTIES: [(&str, Property); 8] = [
    ("chain", Property::Chain),
    ("resi", Property::Residue),
    ("resid", Property::Residue),
    ("resn", Property::ResidueName),
    ("resname", Property::ResidueName),
    ("name", Property::AtomName),
    ("elem", Property::Element),
    ("element", Property::Element),
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Property {
    Chain,
    Residue,
    ResidueName,
    AtomName,
    Element,
}

impl Property {
    /// Returns the description of a valid value.
    const fn expected(self) -> &'static str {
        match self {
            Self::Chain => "the name of a chain",
            Self::Residue => "a residue number such as 52 or 52A, or a range such as 10-20",
            Self::ResidueName => "the name of a residue",
            Self::AtomName => "the name of an atom",
            Self::Element => "the symbol of an element",
        }
    }
}

/// Synonyms of the condition for hydrogens.
const HYDROGEN: [&str; 2] = ["hydrogen", "hydrogens"];
const OTHER_KEYWORDS: [&str; 7] = ["all", "and", "or", "not", "within", "of", "byres"];

/// Returns true if a value of this text must be in quotes.
pub(super) fn is_keyword(word: &str) -> bool {
    KindSet::named(word).is_some()
        || HYDROGEN.contains(&word)
        || OTHER_KEYWORDS.contains(&word)
        || PROPERTIES.iter().any(|(name, _)| *name == word)
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum ExpressionToken {
    Open,
    Close,
    Comma,
    /// Keyword, or value without quotes.
    Word(String),
    /// Value in quotes.
    Quoted(String),
    End,
}

impl ExpressionToken {
    fn found(&self) -> String {
        match self {
            Self::Open => "`(`".to_owned(),
            Self::Close => "`)`".to_owned(),
            Self::Comma => "`,`".to_owned(),
            Self::Word(text) | Self::Quoted(text) => format!("`{}`", text.chars().take(40).collect::<String>()),
            Self::End => "the end".to_owned(),
        }
    }
}

/// Splits a text into tokens with their positions, from 0.
fn tokens(text: &str) -> Result<Vec<(usize, ExpressionToken)>, BadExpression> {
    let mut tokens = Vec::new();
    let mut rest = text.chars().enumerate().peekable();
    let fault =
        |at: usize, found: String, expected: &str| BadExpression { column: at + 1, found, expected: expected.into() };
    while let Some((at, c)) = rest.next() {
        let token = match c {
            c if c.is_whitespace() => continue,
            c if c.is_control() => return Err(fault(at, format!("`{}`", c.escape_default()), "no control characters")),
            '(' => ExpressionToken::Open,
            ')' => ExpressionToken::Close,
            ',' => ExpressionToken::Comma,
            '"' => {
                let mut value = String::new();
                loop {
                    match rest.next() {
                        Some((_, '"')) if rest.next_if(|(_, c)| *c == '"').is_some() => value.push('"'),
                        Some((_, '"')) => break,
                        Some((at, c)) if c.is_control() => {
                            return Err(fault(at, format!("`{}`", c.escape_default()), "no control characters"));
                        }
                        Some((_, c)) => value.push(c),
                        None => return Err(fault(text.chars().count(), "the end".to_owned(), "a closing `\"`")),
                    }
                }
                ExpressionToken::Quoted(value)
            }
            c => {
                let mut word = String::from(c);
                let of_word = |c: char| !(c.is_whitespace() || c.is_control() || matches!(c, '(' | ')' | ',' | '"'));
                while let Some((_, c)) = rest.next_if(|(_, c)| of_word(*c)) {
                    word.push(c);
                }
                ExpressionToken::Word(word)
            }
        };
        tokens.push((at, token));
    }
    tokens.push((text.chars().count(), ExpressionToken::End));
    Ok(tokens)
}

/// Parses an expression.
pub(super) fn expression(text: &str) -> Result<Expression, BadExpression> {
    let tokens = tokens(text)?;
    let mut parser = Parser { tokens: &tokens, next: 0, depth: 0, n_within: 0, hydrogens: false };
    let (mut items, mut with_hydrogens) = (Vec::new(), false);
    loop {
        let lone =
            matches!(parser.tokens.get(parser.next + 1), Some((_, ExpressionToken::Comma | ExpressionToken::End)));
        if lone && HYDROGEN.iter().any(|word| parser.is_at(word)) {
            parser.next += 1;
            with_hydrogens = true;
        } else {
            items.push(parser.or()?);
        }
        match parser.token() {
            ExpressionToken::Comma => parser.next += 1,
            ExpressionToken::End => break,
            _ => return Err(parser.fault("`and`, `or`, `,` or the end")),
        }
    }
    let hydrogens = parser.hydrogens || with_hydrogens;
    // `hydrogens` without other items selects all hydrogens.
    let condition = if items.is_empty() { Condition::hydrogen() } else { Condition::or(items) };
    Ok(Expression { condition, hydrogens })
}

struct Parser<'a> {
    tokens: &'a [(usize, ExpressionToken)],
    next: usize,
    depth: usize,
    n_within: usize,
    hydrogens: bool,
}

impl Parser<'_> {
    fn token(&self) -> &ExpressionToken {
        self.tokens.get(self.next).map_or(&ExpressionToken::End, |(_, token)| token)
    }

    fn fault(&self, expected: impl Into<String>) -> BadExpression {
        let column = self.tokens.get(self.next).map_or(0, |(at, _)| *at) + 1;
        BadExpression { column, found: self.token().found(), expected: expected.into() }
    }

    fn is_at(&self, word: &str) -> bool {
        matches!(self.token(), ExpressionToken::Word(text) if text == word)
    }

    /// Skips a keyword. Returns false if it is not there.
    fn take(&mut self, word: &str) -> bool {
        let is_there = self.is_at(word);
        self.next += usize::from(is_there);
        is_there
    }

    fn or(&mut self) -> Result<Condition, BadExpression> {
        let mut parts = vec![self.and()?];
        while self.take("or") {
            parts.push(self.and()?);
        }
        Ok(Condition::or(parts))
    }

    fn and(&mut self) -> Result<Condition, BadExpression> {
        let mut parts = vec![self.operand()?];
        // `A within 5 of B` means `A and within 5 of B`.
        while self.take("and") || self.is_at("within") {
            parts.push(self.operand()?);
        }
        Ok(Condition::and(parts))
    }

    /// Parses the operand of `not`, `byres`, `within` or parentheses, and limits the depth.
    fn nested(&mut self, parse: fn(&mut Self) -> Result<Condition, BadExpression>) -> Result<Condition, BadExpression> {
        if self.depth == MAX_DEPTH {
            return Err(self.fault(format!("at most {MAX_DEPTH} levels of parentheses, `not`, `byres` and `within`")));
        }
        self.depth += 1;
        let condition = parse(self)?;
        self.depth -= 1;
        Ok(condition)
    }

    fn operand(&mut self) -> Result<Condition, BadExpression> {
        if self.take("not") {
            return Ok(self.nested(Self::operand)?.negated());
        }
        if self.take("byres") {
            return Ok(Condition::ByResidue(Box::new(self.nested(Self::operand)?)));
        }
        if self.is_at("within") {
            if self.n_within == MAX_WITHIN {
                return Err(self.fault(format!("at most {MAX_WITHIN} times `within`")));
            }
            (self.n_within, self.next) = (self.n_within + 1, self.next + 1);
            let distance = self.distance()?;
            if !self.take("of") {
                return Err(self.fault("`of`"));
            }
            return Ok(Condition::Within(distance, Box::new(self.nested(Self::operand)?)));
        }
        if *self.token() == ExpressionToken::Open {
            self.next += 1;
            let condition = self.nested(Self::or)?;
            if *self.token() != ExpressionToken::Close {
                return Err(self.fault("`and`, `or` or `)`"));
            }
            self.next += 1;
            return Ok(condition);
        }
        self.condition()
    }

    /// Parses a distance with at most three decimals.
    fn distance(&mut self) -> Result<Distance, BadExpression> {
        let expected = format!("a distance above 0 and up to {MAX_DISTANCE} Å with at most three decimals");
        let ExpressionToken::Word(text) = self.token() else { return Err(self.fault(expected)) };
        let (whole, decimals) = text.split_once('.').unwrap_or((text, ""));
        let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
        let valid = digits(whole) && digits(decimals) && whole.len() <= 4 && decimals.len() <= 3;
        let steps = valid.then(|| format!("{whole}{decimals:0<3}").parse::<u32>().ok()).flatten();
        match steps.filter(|steps| (1..=1000 * MAX_DISTANCE).contains(steps)) {
            Some(steps) => {
                self.next += 1;
                Ok(Distance(steps))
            }
            None => Err(self.fault(expected)),
        }
    }

    /// Parses a kind or a property with its values.
    fn condition(&mut self) -> Result<Condition, BadExpression> {
        let names = KindSet::NAMED.map(|(name, _)| name).join(", ");
        let expected = format!(
            "a kind ({names}, hydrogen, all), `chain`, `resi`, `resn`, `name`, `elem`, `within`, `byres`, `not` or `(`"
        );
        let ExpressionToken::Word(word) = self.token() else { return Err(self.fault(expected)) };
        let condition = if let Some(set) = KindSet::named(word) {
            Condition::Kinds(set)
        } else if word == "all" {
            self.hydrogens = true;
            Condition::Kinds(KindSet::ALL)
        } else if HYDROGEN.contains(&word.as_str()) {
            self.hydrogens = true;
            Condition::hydrogen()
        } else if let Some((_, property)) = PROPERTIES.iter().find(|(name, _)| name == word) {
            self.next += 1;
            return self.values(*property);
        } else {
            return Err(self.fault(expected));
        };
        self.next += 1;
        Ok(condition)
    }

    /// Parses values, separated by commas, blanks or `+`.
    fn values(&mut self, property: Property) -> Result<Condition, BadExpression> {
        let mut values = Vec::new();
        loop {
            let keyword = match self.token() {
                ExpressionToken::Quoted(value) => {
                    values.push((self.next, value.clone()));
                    None
                }
                ExpressionToken::Word(word) if is_keyword(word) => {
                    Some(format!("; `{word}` is a keyword, write it in quotes"))
                }
                ExpressionToken::Word(word) => {
                    let parts: Vec<&str> = word.split('+').collect();
                    let whole = parts.iter().any(|part| part.is_empty());
                    let parts = if whole { vec![word.as_str()] } else { parts };
                    values.extend(parts.into_iter().map(|part| (self.next, part.to_owned())));
                    None
                }
                _ => Some(String::new()),
            };
            if let Some(why) = keyword {
                return Err(self.fault(format!("{}{why}", property.expected())));
            }
            self.next += 1;
            let is_value = |token: Option<&(usize, ExpressionToken)>| match token {
                Some((_, ExpressionToken::Quoted(_))) => true,
                Some((_, ExpressionToken::Word(word))) => !is_keyword(word),
                _ => false,
            };
            if *self.token() == ExpressionToken::Comma && is_value(self.tokens.get(self.next + 1)) {
                self.next += 1;
            } else if !is_value(self.tokens.get(self.next)) {
                break;
            }
        }
        self.property(property, &values)
    }

    fn property(&mut self, property: Property, values: &[(usize, String)]) -> Result<Condition, BadExpression> {
        let upper = |value: &str| (!value.is_empty()).then(|| value.to_ascii_uppercase());
        Ok(match property {
            Property::Chain => Condition::Chains(self.each(property, values, |value| Some(value.to_owned()))?),
            Property::Residue => Condition::Residues(self.each(property, values, range)?),
            Property::ResidueName => Condition::ResidueNames(self.each(property, values, upper)?),
            Property::AtomName => Condition::AtomNames(self.each(property, values, upper)?),
            Property::Element => {
                let number = |value: &str| {
                    let letters = value.bytes().all(|b| b.is_ascii_alphabetic());
                    letters.then(|| atomic_number(value.as_bytes())).filter(|&number| number != 0)
                };
                let numbers = self.each(property, values, number)?;
                self.hydrogens |= numbers.contains(&1);
                Condition::Elements(numbers)
            }
        })
    }

    /// Parses all values. An error has the position of the invalid value.
    fn each<T: Ord>(
        &mut self,
        property: Property,
        values: &[(usize, String)],
        parse: impl Fn(&str) -> Option<T>,
    ) -> Result<BTreeSet<T>, BadExpression> {
        let mut parsed = BTreeSet::new();
        for (at, value) in values {
            let Some(value) = parse(value) else {
                self.next = *at;
                return Err(self.fault(property.expected()));
            };
            parsed.insert(value);
        }
        Ok(parsed)
    }
}

/// Parses a residue number with an insertion code, or a range of them.
fn range(text: &str) -> Option<ResidueRange> {
    let (first, rest) = residue(text)?;
    if rest.is_empty() {
        return Some(ResidueRange { first, last: first });
    }
    let (last, rest) = residue(rest.strip_prefix('-')?)?;
    // `10-20` includes all insertion codes of 20.
    let last = if last.1 == 0 { (last.0, ANY_CODE) } else { last };
    (rest.is_empty() && first <= last).then_some(ResidueRange { first, last })
}

/// Parses a residue number and an insertion code at the beginning of a text. Returns the rest as well.
fn residue(text: &str) -> Option<((i32, u8), &str)> {
    let digits = text.bytes().skip(1).take_while(u8::is_ascii_digit).count() + 1;
    let (number, rest) = text.split_at_checked(digits)?;
    let number = number.parse().ok().filter(|_| !number.starts_with('+'))?;
    match rest.as_bytes() {
        [code, ..] if code.is_ascii_alphabetic() => Some(((number, *code), &rest[1..])),
        _ => Some(((number, 0), rest)),
    }
}
