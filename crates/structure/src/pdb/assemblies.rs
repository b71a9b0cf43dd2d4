//! Assemblies in REMARK 350 records.
//!
//! `BIOMOLECULE` begins an assembly, or several that are described together. `APPLY THE FOLLOWING TO CHAINS` begins a
//! rule, `AND CHAINS` continues its list of chains. Three `BIOMT` records define an operator of the rule.

use molmesh_surface::MemoryMeter as _;

use super::super::assembly::{Assemblies, Operator};
use super::super::error::StructureError;
use super::super::number;
use super::super::read::Reading;
use super::super::text::decode;

/// Memory of an operator while records are read, bytes: its entry and the rules that contain it.
const BYTES_PER_OPERATOR: u64 = 256;

/// Id of an assembly without a `BIOMOLECULE` record.
const FIRST: &str = "1";

/// State of reading REMARK 350 records in order.
#[derive(Debug, Default)]
pub(super) struct Remark350 {
    assemblies: Assemblies,
    /// Ids of the current assemblies, separated by commas or blanks.
    ids: Option<String>,
    /// Chains of the current rule.
    chains: Option<String>,
    /// Number of operators before the current rule.
    first: usize,
    /// First rows of the current operator.
    rows: Vec<[Option<f64>; 4]>,
}

impl Remark350 {
    /// Reads a record.
    ///
    /// # Errors
    /// Returns the errors of memory.
    pub(super) fn line(&mut self, line: &[u8], reading: &Reading<'_>) -> Result<(), StructureError> {
        let text = decode(&line[..line.len().min(80)]);
        let text = text.get("REMARK 350".len()..).unwrap_or_default().trim();
        if let Some(ids) = text.strip_prefix("BIOMOLECULE:") {
            self.end_rule(reading)?;
            self.ids = Some(ids.to_owned());
        } else if let Some(chains) = text.strip_prefix("AND CHAINS:")
            && let Some(before) = &mut self.chains
        {
            reading.text.grow(text.len() as u64)?;
            before.push(',');
            before.push_str(chains);
        } else if let Some((_, chains)) = text.split_once("APPLY THE FOLLOWING TO CHAINS:") {
            self.end_rule(reading)?;
            self.chains = Some(chains.to_owned());
        } else if let Some(row) = text.strip_prefix("BIOMT") {
            self.operator_row(row, reading)?;
        }
        Ok(())
    }

    /// Reads a row of an operator: `1   2  0.5 0.0 0.0  0.0`. Ignores the number of the operator, because files number
    /// the operators of each assembly from 1.
    fn operator_row(&mut self, text: &str, reading: &Reading<'_>) -> Result<(), StructureError> {
        let (number, rest) = text.split_at_checked(1).unwrap_or_default();
        match number {
            "1" => self.end_operator(reading)?,
            "2" | "3" => {}
            _ => return Ok(()),
        }
        let mut words = rest.split_ascii_whitespace().skip(1);
        self.rows.push([(); 4].map(|()| words.next().and_then(|word| number::real(word.as_bytes(), 0, word.len()))));
        if number == "3" { self.end_operator(reading) } else { Ok(()) }
    }

    /// Adds the current operator, if it has rows. It is invalid unless it has three.
    fn end_operator(&mut self, reading: &Reading<'_>) -> Result<(), StructureError> {
        let rows = std::mem::take(&mut self.rows);
        if rows.is_empty() {
            return Ok(());
        }
        reading.text.grow(BYTES_PER_OPERATOR)?;
        let operator = <[_; 3]>::try_from(rows).ok().and_then(Operator::of);
        self.assemblies.add_operator((self.assemblies.n_operators() + 1).to_string(), operator);
        Ok(())
    }

    /// Adds the current rule to its assemblies, if it has operators.
    fn end_rule(&mut self, reading: &Reading<'_>) -> Result<(), StructureError> {
        self.end_operator(reading)?;
        let last = self.assemblies.n_operators();
        let first = std::mem::replace(&mut self.first, last) + 1;
        let Some(chains) = self.chains.take().filter(|_| first <= last) else { return Ok(()) };
        let ids = self.ids.as_deref().unwrap_or(FIRST);
        for id in ids.split(|c: char| c == ',' || c.is_whitespace()).filter(|id| !id.is_empty()) {
            reading.text.grow(BYTES_PER_OPERATOR + chains.len() as u64)?;
            self.assemblies.add_generator(id.to_owned(), format!("{first}-{last}"), chains.clone());
        }
        Ok(())
    }

    /// Returns the assemblies.
    pub(super) fn finish(mut self, reading: &Reading<'_>) -> Result<Assemblies, StructureError> {
        self.end_rule(reading)?;
        Ok(self.assemblies)
    }
}
