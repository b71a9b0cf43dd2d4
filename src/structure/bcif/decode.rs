//! Decoder of BinaryCIF encodings.
//!
//! A file lists a chain of encodings in the order of their application, so decoding starts at the end. The number of
//! values is known before memory is allocated: every value takes at least one byte or is part of a run, and the lengths
//! of runs are added up first.

use super::encoding::{Chain, Encoding, Number};
use super::fault::Fault;

impl Chain<'_> {
    /// Decodes `data`. No step may produce more than `most` values.
    pub(super) fn decode(&self, data: &[u8], most: usize) -> Result<Values, Box<Fault>> {
        let chain = &self.0[..];
        let location = |i: usize| format!("{} (encoding {} of {})", chain[i].name(), i + 1, chain.len());
        let Some((last, mut others)) = chain.split_last() else {
            return Err(Fault::new("no encoding", "at least ByteArray"));
        };
        let number = byte_array(last, data).map_err(|fault| fault.within(location(others.len())))?;
        let mut values = match others.split_last() {
            Some((&Encoding::IntegerPacking { size, number: packed }, before)) => {
                others = before;
                unpack(data, number, packed, size, most).map_err(|fault| fault.within(location(before.len())))?
            }
            _ => numbers(data, number, most)?,
        };
        for (i, encoding) in others.iter().enumerate().rev() {
            let undone = values.ints().and_then(|ints| encoding.undo(ints, most));
            values = undone.map_err(|fault| fault.within(location(i)))?;
        }
        Ok(values)
    }
}

/// Returns the type of the numbers in `data`. The last encoding of a chain must be `ByteArray`.
fn byte_array(last: &Encoding<'_>, data: &[u8]) -> Result<Number, Box<Fault>> {
    let &Encoding::ByteArray(number) = last else {
        return Err(Fault::new("this encoding at the end of its chain", "ByteArray at the end"));
    };
    let size = number.size();
    if !data.len().is_multiple_of(size) {
        return Err(Fault::new(format!("{} bytes", data.len()), format!("whole numbers of {size} bytes each")));
    }
    Ok(number)
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

/// Converts little-endian numbers of `N` bytes.
fn converted<const N: usize, T, V: FromIterator<T>>(data: &[u8], number: impl Fn([u8; N]) -> T) -> V {
    data.as_chunks::<N>().0.iter().map(|bytes| number(*bytes)).collect()
}

fn within(n: usize, most: usize) -> Result<(), Box<Fault>> {
    if n > most { Err(Fault::new(format!("{n} values"), format!("at most {most}"))) } else { Ok(()) }
}

/// Reads the numbers in `data`.
fn numbers(data: &[u8], number: Number, most: usize) -> Result<Values, Box<Fault>> {
    within(data.len() / number.size(), most)?;
    Ok(match number {
        Number::Int8 => Values::Int(converted(data, |b| i8::from_le_bytes(b).into())),
        Number::Int16 => Values::Int(converted(data, |b| i16::from_le_bytes(b).into())),
        Number::Int32 => Values::Int(converted(data, i32::from_le_bytes)),
        Number::Uint8 => Values::Int(converted(data, |b| u8::from_le_bytes(b).into())),
        Number::Uint16 => Values::Int(converted(data, |b| u16::from_le_bytes(b).into())),
        Number::Uint32 => {
            let values: Option<Vec<i32>> = converted(data, |b| i32::try_from(u32::from_le_bytes(b)).ok());
            Values::Int(values.ok_or_else(|| Fault::new("a number of 2³¹ or more", "a smaller number"))?)
        }
        Number::Float32 => Values::Real(converted(data, |b| f32::from_le_bytes(b).into())),
        Number::Float64 => Values::Real(converted(data, f64::from_le_bytes)),
    })
}

/// Decodes `IntegerPacking`: a value is a sum of numbers, all but the last of which are the limits of their type.
fn unpack(data: &[u8], found: Number, number: Number, size: Option<usize>, most: usize) -> Result<Values, Box<Fault>> {
    if found != number {
        return Err(Fault::new(format!("{found:?} in the ByteArray"), format!("{number:?}")));
    }
    let values = match number {
        Number::Int8 => sums(data, |b| i8::from_le_bytes(b).into(), [i8::MIN.into(), i8::MAX.into()], size, most),
        Number::Int16 => sums(data, |b| i16::from_le_bytes(b).into(), [i16::MIN.into(), i16::MAX.into()], size, most),
        // Unsigned types have no lower limit.
        Number::Uint8 => sums(data, |b| u8::from_le_bytes(b).into(), [-1, u8::MAX.into()], size, most),
        _ => sums(data, |b| u16::from_le_bytes(b).into(), [-1, u16::MAX.into()], size, most),
    };
    values.map(Values::Int)
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
    check_declared(n, size)?;
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
fn check_declared(n: usize, size: Option<usize>) -> Result<(), Box<Fault>> {
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
    fn undo(&self, ints: Vec<i32>, most: usize) -> Result<Values, Box<Fault>> {
        Ok(match *self {
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
            Self::ByteArray(_) => {
                return Err(Fault::new("this encoding in the middle of its chain", "ByteArray at the end"));
            }
            Self::IntegerPacking { .. } => {
                return Err(Fault::new("another encoding after it", "ByteArray after it"));
            }
            Self::StringArray(_) => return Err(Fault::new("this encoding among others", "StringArray alone")),
        })
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
    check_declared(n, size)?;
    within(n, most)?;
    let mut values = Vec::with_capacity(n);
    for &[value, count] in pairs {
        values.extend(std::iter::repeat_n(value, usize::try_from(count).unwrap_or(0)));
    }
    Ok(values)
}
