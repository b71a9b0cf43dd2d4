//! Mutation of inputs: bytes, numbers, words of the format, lines, repetitions, and parts of other inputs.

use std::ops::Range;

use fastrand::Rng;

/// Texts of numbers at the edges of types and formats.
const NUMBERS: [&str; 16] = [
    "0",
    "-0",
    "1",
    "-1",
    "127",
    "256",
    "65536",
    "2147483648",
    "4294967296",
    "18446744073709551615",
    "99999999999999999999",
    "1e308",
    "1e-400",
    "-1e39",
    "NaN",
    "inf",
];
/// Bytes that separate parts of text formats.
const SEPARATORS: &[u8] = b" \t\r\n\0\"';,=&?#/%{}[]<>:-_.\x1b\x7f\xff";

/// Applies one to eight changes to `input`. `others` are the inputs that it may take parts from. The result has at most
/// `max_len` bytes.
pub(crate) fn mutate(rng: &mut Rng, input: &mut Vec<u8>, others: &[Vec<u8>], words: &[String], max_len: usize) {
    for _ in 0..1_usize << rng.usize(0..4) {
        once(rng, input, others, words);
    }
    input.truncate(max_len);
}

fn once(rng: &mut Rng, input: &mut Vec<u8>, others: &[Vec<u8>], words: &[String]) {
    let at = rng.usize(0..=input.len());
    match rng.u8(0..14) {
        0 if at < input.len() => input[at] ^= 1 << rng.u8(0..8),
        1 if at < input.len() => input[at] = rng.u8(..),
        2 if at < input.len() => input[at] = SEPARATORS[rng.usize(0..SEPARATORS.len())],
        3 => {
            input.drain(range(rng, input.len()));
        }
        4 => {
            let part = input[range(rng, input.len())].to_vec();
            insert(input, at, &part);
        }
        5 => {
            let part = input[range(rng, input.len().min(64))].repeat(1 << rng.u32(0..11));
            insert(input, at, &part);
        }
        6 => {
            let bytes = number(rng);
            let end = (at + bytes.len()).min(input.len());
            input.splice(at..end, bytes);
        }
        7 => {
            let digits = digits(input, at);
            input.splice(digits, NUMBERS[rng.usize(0..NUMBERS.len())].bytes());
        }
        8 | 9 if !words.is_empty() => {
            let word = words[rng.usize(0..words.len())].as_bytes();
            let end = if rng.bool() { at } else { (at + word.len()).min(input.len()) };
            input.splice(at..end, word.iter().copied());
        }
        10 | 11 => {
            // Removes or doubles a line, or the text between two separators.
            let separator = if rng.bool() { b'\n' } else { SEPARATORS[rng.usize(0..SEPARATORS.len())] };
            let start = input[..at].iter().rposition(|b| *b == separator).map_or(0, |i| i + 1);
            let end = input[at..].iter().position(|b| *b == separator).map_or(input.len(), |i| at + i + 1);
            if rng.bool() {
                input.drain(start..end);
            } else {
                let part = input[start..end].to_vec();
                insert(input, start, &part);
            }
        }
        12 if !others.is_empty() => {
            let other = &others[rng.usize(0..others.len())];
            let part = &other[range(rng, other.len())];
            insert(input, at, part);
        }
        13 if !others.is_empty() => {
            let other = &others[rng.usize(0..others.len())];
            input.truncate(at);
            input.extend(&other[rng.usize(0..=other.len())..]);
        }
        _ => insert(input, at, &[rng.u8(..)]),
    }
}

/// Returns a random range of a text, short ones more often.
fn range(rng: &mut Rng, len: usize) -> Range<usize> {
    let start = rng.usize(0..=len);
    let longest = (len - start).min(1 << rng.u32(0..13));
    start..start + rng.usize(0..=longest)
}

fn insert(input: &mut Vec<u8>, at: usize, part: &[u8]) {
    input.splice(at..at, part.iter().copied());
}

/// Returns an integer at the edge of a type, in one of the sizes and byte orders of binary formats.
fn number(rng: &mut Rng) -> Vec<u8> {
    let edges = [0, 1, -1, 127, 128, 255, 32_767, 65_535, i64::from(i32::MAX), i64::from(u32::MAX), i64::MAX, i64::MIN];
    let value = edges[rng.usize(0..edges.len())].wrapping_add(i64::from(rng.i8(-1..=1)));
    let mut bytes = value.to_le_bytes()[..1 << rng.u32(0..4)].to_vec();
    if rng.bool() {
        bytes.reverse();
    }
    bytes
}

/// Returns the range of the first digits at or behind `at`, else an empty one.
fn digits(input: &[u8], at: usize) -> Range<usize> {
    let start = input[at..].iter().position(u8::is_ascii_digit).map_or(at, |i| at + i);
    let n = input[start..].iter().take_while(|b| b.is_ascii_digit() || **b == b'.').count();
    start..start + n
}
