//! MessagePack reader. It neither copies values nor builds a tree, so memory does not depend on declared lengths.
//! Skipping a value is iterative, so nesting depth is harmless.
//!
//! Specification: <https://github.com/msgpack/msgpack/blob/master/spec.md>.

use super::super::text::quote;
use super::fault::Fault;
use super::payload::Payload;
use super::skeleton::{Cut, Skeleton};

/// A value, or the head of a container.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum PackToken<'a> {
    Nil,
    Bool(bool),
    Integer(i64),
    Real(f64),
    /// A text. UTF-8 is not checked.
    Text(&'a [u8]),
    Bytes(&'a [u8]),
    /// Bytes in the temporary file.
    Stored(Cut),
    /// Number of values that follow.
    Array(u32),
    /// Number of key-value pairs that follow.
    Map(u32),
    Extension,
}

impl PackToken<'_> {
    /// Describes the token for a message.
    pub(super) fn words(&self) -> String {
        match self {
            Self::Nil => "nil".to_owned(),
            Self::Bool(value) => value.to_string(),
            Self::Integer(value) => value.to_string(),
            Self::Real(value) => value.to_string(),
            Self::Text(text) => format!("the text {}", quote(text)),
            Self::Bytes(bytes) => format!("{} bytes", bytes.len()),
            Self::Stored(cut) => format!("{} bytes", cut.len),
            Self::Array(n) => format!("an array of {n}"),
            Self::Map(n) => format!("a map of {n}"),
            Self::Extension => "an extension".to_owned(),
        }
    }
}

/// A position in the file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Source of `bytes`, if large byte strings are in the temporary file.
    skeleton: Option<&'a Skeleton>,
}

impl<'a> Cursor<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, skeleton: None }
    }

    /// Begins to read a file whose large byte strings are in the temporary file.
    pub(super) fn of_skeleton(skeleton: &'a Skeleton) -> Self {
        Self { bytes: &skeleton.bytes, at: 0, skeleton: Some(skeleton) }
    }

    /// Returns the next value or container head. The values of a container follow.
    pub(super) fn next(&mut self) -> Result<PackToken<'a>, Box<Fault>> {
        let start = self.at;
        let [first] = self.take()?;
        Ok(match first {
            0x00..=0x7F => PackToken::Integer(first.into()),
            0x80..=0x8F => self.container(PackToken::Map((first & 15).into()))?,
            0x90..=0x9F => self.container(PackToken::Array((first & 15).into()))?,
            0xA0..=0xBF => PackToken::Text(self.slice((first & 31).into())?),
            0xC0 => PackToken::Nil,
            0xC1 => {
                let fault = Fault::new("c1, which no value begins with", "a MessagePack value");
                return Err(fault.within(format_args!("byte {}", self.offset(start))));
            }
            0xC2 | 0xC3 => PackToken::Bool(first == 0xC3),
            0xC4..=0xC6 => {
                let n = self.length(first - 0xC4)?;
                self.payload(n)?
            }
            0xC7..=0xC9 => {
                let n = self.length(first - 0xC7)?;
                self.extension(n)?
            }
            0xCA => PackToken::Real(f32::from_be_bytes(self.take()?).into()),
            0xCB => PackToken::Real(f64::from_be_bytes(self.take()?)),
            0xCC..=0xCE => PackToken::Integer(self.length(first - 0xCC)?.into()),
            0xCF => unsigned(u64::from_be_bytes(self.take()?)),
            0xD0 => PackToken::Integer(i8::from_be_bytes(self.take()?).into()),
            0xD1 => PackToken::Integer(i16::from_be_bytes(self.take()?).into()),
            0xD2 => PackToken::Integer(i32::from_be_bytes(self.take()?).into()),
            0xD3 => PackToken::Integer(i64::from_be_bytes(self.take()?)),
            0xD4..=0xD8 => self.extension(1 << (first - 0xD4))?,
            0xD9..=0xDB => {
                let n = self.length(first - 0xD9)?;
                PackToken::Text(self.slice(n)?)
            }
            0xDC | 0xDD => {
                let n = self.length(first - 0xDC + 1)?;
                self.container(PackToken::Array(n))?
            }
            0xDE | 0xDF => {
                let n = self.length(first - 0xDE + 1)?;
                self.container(PackToken::Map(n))?
            }
            0xE0..=0xFF => PackToken::Integer(first.cast_signed().into()),
        })
    }

    /// Skips a value and everything inside it.
    pub(super) fn skip(&mut self) -> Result<(), Box<Fault>> {
        let mut pending = 1_u64;
        while pending > 0 {
            pending -= 1;
            match self.next()? {
                PackToken::Array(n) => pending += u64::from(n),
                PackToken::Map(n) => pending += 2 * u64::from(n),
                _ => {}
            }
        }
        Ok(())
    }

    /// Reads a map and calls `entry` with each key and the position of its value. `entry` must read a value completely
    /// or not at all; unread values are skipped.
    pub(super) fn map(
        &mut self,
        mut entry: impl FnMut(&'a [u8], &mut Self) -> Result<(), Box<Fault>>,
    ) -> Result<(), Box<Fault>> {
        let n = match self.next()? {
            PackToken::Map(n) => n,
            other => return Err(Fault::new(other.words(), "a map")),
        };
        for _ in 0..n {
            let key = self.text()?;
            let start = self.at;
            entry(key, self)?;
            if self.at == start {
                self.skip()?;
            }
        }
        Ok(())
    }

    /// Reads an array and calls `item` with the index, from 0, and the position of each value, like [`Self::map`].
    pub(super) fn array(
        &mut self,
        mut item: impl FnMut(u32, &mut Self) -> Result<(), Box<Fault>>,
    ) -> Result<(), Box<Fault>> {
        let n = match self.next()? {
            PackToken::Array(n) => n,
            other => return Err(Fault::new(other.words(), "an array")),
        };
        for i in 0..n {
            let start = self.at;
            item(i, self)?;
            if self.at == start {
                self.skip()?;
            }
        }
        Ok(())
    }

    /// Finds a key of a map and reads its value, without moving the cursor. Returns `None` if the key is missing. The
    /// last of equal keys counts.
    pub(super) fn field<T>(
        &self,
        name: &str,
        read: impl FnOnce(&mut Self) -> Result<T, Box<Fault>>,
    ) -> Result<Option<T>, Box<Fault>> {
        let (mut map, mut found) = (*self, None);
        map.map(|key, value| {
            if key == name.as_bytes() {
                found = Some(*value);
            }
            Ok(())
        })?;
        let read = |mut value| read(&mut value).map_err(|fault| fault.within(format_args!("`{name}`")));
        found.map(read).transpose()
    }

    /// Reads the value of a key like [`Self::field`]. A missing key is an error.
    pub(super) fn required<T>(
        &self,
        name: &str,
        read: impl FnOnce(&mut Self) -> Result<T, Box<Fault>>,
    ) -> Result<T, Box<Fault>> {
        self.field(name, read)?.ok_or_else(|| Fault::new("nothing", format!("`{name}`")))
    }

    pub(super) fn text(&mut self) -> Result<&'a [u8], Box<Fault>> {
        match self.next()? {
            PackToken::Text(text) => Ok(text),
            other => Err(Fault::new(other.words(), "a text")),
        }
    }

    pub(super) fn bytes(&mut self) -> Result<Payload<'a>, Box<Fault>> {
        match (self.next()?, self.skeleton) {
            (PackToken::Bytes(bytes), _) => Ok(Payload::Bytes(bytes)),
            (PackToken::Stored(Cut { offset, len, .. }), Some(Skeleton { file, .. })) => {
                Ok(Payload::Stored { file, offset, len })
            }
            (other, _) => Err(Fault::new(other.words(), "bytes")),
        }
    }

    /// Reads a boolean. Languages without booleans write 1 or 0.
    pub(super) fn truth(&mut self) -> Result<bool, Box<Fault>> {
        match self.next()? {
            PackToken::Bool(value) => Ok(value),
            PackToken::Integer(value @ (0 | 1)) => Ok(value == 1),
            other => Err(Fault::new(other.words(), "true or false")),
        }
    }

    /// Reads a finite number.
    pub(super) fn number(&mut self) -> Result<f64, Box<Fault>> {
        match self.next()? {
            #[expect(clippy::cast_precision_loss, reason = "factors and bounds are small or already rounded")]
            PackToken::Integer(value) => Ok(value as f64),
            PackToken::Real(value) if value.is_finite() => Ok(value),
            other => Err(Fault::new(other.words(), "a finite number")),
        }
    }

    /// Reads an integer of type `T`. Languages with a single number type may write it as a real number.
    pub(super) fn whole<T: TryFrom<i64>>(&mut self, expected: &str) -> Result<T, Box<Fault>> {
        let token = self.next()?;
        let value = match token {
            PackToken::Integer(value) => Some(value),
            #[expect(clippy::cast_possible_truncation, reason = "whole and far below 2⁵³")]
            PackToken::Real(value) if value.fract() == 0.0 && value.abs() < 1e15 => Some(value as i64),
            _ => None,
        };
        value.and_then(|v| T::try_from(v).ok()).ok_or_else(|| Fault::new(token.words(), expected))
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], Box<Fault>> {
        let found = self.bytes.get(self.at..).and_then(|rest| rest.first_chunk::<N>());
        let Some(found) = found else { return Err(self.end(N)) };
        self.at += N;
        Ok(*found)
    }

    /// Reads a big-endian length of 2^`log` bytes: 1, 2 or 4.
    fn length(&mut self, log: u8) -> Result<u32, Box<Fault>> {
        Ok(match log {
            0 => u8::from_be_bytes(self.take()?).into(),
            1 => u16::from_be_bytes(self.take()?).into(),
            _ => u32::from_be_bytes(self.take()?),
        })
    }

    fn slice(&mut self, len: u32) -> Result<&'a [u8], Box<Fault>> {
        let len = len as usize;
        let found = self.bytes.get(self.at..).and_then(|rest| rest.get(..len));
        let Some(found) = found else { return Err(self.end(len)) };
        self.at += len;
        Ok(found)
    }

    /// Reads a byte string of `len` bytes.
    fn payload(&mut self, len: u32) -> Result<PackToken<'a>, Box<Fault>> {
        match self.skeleton.and_then(|skeleton| skeleton.cut_at(self.at)) {
            None => self.slice(len).map(PackToken::Bytes),
            Some(cut) if cut.len == u64::from(len) => {
                self.at += 1;
                Ok(PackToken::Stored(cut))
            }
            // The file ends within the byte string.
            Some(_) => Err(self.end(len as usize)),
        }
    }

    /// Returns the offset in the file of a position.
    fn offset(&self, at: usize) -> u64 {
        self.skeleton.map_or(at as u64, |skeleton| skeleton.offset(at))
    }

    /// Returns the number of bytes to the end of the file.
    fn left(&self) -> u64 {
        self.offset(self.bytes.len()).saturating_sub(self.offset(self.at))
    }

    fn extension(&mut self, len: u32) -> Result<PackToken<'a>, Box<Fault>> {
        let [_kind] = self.take()?;
        self.slice(len)?;
        Ok(PackToken::Extension)
    }

    /// Rejects container heads that declare more values than there are bytes.
    fn container(&mut self, head: PackToken<'a>) -> Result<PackToken<'a>, Box<Fault>> {
        let least = match head {
            PackToken::Array(n) => n as usize,
            PackToken::Map(n) => 2 * n as usize,
            _ => 0,
        };
        if least as u64 > self.left() { Err(self.end(least)) } else { Ok(head) }
    }

    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    fn end(&self, wanted: usize) -> Box<Fault> {
        let left = self.left();
        Fault::new(format!("the end of the file after {left} bytes"), format!("{wanted} bytes or more"))
            .within(format_args!("byte {}", self.offset(self.at)))
    }
}

/// Converts an unsigned number. Values that do not fit into `i64` are neither lengths nor ids and become real numbers.
fn unsigned(value: u64) -> PackToken<'static> {
    #[expect(clippy::cast_precision_loss, reason = "used only in messages")]
    i64::try_from(value).map_or(PackToken::Real(value as f64), PackToken::Integer)
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests;
