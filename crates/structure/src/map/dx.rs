//! Reader of `OpenDX` files with one scalar field on a regular grid, as APBS, VMD and `PyMOL` write them: positions,
//! connections and an array of numbers as text. The index along z changes fastest.

use molmesh_surface::Control;

use super::{
    Map, MapError, MapFormat, MapLimits, VALUES_PER_CHECK, allocate, check, inverse, malformed, number_of_points, shown,
};

/// Returns true if the bytes begin with a comment or an object of an `OpenDX` file.
pub(super) fn is_dx(bytes: &[u8]) -> bool {
    let text = bytes.trim_ascii_start();
    text.starts_with(b"#") || text.starts_with(b"object")
}

/// Lines of a file with their numbers.
struct Lines<'a> {
    rest: &'a [u8],
    /// Number of the latest line, from 1.
    number: u64,
}

impl<'a> Lines<'a> {
    fn location(&self) -> String {
        format!("line {}", self.number)
    }

    /// Returns the next line that is neither empty nor a comment.
    fn next(&mut self, control: &Control<'_>) -> Result<Option<&'a [u8]>, MapError> {
        while !self.rest.is_empty() {
            if self.number.is_multiple_of(VALUES_PER_CHECK as u64) {
                check(control)?;
            }
            let end = memchr::memchr(b'\n', self.rest).unwrap_or(self.rest.len());
            let line = self.rest[..end].trim_ascii();
            self.rest = self.rest.get(end + 1..).unwrap_or_default();
            self.number += 1;
            if !line.is_empty() && !line.starts_with(b"#") {
                return Ok(Some(line));
            }
        }
        Ok(None)
    }
}

/// Returns the words of a line, without quotation marks.
fn words(line: &[u8]) -> Vec<&[u8]> {
    let words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    words.take(32).map(|word| word.strip_prefix(b"\"").and_then(|w| w.strip_suffix(b"\"")).unwrap_or(word)).collect()
}

/// Returns the word after `name`.
fn after<'w, 'a>(words: &'w [&'a [u8]], name: &str) -> Option<&'w &'a [u8]> {
    words.iter().skip_while(|word| **word != name.as_bytes()).nth(1)
}

/// Parses the three numbers that follow the first words of a line.
fn three<T>(words: &[&[u8]], parse: impl Fn(&[u8]) -> Option<T>) -> Option<[T; 3]> {
    let [a, b, c] = words else { return None };
    Some([parse(a)?, parse(b)?, parse(c)?])
}

fn integer(word: &[u8]) -> Option<usize> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

fn number(word: &[u8]) -> Option<f64> {
    fast_float2::parse(word).ok().filter(|v: &f64| v.is_finite())
}

/// Header of the field.
#[derive(Default)]
struct Head {
    size: Option<[usize; 3]>,
    origin: Option<[f64; 3]>,
    /// Steps between points along each axis, Å.
    steps: Vec<[f64; 3]>,
}

/// Reads a map.
pub(super) fn read(bytes: &[u8], limits: &MapLimits, control: &Control<'_>) -> Result<Map, MapError> {
    let mut lines = Lines { rest: bytes, number: 0 };
    let mut head = Head::default();
    let (size, items) = loop {
        let Some(line) = lines.next(control)? else {
            return Err(malformed(lines.location(), "the end of the file", "`object … class array … data follows`"));
        };
        let bad = |expected: &str| malformed(lines.location(), shown(line), expected);
        let words = words(line);
        match words[0] {
            b"object" => match after(&words, "class").copied() {
                Some(b"gridpositions") => {
                    let counts =
                        words.iter().position(|word| *word == b"counts").map_or(&[][..], |at| &words[at + 1..]);
                    let size = three(counts, integer).ok_or_else(|| bad("`counts` and three whole numbers"))?;
                    number_of_points(size, &lines.location(), limits)?;
                    head.size = Some(size);
                }
                Some(b"gridconnections") => {}
                Some(b"array") => {
                    let size = head.size.ok_or_else(|| bad("`object … class gridpositions` before the array"))?;
                    if after(&words, "rank").is_some_and(|rank| **rank != *b"0") {
                        return Err(bad("`rank 0`: one number for each point"));
                    }
                    let items = after(&words, "items").and_then(|items| integer(items));
                    let items = items.ok_or_else(|| bad("`items` and the number of points"))?;
                    if !words.ends_with(&[b"data", b"follows"])
                        || words.iter().any(|w| [&b"binary"[..], b"ieee"].contains(w))
                    {
                        return Err(bad("`data follows`, with the numbers as text"));
                    }
                    break (size, items);
                }
                _ => return Err(bad("`class gridpositions`, `gridconnections` or `array`")),
            },
            b"origin" => {
                head.origin = Some(three(&words[1..], number).ok_or_else(|| bad("`origin` and three numbers"))?);
            }
            b"delta" => {
                head.steps.push(three(&words[1..], number).ok_or_else(|| bad("`delta` and three numbers"))?);
                if head.steps.len() > 3 {
                    return Err(bad("three lines `delta`"));
                }
            }
            // Attributes of the preceding object.
            b"attribute" => {}
            _ => return Err(bad("`object`, `origin`, `delta` or `attribute`")),
        }
    };
    let location = lines.location();
    let n = number_of_points(size, &location, limits)?;
    if items != n {
        let [x, y, z] = size;
        return Err(malformed(location, format!("{items} items"), format!("{n} for {x} × {y} × {z} points")));
    }
    let to_grid = head.to_grid(&location)?;
    // Each number but the last has a digit and a separator, so the memory is at most twice the text.
    if lines.rest.len() as u64 + 1 < 2 * n as u64 {
        let found = format!("{} bytes to the end of the file", lines.rest.len());
        return Err(malformed(location, found, format!("{n} numbers")));
    }
    let (mut values, memory) = allocate(n, control)?;
    append(&mut values, n, &mut lines, control)?;
    let strides = [size[1] * size[2], size[2], 1];
    Ok(Map { format: MapFormat::Dx, size, strides, values, to_grid, _memory: memory })
}

impl Head {
    /// Returns the conversion of positions in Å to positions on the grid.
    fn to_grid(&self, location: &str) -> Result<[[f64; 4]; 3], MapError> {
        let missing = |what: &str| malformed(location, "an array", format!("{what} before it"));
        let origin = self.origin.ok_or_else(|| missing("`origin`"))?;
        let [x, y, z] = self.steps[..] else { return Err(missing("three lines `delta`")) };
        let columns = std::array::from_fn(|k| [x[k], y[k], z[k]]);
        let rows = inverse(columns);
        let rows = rows.ok_or_else(|| malformed(location, "`delta` in one plane", "three independent directions"))?;
        Ok(rows.map(|row| {
            let first: f64 = row.iter().zip(origin).map(|(a, b)| a * b).sum();
            [row[0], row[1], row[2], -first]
        }))
    }
}

/// Appends `n` numbers to a list that has the capacity for them.
fn append(values: &mut Vec<f32>, n: usize, lines: &mut Lines<'_>, control: &Control<'_>) -> Result<(), MapError> {
    lines.number += 1;
    while values.len() < n {
        if values.len().is_multiple_of(VALUES_PER_CHECK) {
            check(control)?;
        }
        let start = lines.rest.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(lines.rest.len());
        lines.number += memchr::memchr_iter(b'\n', &lines.rest[..start]).count() as u64;
        lines.rest = &lines.rest[start..];
        let end = lines.rest.iter().position(u8::is_ascii_whitespace).unwrap_or(lines.rest.len());
        let word = &lines.rest[..end];
        let value = fast_float2::parse(word).map_err(|_bad| {
            let found = if word.is_empty() { "the end of the file".to_owned() } else { shown(word) };
            malformed(lines.location(), found, format!("number {} of {n}", values.len() + 1))
        })?;
        values.push(value);
        lines.rest = &lines.rest[end..];
    }
    Ok(())
}
