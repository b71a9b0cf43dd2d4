//! Decoder of BinaryCIF encodings, for whole columns and for ranges of their rows.
//!
//! A file lists a chain of encodings in the order of their application, so decoding starts at the end. Values are
//! decoded in chunks that stay in the cache of the processor. No step produces more values than allowed; the lengths of
//! runs are added up before they are expanded.

use super::encoding::{Chain, Encoding, Number};
use super::fault::Fault;
use super::payload::ByteStream;
use super::steps::{Place, Repeat, Unpack, fits, within};

/// Number of values that are decoded at a time.
pub(super) const CHUNK: usize = 4096;

/// Values of a chain of encodings, in order.
#[derive(Debug)]
pub(super) struct ValueStream<'a> {
    ints: IntStream<'a>,
    /// Conversion to real numbers, which ends the decoding.
    reals: Option<(Reals, Place)>,
    /// Number of values so far.
    pub(super) n: usize,
    buffer: Vec<i32>,
}

/// Numbers in the data, and the steps that decode them, from the last encoding on.
#[derive(Debug)]
struct IntStream<'a> {
    bytes: ByteStream<'a>,
    number: Number,
    steps: Vec<(Step, Place)>,
    /// Maximum number of values of a step.
    most: usize,
}

/// Source of real numbers.
#[derive(Debug, Clone, Copy)]
enum Reals {
    /// The data itself.
    Data,
    FixedPoint {
        factor: f64,
    },
    Interval {
        min: f64,
        width: f64,
        steps: i32,
    },
}

/// Decoder of an encoding of integers.
#[derive(Debug)]
enum Step {
    Unpack(Unpack),
    Delta { sum: i64 },
    Repeat(Repeat),
}

impl Chain<'_> {
    /// Begins to decode `bytes`. No step may produce more than `most` values.
    pub(super) fn decode<'a>(&self, bytes: ByteStream<'a>, most: usize) -> Result<ValueStream<'a>, Box<Fault>> {
        let chain = &self.0[..];
        let place = |i: usize| Place { name: chain[i].name(), number: i + 1, of: chain.len() };
        let Some((last, others)) = chain.split_last() else {
            return Err(Fault::new("no encoding", "at least ByteArray"));
        };
        let at_end = place(others.len());
        let number = byte_array(last, bytes.len).map_err(|fault| fault.within(at_end))?;
        if !matches!(others.last(), Some(Encoding::IntegerPacking { .. })) {
            within(usize::try_from(bytes.len).unwrap_or(usize::MAX) / number.size(), most)?;
        }
        let ints = IntStream { bytes, number, steps: Vec::new(), most };
        let reals = number.is_real().then_some((Reals::Data, at_end));
        let mut values = ValueStream { ints, reals, n: 0, buffer: Vec::new() };
        for (i, encoding) in others.iter().enumerate().rev() {
            let is_next = i + 1 == others.len();
            values.add(encoding, is_next, place(i)).map_err(|fault| fault.within(place(i)))?;
        }
        Ok(values)
    }
}

/// Returns the type of the numbers in data of `len` bytes. The last encoding of a chain must be `ByteArray`.
fn byte_array(last: &Encoding<'_>, len: u64) -> Result<Number, Box<Fault>> {
    let &Encoding::ByteArray(number) = last else {
        return Err(Fault::new("this encoding at the end of its chain", "ByteArray at the end"));
    };
    let size = number.size();
    if !len.is_multiple_of(size as u64) {
        return Err(Fault::new(format!("{len} bytes"), format!("whole numbers of {size} bytes each")));
    }
    Ok(number)
}

impl ValueStream<'_> {
    /// Adds the decoder of the encoding before those so far. `is_next` is true next to the `ByteArray`.
    fn add(&mut self, encoding: &Encoding<'_>, is_next: bool, place: Place) -> Result<(), Box<Fault>> {
        if let Encoding::IntegerPacking { size, number } = *encoding
            && is_next
        {
            let found = self.ints.number;
            if found != number {
                return Err(Fault::new(format!("{found:?} in the ByteArray"), format!("{number:?}")));
            }
            self.ints.steps.push((Step::Unpack(Unpack::new(number, size)), place));
            return Ok(());
        }
        self.require_ints()?;
        match *encoding {
            Encoding::Delta { origin } => self.ints.steps.push((Step::Delta { sum: origin.into() }, place)),
            Encoding::RunLength { size } => self.ints.steps.push((Step::Repeat(Repeat::new(size)), place)),
            Encoding::FixedPoint { factor } => self.reals = Some((Reals::FixedPoint { factor }, place)),
            Encoding::IntervalQuantization { min, max, steps } => {
                let width = (max - min) / f64::from(steps - 1);
                self.reals = Some((Reals::Interval { min, width, steps }, place));
            }
            Encoding::ByteArray(_) => {
                return Err(Fault::new("this encoding in the middle of its chain", "ByteArray at the end"));
            }
            Encoding::IntegerPacking { .. } => {
                return Err(Fault::new("another encoding after it", "ByteArray after it"));
            }
            Encoding::StringArray(_) => return Err(Fault::new("this encoding among others", "StringArray alone")),
        }
        Ok(())
    }

    /// Rejects real numbers.
    pub(super) fn require_ints(&self) -> Result<(), Box<Fault>> {
        if self.is_real() { Err(Fault::new("real numbers", "whole numbers")) } else { Ok(()) }
    }

    pub(super) const fn is_real(&self) -> bool {
        self.reals.is_some()
    }

    /// Copies the data that is in memory.
    pub(super) fn into_owned(self) -> ValueStream<'static> {
        let IntStream { bytes, number, steps, most } = self.ints;
        let ints = IntStream { bytes: bytes.into_owned(), number, steps, most };
        ValueStream { ints, reals: self.reals, n: self.n, buffer: self.buffer }
    }

    /// Decodes at most `n` whole numbers to the end of `out`, less only at the end.
    pub(super) fn ints(&mut self, mut n: usize, out: &mut Vec<i32>) -> Result<(), Box<Fault>> {
        while n > 0 {
            let (start, wanted) = (out.len(), n.min(CHUNK));
            out.resize(start + wanted, 0);
            let found = self.ints.read(&mut out[start..])?;
            out.truncate(start + found);
            self.n += found;
            n = if found < wanted { 0 } else { n - found };
        }
        Ok(())
    }

    /// Decodes at most `n` real numbers to the end of `out`, less only at the end.
    pub(super) fn reals(&mut self, mut n: usize, out: &mut Vec<f64>) -> Result<(), Box<Fault>> {
        while n > 0 {
            let wanted = n.min(CHUNK);
            let found = match self.reals {
                None | Some((Reals::Data, _)) => self.ints.real_data(wanted, out)?,
                Some((reals, place)) => {
                    self.buffer.resize(wanted, 0);
                    let found = self.ints.read(&mut self.buffer)?;
                    reals.convert(&self.buffer[..found], out).map_err(|fault| fault.within(place))?;
                    found
                }
            };
            self.n += found;
            n = if found < wanted { 0 } else { n - found };
        }
        Ok(())
    }

    /// Decodes the values that are left. Returns the number of all values.
    pub(super) fn end(&mut self) -> Result<usize, Box<Fault>> {
        if let Some((Reals::Data, _)) = self.reals {
            let all = self.ints.bytes.len / self.ints.number.size() as u64;
            return Ok(usize::try_from(all).unwrap_or(usize::MAX));
        }
        // Mostly none are left.
        let mut rest = [0; 64];
        loop {
            let found = self.ints.read(&mut rest)?;
            self.n += found;
            if found < rest.len() {
                return Ok(self.n);
            }
        }
    }
}

impl Reals {
    /// Converts whole numbers.
    fn convert(self, ints: &[i32], out: &mut Vec<f64>) -> Result<(), Box<Fault>> {
        match self {
            Self::Data => {}
            // Division restores the original value exactly; multiplication by the inverse does not.
            Self::FixedPoint { factor } => out.extend(ints.iter().map(|&v| f64::from(v) / factor)),
            Self::Interval { min, width, steps } => {
                if let Some(step) = ints.iter().find(|step| !(0..steps).contains(*step)) {
                    return Err(Fault::new(format!("step {step}"), format!("a step from 0 to {}", steps - 1)));
                }
                out.extend(ints.iter().map(|&v| min + width * f64::from(v)));
            }
        }
        Ok(())
    }
}

/// Converts little-endian numbers of `N` bytes.
fn convert<const N: usize, T>(data: &[u8], out: &mut [T], number: impl Fn([u8; N]) -> T) {
    for (value, bytes) in out.iter_mut().zip(data.as_chunks::<N>().0) {
        *value = number(*bytes);
    }
}

impl IntStream<'_> {
    /// Decodes the next values, less than the length of `out` only at the end.
    fn read(&mut self, out: &mut [i32]) -> Result<usize, Box<Fault>> {
        let Self { bytes, number, steps, most } = self;
        decode(bytes, *number, steps, *most, out)
    }

    /// Reads at most `n` real numbers of the data to the end of `out`, less only at the end.
    fn real_data(&mut self, n: usize, out: &mut Vec<f64>) -> Result<usize, Box<Fault>> {
        let (start, size) = (out.len(), self.number.size());
        while out.len() < start + n {
            let data = self.bytes.next((start + n - out.len()) * size)?;
            if data.is_empty() {
                break;
            }
            match size {
                4 => out.extend(data.as_chunks().0.iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes)))),
                _ => out.extend(data.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes))),
            }
        }
        Ok(out.len() - start)
    }
}

/// Decodes the next values of the last of the `steps`, less than the length of `out` only at the end.
fn decode(
    bytes: &mut ByteStream<'_>,
    number: Number,
    steps: &mut [(Step, Place)],
    most: usize,
    out: &mut [i32],
) -> Result<usize, Box<Fault>> {
    let Some(((step, place), before)) = steps.split_last_mut() else { return data(bytes, number, out) };
    let place = *place;
    let mut input = |out: &mut [i32]| decode(bytes, number, before, most, out);
    match step {
        Step::Unpack(unpack) => unpack.read(out, most, place, &mut input),
        Step::Repeat(repeat) => repeat.read(out, most, place, &mut input),
        Step::Delta { sum } => {
            let n = input(out)?;
            for value in &mut out[..n] {
                *sum += i64::from(*value);
                *value = fits(*sum).map_err(|fault| fault.within(place))?;
            }
            Ok(n)
        }
    }
}

/// Reads the next whole numbers of the data, less than the length of `out` only at the end.
fn data(bytes: &mut ByteStream<'_>, number: Number, out: &mut [i32]) -> Result<usize, Box<Fault>> {
    let mut n = 0;
    while n < out.len() {
        let out = &mut out[n..];
        let data = bytes.next(out.len() * number.size())?;
        if data.is_empty() {
            break;
        }
        match number {
            Number::Int8 => convert(data, out, |b| i8::from_le_bytes(b).into()),
            Number::Int16 => convert(data, out, |b| i16::from_le_bytes(b).into()),
            Number::Uint8 => convert(data, out, |b| u8::from_le_bytes(b).into()),
            Number::Uint16 => convert(data, out, |b| u16::from_le_bytes(b).into()),
            Number::Int32 | Number::Uint32 => convert(data, out, i32::from_le_bytes),
            Number::Float32 | Number::Float64 => return Err(Fault::new("real numbers", "whole numbers")),
        }
        let found = data.len() / number.size();
        if number == Number::Uint32 && out[..found].iter().any(|value| *value < 0) {
            return Err(Fault::new("a number of 2³¹ or more", "a smaller number"));
        }
        n += found;
    }
    Ok(n)
}
