//! Decoders of encodings whose values do not correspond to single numbers of the data.

use std::fmt;

use super::encoding::Number;
use super::fault::Fault;

/// Number of runs that are decoded at a time.
const RUNS: usize = 256;

/// Place of an encoding, for messages.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) name: &'static str,
    pub(super) number: usize,
    pub(super) of: usize,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (encoding {} of {})", self.name, self.number, self.of)
    }
}

pub(super) fn within(n: usize, most: usize) -> Result<(), Box<Fault>> {
    if n > most { Err(Fault::new(format!("{n} values"), format!("at most {most}"))) } else { Ok(()) }
}

/// Checks a number of values against the declared one and the limit.
fn check_number(n: usize, size: Option<usize>, most: usize) -> Result<(), Box<Fault>> {
    match size {
        Some(size) if size != n => Err(Fault::new(format!("{n} values"), format!("{size}, as srcSize says"))),
        _ => within(n, most),
    }
}

pub(super) fn fits(value: i64) -> Result<i32, Box<Fault>> {
    i32::try_from(value).ok().ok_or_else(|| Fault::new(value.to_string(), "a whole number of 32 bits"))
}

/// Reader of the values before a step.
pub(super) type StepInput<'i> = dyn FnMut(&mut [i32]) -> Result<usize, Box<Fault>> + 'i;

/// Decoder of `IntegerPacking`: a value is a sum of numbers, all but the last of which are the limits of their type.
#[derive(Debug)]
pub(super) struct Unpack {
    limits: [i32; 2],
    size: Option<usize>,
    /// Number of values so far.
    n: usize,
    /// Sum of the numbers of a value whose last number is missing.
    open: Option<i64>,
}

impl Unpack {
    pub(super) fn new(number: Number, size: Option<usize>) -> Self {
        let limits = match number {
            Number::Int8 => [i8::MIN.into(), i8::MAX.into()],
            Number::Int16 => [i16::MIN.into(), i16::MAX.into()],
            // Unsigned types have no lower limit.
            Number::Uint8 => [-1, u8::MAX.into()],
            _ => [-1, u16::MAX.into()],
        };
        Self { limits, size, n: 0, open: None }
    }

    /// Decodes the next values, less than the length of `out` only at the end.
    pub(super) fn read(
        &mut self,
        out: &mut [i32],
        most: usize,
        place: Place,
        input: &mut StepInput<'_>,
    ) -> Result<usize, Box<Fault>> {
        let mut filled = 0;
        while filled < out.len() {
            let rest = &mut out[filled..];
            let found = input(rest)?;
            if found == 0 {
                if self.open.is_some() {
                    return Err(Fault::new("the end of the data within a value", "its last number").within(place));
                }
                check_number(self.n, self.size, most).map_err(|fault| fault.within(place))?;
                break;
            }
            let n = self.add_up(rest, found).map_err(|fault| fault.within(place))?;
            filled += n;
            if self.n > most {
                return Err(self.too_many(most, input)?.within(place));
            }
        }
        Ok(filled)
    }

    /// Replaces the first `found` numbers by the values that they are the parts of. Returns the number of values.
    fn add_up(&mut self, numbers: &mut [i32], found: usize) -> Result<usize, Box<Fault>> {
        let limits = self.limits;
        let goes_on = |value: i32| value == limits[0] || value == limits[1];
        let mut n = found;
        if self.open.is_some() || numbers[..found].iter().any(|value| goes_on(*value)) {
            n = 0;
            for i in 0..found {
                let part = numbers[i];
                let sum = self.open.unwrap_or(0) + i64::from(part);
                if goes_on(part) {
                    self.open = Some(sum);
                } else {
                    (numbers[n], self.open) = (fits(sum)?, None);
                    n += 1;
                }
            }
        }
        self.n += n;
        Ok(n)
    }

    /// Counts the values that are left. Returns the error for their number.
    fn too_many(&mut self, most: usize, input: &mut StepInput<'_>) -> Result<Box<Fault>, Box<Fault>> {
        let mut numbers = [0; RUNS];
        loop {
            let found = input(&mut numbers)?;
            self.n += numbers[..found].iter().filter(|value| !self.limits.contains(value)).count();
            if found < numbers.len() {
                let error = check_number(self.n, self.size, most);
                return Ok(error.err().unwrap_or_else(|| Fault::new("too many values", format!("at most {most}"))));
            }
        }
    }
}

/// Decoder of `RunLength`: pairs of a value and a count.
#[derive(Debug)]
pub(super) struct Repeat {
    size: Option<usize>,
    pairs: Vec<i32>,
    /// Start of the next pair.
    at: usize,
    /// Current run: value and number of values left.
    run: (i32, usize),
    /// Number of values of all runs so far.
    n: usize,
    /// Number of values and counts so far.
    numbers: usize,
}

impl Repeat {
    pub(super) const fn new(size: Option<usize>) -> Self {
        Self { size, pairs: Vec::new(), at: 0, run: (0, 0), n: 0, numbers: 0 }
    }

    /// Decodes the next values, less than the length of `out` only at the end.
    pub(super) fn read(
        &mut self,
        out: &mut [i32],
        most: usize,
        place: Place,
        input: &mut StepInput<'_>,
    ) -> Result<usize, Box<Fault>> {
        let mut filled = 0;
        while filled < out.len() {
            let (value, left) = self.run;
            if left > 0 {
                let n = left.min(out.len() - filled);
                out[filled..filled + n].fill(value);
                filled += n;
                self.run.1 -= n;
                continue;
            }
            if self.at == self.pairs.len() {
                self.refill(input)?;
            }
            if self.at == self.pairs.len() {
                check_number(self.n, self.size, most).map_err(|fault| fault.within(place))?;
                break;
            }
            self.run = self.next_run().map_err(|fault| fault.within(place))?;
            if self.n > most {
                return Err(self.too_many(most, place, input)?);
            }
        }
        Ok(filled)
    }

    /// Reads pairs.
    fn refill(&mut self, input: &mut StepInput<'_>) -> Result<(), Box<Fault>> {
        self.pairs.resize(2 * RUNS, 0);
        let found = input(&mut self.pairs)?;
        self.pairs.truncate(found);
        self.numbers += found;
        self.at = 0;
        Ok(())
    }

    /// Takes the next pair.
    fn next_run(&mut self) -> Result<(i32, usize), Box<Fault>> {
        let &[value, count] = &self.pairs[self.at..self.pairs.len().min(self.at + 2)] else {
            return Err(Fault::new(format!("{} numbers", self.numbers), "pairs of a value and a count"));
        };
        self.at += 2;
        let count = usize::try_from(count).ok().ok_or_else(|| Fault::new(format!("a run of {count}"), "a count"))?;
        self.n = self.n.saturating_add(count);
        Ok((value, count))
    }

    /// Adds up the runs that are left. Returns the error for their number.
    fn too_many(&mut self, most: usize, place: Place, input: &mut StepInput<'_>) -> Result<Box<Fault>, Box<Fault>> {
        loop {
            while self.at < self.pairs.len() {
                self.next_run().map_err(|fault| fault.within(place))?;
            }
            self.refill(input)?;
            if self.pairs.is_empty() {
                let error = check_number(self.n, self.size, most);
                let error = error.err().unwrap_or_else(|| Fault::new("too many values", format!("at most {most}")));
                return Ok(error.within(place));
            }
        }
    }
}
