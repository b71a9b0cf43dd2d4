//! Declarations of BinaryCIF encodings. [`mod@super::decode`] applies them.
//!
//! Specification: <https://github.com/molstar/BinaryCIF/blob/master/encoding.md>.

use super::super::text::quote;
use super::fault::Fault;
use super::msgpack::Cursor;
use super::payload::Payload;

/// Maximum length of a chain of encodings. Useful chains have at most five.
const MAX_CHAIN: usize = 8;

/// Little-endian number types.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Number {
    Int8,
    Int16,
    Int32,
    Uint8,
    Uint16,
    Uint32,
    Float32,
    Float64,
}

impl Number {
    fn of(code: u8) -> Option<Self> {
        Some(match code {
            1 => Self::Int8,
            2 => Self::Int16,
            3 => Self::Int32,
            4 => Self::Uint8,
            5 => Self::Uint16,
            6 => Self::Uint32,
            32 => Self::Float32,
            33 => Self::Float64,
            _ => return None,
        })
    }

    pub(super) const fn is_real(self) -> bool {
        matches!(self, Self::Float32 | Self::Float64)
    }

    pub(super) const fn size(self) -> usize {
        match self {
            Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Int32 | Self::Uint32 | Self::Float32 => 4,
            Self::Float64 => 8,
        }
    }
}

/// An encoding with its parameters. Declared intermediate types (`srcType`) are ignored: integers have 32 bits, real
/// numbers 64.
#[derive(Debug, Clone, Copy)]
pub(super) enum Encoding<'a> {
    ByteArray(Number),
    FixedPoint { factor: f64 },
    IntervalQuantization { min: f64, max: f64, steps: i32 },
    RunLength { size: Option<usize> },
    Delta { origin: i32 },
    IntegerPacking { size: Option<usize>, number: Number },
    StringArray(Strings<'a>),
}

/// Parameters of a `StringArray`: concatenated texts, their encoded offsets, and the encodings of the offsets and of
/// the data, which are text ids.
#[derive(Debug, Clone, Copy)]
pub(super) struct Strings<'a> {
    pub(super) joined: &'a [u8],
    pub(super) offsets: Payload<'a>,
    pub(super) offset_chain: Cursor<'a>,
    pub(super) data_chain: Cursor<'a>,
}

impl Encoding<'_> {
    pub(super) const fn name(&self) -> &'static str {
        match self {
            Self::ByteArray(_) => "ByteArray",
            Self::FixedPoint { .. } => "FixedPoint",
            Self::IntervalQuantization { .. } => "IntervalQuantization",
            Self::RunLength { .. } => "RunLength",
            Self::Delta { .. } => "Delta",
            Self::IntegerPacking { .. } => "IntegerPacking",
            Self::StringArray(_) => "StringArray",
        }
    }
}

impl<'a> Encoding<'a> {
    fn read(at: Cursor<'a>) -> Result<Self, Box<Fault>> {
        let size = || {
            let size: Option<u32> = at.field("srcSize", |value| value.whole("a number of values"))?;
            Ok::<_, Box<Fault>>(size.map(|n| n as usize))
        };
        Ok(match at.required("kind", Cursor::text)? {
            b"ByteArray" => {
                let code: u8 = at.required("type", |value| value.whole("a type of numbers"))?;
                let number = Number::of(code).ok_or_else(|| {
                    Fault::new(format!("type {code}"), "a type of numbers (1 to 6, 32 or 33)").within("ByteArray")
                })?;
                Self::ByteArray(number)
            }
            b"FixedPoint" => match at.required("factor", Cursor::number)? {
                0.0 => return Err(Fault::new("a factor of 0", "another factor").within("FixedPoint")),
                factor => Self::FixedPoint { factor },
            },
            b"IntervalQuantization" => {
                let steps = at.required("numSteps", |value| value.whole("a number of steps"))?;
                if steps < 2 {
                    return Err(Fault::new(format!("{steps} steps"), "at least 2").within("IntervalQuantization"));
                }
                let (min, max) = (at.required("min", Cursor::number)?, at.required("max", Cursor::number)?);
                Self::IntervalQuantization { min, max, steps }
            }
            b"RunLength" => Self::RunLength { size: size()? },
            b"Delta" => {
                let origin = at.field("origin", |value| value.whole("a whole number of 32 bits"))?;
                Self::Delta { origin: origin.unwrap_or(0) }
            }
            b"IntegerPacking" => {
                let bytes: u8 = at.required("byteCount", |value| value.whole("1 or 2"))?;
                let number = match (bytes, at.required("isUnsigned", Cursor::truth)?) {
                    (1, true) => Number::Uint8,
                    (1, false) => Number::Int8,
                    (2, true) => Number::Uint16,
                    (2, false) => Number::Int16,
                    (n, _) => return Err(Fault::new(format!("a byteCount of {n}"), "1 or 2").within("IntegerPacking")),
                };
                Self::IntegerPacking { size: size()?, number }
            }
            b"StringArray" => Self::StringArray(Strings {
                joined: at.required("stringData", Cursor::text)?,
                offsets: at.required("offsets", Cursor::bytes)?,
                offset_chain: at.required("offsetEncoding", |value| Ok(*value))?,
                data_chain: at.required("dataEncoding", |value| Ok(*value))?,
            }),
            other => return Err(Fault::new(format!("the encoding {}", quote(other)), "one of BinaryCIF's seven")),
        })
    }
}

/// A chain of encodings in the order of their application.
#[derive(Debug)]
pub(super) struct Chain<'a>(pub(super) Vec<Encoding<'a>>);

impl<'a> Chain<'a> {
    pub(super) fn read(mut at: Cursor<'a>) -> Result<Self, Box<Fault>> {
        let mut chain = Vec::new();
        at.array(|i, item| {
            if chain.len() >= MAX_CHAIN {
                return Err(Fault::new("more encodings", format!("at most {MAX_CHAIN} in a row")));
            }
            let encoding = Encoding::read(*item).map_err(|f| f.within(format_args!("encoding {}", i + 1)))?;
            chain.push(encoding);
            Ok(())
        })?;
        Ok(Self(chain))
    }

    /// Returns the texts, if the chain encodes texts.
    pub(super) fn strings(&self) -> Option<Strings<'a>> {
        match self.0[..] {
            [Encoding::StringArray(strings)] => Some(strings),
            _ => None,
        }
    }
}
