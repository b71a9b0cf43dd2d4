//! Declarations of BinaryCIF encodings. [`super::decode`] applies them.
//!
//! Specification: <https://github.com/molstar/BinaryCIF/blob/master/encoding.md>.

use super::super::text::quote;
use super::fault::Fault;
use super::msgpack::Cursor;

/// Longest chain of encodings. Useful chains have at most five.
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
    pub(super) offsets: &'a [u8],
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

/// Fields of an encoding; `None` if missing.
#[derive(Default)]
struct Fields<'a> {
    kind: Option<&'a [u8]>,
    number: Option<u8>,
    factor: Option<f64>,
    min: Option<f64>,
    max: Option<f64>,
    steps: Option<i32>,
    size: Option<u32>,
    origin: Option<i32>,
    byte_count: Option<u8>,
    unsigned: Option<bool>,
    joined: Option<&'a [u8]>,
    offsets: Option<&'a [u8]>,
    offset_chain: Option<Cursor<'a>>,
    data_chain: Option<Cursor<'a>>,
}

fn present<T>(field: Option<T>, name: &str) -> Result<T, Box<Fault>> {
    field.ok_or_else(|| Fault::new("nothing", format!("`{name}`")))
}

impl<'a> Encoding<'a> {
    fn read(at: &mut Cursor<'a>) -> Result<Self, Box<Fault>> {
        let mut f = Fields::default();
        at.map(|key, value| {
            let key_text = || format!("`{}`", String::from_utf8_lossy(key));
            let read = match key {
                b"kind" => value.text().map(|v| f.kind = Some(v)),
                b"type" => value.whole("a type of numbers").map(|v| f.number = Some(v)),
                b"factor" => value.number().map(|v| f.factor = Some(v)),
                b"min" => value.number().map(|v| f.min = Some(v)),
                b"max" => value.number().map(|v| f.max = Some(v)),
                b"numSteps" => value.whole("a number of steps").map(|v| f.steps = Some(v)),
                b"srcSize" => value.whole("a number of values").map(|v| f.size = Some(v)),
                b"origin" => value.whole("a whole number of 32 bits").map(|v| f.origin = Some(v)),
                b"byteCount" => value.whole("1 or 2").map(|v| f.byte_count = Some(v)),
                b"isUnsigned" => value.truth().map(|v| f.unsigned = Some(v)),
                b"stringData" => value.text().map(|v| f.joined = Some(v)),
                b"offsets" => value.bytes().map(|v| f.offsets = Some(v)),
                b"offsetEncoding" => {
                    f.offset_chain = Some(*value);
                    Ok(())
                }
                b"dataEncoding" => {
                    f.data_chain = Some(*value);
                    Ok(())
                }
                _ => Ok(()),
            };
            read.map_err(|fault| fault.within(key_text()))
        })?;
        f.encoding()
    }
}

impl<'a> Fields<'a> {
    fn encoding(self) -> Result<Encoding<'a>, Box<Fault>> {
        let size = self.size.map(|n| n as usize);
        Ok(match present(self.kind, "kind")? {
            b"ByteArray" => {
                let code = present(self.number, "type")?;
                let number = Number::of(code).ok_or_else(|| {
                    Fault::new(format!("type {code}"), "a type of numbers (1 to 6, 32 or 33)").within("ByteArray")
                })?;
                Encoding::ByteArray(number)
            }
            b"FixedPoint" => match present(self.factor, "factor")? {
                0.0 => return Err(Fault::new("a factor of 0", "another one").within("FixedPoint")),
                factor => Encoding::FixedPoint { factor },
            },
            b"IntervalQuantization" => {
                let steps = present(self.steps, "numSteps")?;
                if steps < 2 {
                    return Err(Fault::new(format!("{steps} steps"), "at least 2").within("IntervalQuantization"));
                }
                Encoding::IntervalQuantization { min: present(self.min, "min")?, max: present(self.max, "max")?, steps }
            }
            b"RunLength" => Encoding::RunLength { size },
            b"Delta" => Encoding::Delta { origin: self.origin.unwrap_or(0) },
            b"IntegerPacking" => {
                let number = match (present(self.byte_count, "byteCount")?, present(self.unsigned, "isUnsigned")?) {
                    (1, true) => Number::Uint8,
                    (1, false) => Number::Int8,
                    (2, true) => Number::Uint16,
                    (2, false) => Number::Int16,
                    (n, _) => return Err(Fault::new(format!("a byteCount of {n}"), "1 or 2").within("IntegerPacking")),
                };
                Encoding::IntegerPacking { size, number }
            }
            b"StringArray" => Encoding::StringArray(Strings {
                joined: present(self.joined, "stringData")?,
                offsets: present(self.offsets, "offsets")?,
                offset_chain: present(self.offset_chain, "offsetEncoding")?,
                data_chain: present(self.data_chain, "dataEncoding")?,
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
            let encoding = Encoding::read(item).map_err(|f| f.within(format_args!("encoding {}", i + 1)))?;
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
