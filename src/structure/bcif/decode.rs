//! Decoder of BinaryCIF encodings.
//!
//! A file lists a chain of encodings in the order of their application, so decoding starts at the end. Lengths are
//! known before memory is allocated: every value comes from at least one byte or from a run, and the runs are summed
//! first.

use super::encoding::{Chain, Encoding, Number};
use super::fault::Fault;

impl<'a> Chain<'a> {
    /// Decodes `data`. No step may produce more than `most` values.
    pub(super) fn decode(&self, data: &'a [u8], most: usize) -> Result<Values, Box<Fault>> {
        let mut stage = None;
        for (i, encoding) in self.0.iter().enumerate().rev() {
            let undone = match (encoding, stage.take()) {
                (&Encoding::ByteArray(number), None) => Stage::bytes(data, number),
                (&Encoding::IntegerPacking { size, number }, Some(Stage::Bytes(bytes))) => {
                    bytes.unpack(number, size, most)
                }
                (_, None) => Err(Fault::new("it at the end of its chain", "ByteArray at the end")),
                (Encoding::ByteArray(_), _) => Err(Fault::new("it in the middle of its chain", "it at the end")),
                (Encoding::IntegerPacking { .. }, _) => {
                    Err(Fault::new("another encoding after it", "ByteArray after it"))
                }
                (Encoding::StringArray(_), _) => Err(Fault::new("it among others", "it alone")),
                (encoding, Some(stage)) => stage.ints(most).and_then(|ints| encoding.undo(ints, most)),
            };
            let place = || format!("{} (encoding {} of {})", encoding.name(), i + 1, self.0.len());
            stage = Some(undone.map_err(|fault| fault.within(place()))?);
        }
        match stage {
            None => Err(Fault::new("no encoding", "at least ByteArray")),
            Some(Stage::Bytes(bytes)) => bytes.values(most),
            Some(Stage::Values(values)) => Ok(values),
        }
    }
}

/// Decoded numbers.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Values {
    Int(Vec<i32>),
    Real(Vec<f64>),
}

impl Values {
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Int(values) => values.len(),
            Self::Real(values) => values.len(),
        }
    }

    pub(super) fn ints(self) -> Result<Vec<i32>, Box<Fault>> {
        match self {
            Self::Int(values) => Ok(values),
            Self::Real(_) => Err(Fault::new("real numbers", "whole numbers")),
        }
    }
}

/// Undecoded numbers.
#[derive(Debug, Clone, Copy)]
struct Bytes<'a> {
    data: &'a [u8],
    number: Number,
}

/// Intermediate result of decoding.
#[derive(Debug)]
enum Stage<'a> {
    Bytes(Bytes<'a>),
    Values(Values),
}

impl<'a> Stage<'a> {
    fn bytes(data: &'a [u8], number: Number) -> Result<Self, Box<Fault>> {
        let size = number.size();
        if !data.len().is_multiple_of(size) {
            return Err(Fault::new(format!("{} bytes", data.len()), format!("whole numbers of {size} bytes each")));
        }
        Ok(Self::Bytes(Bytes { data, number }))
    }

    fn ints(self, most: usize) -> Result<Vec<i32>, Box<Fault>> {
        match self {
            Self::Bytes(bytes) => bytes.values(most)?.ints(),
            Self::Values(values) => values.ints(),
        }
    }
}

/// Reads little-endian numbers of `N` bytes.
fn numbers<const N: usize, T, V: FromIterator<T>>(data: &[u8], number: impl Fn([u8; N]) -> T) -> V {
    data.as_chunks::<N>().0.iter().map(|bytes| number(*bytes)).collect()
}

fn within(n: usize, most: usize) -> Result<(), Box<Fault>> {
    if n > most { Err(Fault::new(format!("{n} values"), format!("at most {most}"))) } else { Ok(()) }
}

impl<'a> Bytes<'a> {
    fn values(self, most: usize) -> Result<Values, Box<Fault>> {
        let data = self.data;
        within(data.len() / self.number.size(), most)?;
        Ok(match self.number {
            Number::Int8 => Values::Int(numbers(data, |b| i8::from_le_bytes(b).into())),
            Number::Int16 => Values::Int(numbers(data, |b| i16::from_le_bytes(b).into())),
            Number::Int32 => Values::Int(numbers(data, i32::from_le_bytes)),
            Number::Uint8 => Values::Int(numbers(data, |b| u8::from_le_bytes(b).into())),
            Number::Uint16 => Values::Int(numbers(data, |b| u16::from_le_bytes(b).into())),
            Number::Uint32 => {
                let values: Option<Vec<i32>> = numbers(data, |b| i32::try_from(u32::from_le_bytes(b)).ok());
                Values::Int(values.ok_or_else(|| Fault::new("a number of 2³¹ or more", "one below"))?)
            }
            Number::Float32 => Values::Real(numbers(data, |b| f32::from_le_bytes(b).into())),
            Number::Float64 => Values::Real(numbers(data, f64::from_le_bytes)),
        })
    }

    /// Decodes `IntegerPacking`: a value is a sum of numbers, all but the last of which are the limits of their type.
    fn unpack(self, number: Number, size: Option<usize>, most: usize) -> Result<Stage<'a>, Box<Fault>> {
        if self.number != number {
            let (found, expected) = (format!("{:?} in the ByteArray", self.number), format!("{number:?}"));
            return Err(Fault::new(found, expected));
        }
        let data = self.data;
        let limits = match number {
            Number::Int8 => [i8::MIN.into(), i8::MAX.into()],
            Number::Int16 => [i16::MIN.into(), i16::MAX.into()],
            // Unsigned types have no lower limit.
            Number::Uint8 => [-1, u8::MAX.into()],
            _ => [-1, u16::MAX.into()],
        };
        let ints = match number {
            Number::Int8 => sums(data, |b| i8::from_le_bytes(b).into(), limits, size, most),
            Number::Int16 => sums(data, |b| i16::from_le_bytes(b).into(), limits, size, most),
            Number::Uint8 => sums(data, |b| u8::from_le_bytes(b).into(), limits, size, most),
            _ => sums(data, |b| u16::from_le_bytes(b).into(), limits, size, most),
        };
        Ok(Stage::Values(Values::Int(ints?)))
    }
}

/// Sums runs of numbers that end with a number other than the `limits`.
fn sums<const N: usize>(
    data: &[u8],
    number: impl Fn([u8; N]) -> i32,
    limits: [i32; 2],
    size: Option<usize>,
    most: usize,
) -> Result<Vec<i32>, Box<Fault>> {
    let numbers = data.as_chunks::<N>().0;
    let goes_on = |value: i32| value == limits[0] || value == limits[1];
    let n = numbers.iter().filter(|bytes| !goes_on(number(**bytes))).count();
    if numbers.last().is_some_and(|bytes| goes_on(number(*bytes))) {
        return Err(Fault::new("the end of the data within a value", "its last number"));
    }
    said(n, size)?;
    within(n, most)?;
    if n == numbers.len() {
        return Ok(numbers.iter().map(|bytes| number(*bytes)).collect());
    }
    let mut values = Vec::with_capacity(n);
    let mut sum = 0_i64;
    for bytes in numbers {
        let part = number(*bytes);
        sum += i64::from(part);
        if !goes_on(part) {
            values.push(fits(sum)?);
            sum = 0;
        }
    }
    Ok(values)
}

/// Checks a length against the declared one.
fn said(n: usize, size: Option<usize>) -> Result<(), Box<Fault>> {
    match size {
        Some(size) if size != n => Err(Fault::new(format!("{n} values"), format!("{size}, as srcSize says"))),
        _ => Ok(()),
    }
}

fn fits(value: i64) -> Result<i32, Box<Fault>> {
    i32::try_from(value).ok().ok_or_else(|| Fault::new(value.to_string(), "a whole number of 32 bits"))
}

impl Encoding<'_> {
    /// Decodes one encoding of integers.
    fn undo(&self, ints: Vec<i32>, most: usize) -> Result<Stage<'static>, Box<Fault>> {
        let values = match *self {
            Self::Delta { origin } => Values::Int(add_up(ints, origin)?),
            Self::RunLength { size } => Values::Int(repeat(&ints, size, most)?),
            // Division restores the original value exactly; multiplication by the inverse does not.
            Self::FixedPoint { factor } => Values::Real(ints.iter().map(|&v| f64::from(v) / factor).collect()),
            Self::IntervalQuantization { min, max, steps } => {
                if let Some(step) = ints.iter().find(|step| !(0..steps).contains(*step)) {
                    return Err(Fault::new(format!("step {step}"), format!("a step from 0 to {}", steps - 1)));
                }
                let width = (max - min) / f64::from(steps - 1);
                Values::Real(ints.iter().map(|&v| min + width * f64::from(v)).collect())
            }
            Self::ByteArray(_) | Self::IntegerPacking { .. } | Self::StringArray(_) => Values::Int(ints),
        };
        Ok(Stage::Values(values))
    }
}

/// Decodes `Delta`: the first difference is relative to the origin.
fn add_up(mut ints: Vec<i32>, origin: i32) -> Result<Vec<i32>, Box<Fault>> {
    let mut sum = i64::from(origin);
    for value in &mut ints {
        sum += i64::from(*value);
        *value = fits(sum)?;
    }
    Ok(ints)
}

/// Decodes `RunLength`: pairs of a value and a count.
fn repeat(pairs: &[i32], size: Option<usize>, most: usize) -> Result<Vec<i32>, Box<Fault>> {
    let (pairs, rest) = pairs.as_chunks::<2>();
    if !rest.is_empty() {
        return Err(Fault::new(format!("{} numbers", 2 * pairs.len() + 1), "pairs of a value and a count"));
    }
    let mut n = 0_usize;
    for &[_, count] in pairs {
        let count = usize::try_from(count).ok().ok_or_else(|| Fault::new(format!("a run of {count}"), "a count"))?;
        n = n.saturating_add(count);
    }
    said(n, size)?;
    within(n, most)?;
    let mut values = Vec::with_capacity(n);
    for &[value, count] in pairs {
        values.extend(std::iter::repeat_n(value, usize::try_from(count).unwrap_or(0)));
    }
    Ok(values)
}
