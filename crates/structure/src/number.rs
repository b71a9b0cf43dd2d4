//! Fast parser for the numbers in structure files, eight digits at a time.
//!
//! A number of the usual form `-?ddd.ddd` with at most eight digits is an integer below 10⁸ divided by a power of ten.
//! Both are exact in an `f64`, so the quotient is correctly rounded and equals the result of the general parser. All
//! other numbers go to the general parser.

const ONES: u64 = 0x0101_0101_0101_0101;
const ZEROS: u64 = 0x3030_3030_3030_3030;
const HIGH: u64 = 0x8080_8080_8080_8080;
const TWO_52: f64 = 4_503_599_627_370_496.0;
const POWERS: [f64; 9] = [1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8];

/// Masks with the low `n` bytes set, `n` from 0 to 8.
const LOW: [u64; 9] = {
    let mut masks = [0; 9];
    let mut n = 1;
    while n <= 8 {
        masks[n] = u64::MAX >> (64 - 8 * n);
        n += 1;
    }
    masks
};

/// Parses `text[start..end]`. Returns `None` if it is not a finite number. Ignores a standard uncertainty in
/// parentheses (`1.234(5)`).
#[inline]
pub(super) fn real(text: &[u8], start: usize, end: usize) -> Option<f64> {
    match short_decimal(text, start, end) {
        Some(value) => Some(value),
        None => general(&text[start..end]),
    }
}

/// Rounds an occupancy or a B-factor to single precision.
#[expect(clippy::cast_possible_truncation, reason = "rounding is intended; values that are too large become infinite")]
pub(super) fn single(value: f64) -> f32 {
    value as f32
}

#[inline]
fn short_decimal(text: &[u8], start: usize, end: usize) -> Option<f64> {
    // Eleven bytes hold a sign, eight digits, a point and one more byte.
    let window = text.get(start..)?.first_chunk::<11>()?;
    let negative = usize::from(window[0] == b'-');
    let len = (end - start).wrapping_sub(negative);
    let word = |at: usize| -> u64 {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&window[at..at + 8]);
        u64::from_le_bytes(bytes)
    };
    let (head, tail) = if negative == 1 { (word(1), word(2)) } else { (word(0), word(1)) };
    // The lowest zero byte of `head ^ "........"` is the first point.
    let points = head ^ (ONES * 0x2E);
    let point = (points.wrapping_sub(ONES) & !points & HIGH).trailing_zeros() as usize / 8;
    let integer_digits = point.min(len);
    let digits = len - usize::from(point < len);
    // The window does not contain a point in the ninth position.
    if digits == 0 || digits > 8 || (point == 8 && len > 8) {
        return None;
    }
    // Digits before the point come from `head`, those after it from `tail`, which starts one byte later.
    let joined = (head & LOW[integer_digits]) | (tail & !LOW[integer_digits]);
    let shift = 8 * (8 - digits);
    // Right-aligned, with leading zeros.
    let aligned = (joined << shift) | (ZEROS & LOW[8 - digits]);
    let values = aligned ^ ZEROS;
    if (values.wrapping_add(ONES * 0x76) | values) & HIGH != 0 {
        return None;
    }
    let pairs = (values.wrapping_mul(10).wrapping_add(values >> 8)) & 0x00FF_00FF_00FF_00FF;
    let fours = (pairs.wrapping_mul(100).wrapping_add(pairs >> 16)) & 0x0000_FFFF_0000_FFFF;
    let eights = (fours.wrapping_mul(10_000).wrapping_add(fours >> 32)) & 0xFFFF_FFFF;
    // Sets the low bits of 2⁵² to the integer. Unlike a conversion instruction, this does not depend on earlier
    // results.
    let whole = f64::from_bits(TWO_52.to_bits() | eights) - TWO_52;
    let magnitude = whole / POWERS[digits - integer_digits];
    Some(f64::from_bits(magnitude.to_bits() | (negative as u64) << 63))
}

#[cold]
fn general(raw: &[u8]) -> Option<f64> {
    // Real coordinates are shorter; hostile input may have millions of digits.
    if raw.len() > 64 {
        return None;
    }
    let digits = match raw.iter().position(|&b| b == b'(') {
        Some(open) if raw.last() == Some(&b')') && raw[open + 1..raw.len() - 1].iter().all(u8::is_ascii_digit) => {
            &raw[..open]
        }
        Some(_) => return None,
        None => raw,
    };
    // The general parser also accepts the words nan, inf and infinity.
    if digits.iter().any(|b| b.is_ascii_alphabetic() && !matches!(b, b'e' | b'E')) {
        return None;
    }
    let value: f64 = fast_float2::parse(digits).ok()?;
    value.is_finite().then_some(value)
}

/// Parses a decimal integer. Returns `None` if it does not fit.
#[inline]
pub(super) fn integer(raw: &[u8]) -> Option<i32> {
    let (negative, digits) = match raw {
        [b'-', rest @ ..] => (true, rest),
        [b'+', rest @ ..] => (false, rest),
        _ => (false, raw),
    };
    if digits.is_empty() || digits.len() > 10 {
        return None;
    }
    let mut value = 0_i64;
    for &b in digits {
        if !b.is_ascii_digit() {
            return None;
        }
        value = value * 10 + i64::from(b - b'0');
    }
    i32::try_from(if negative { -value } else { value }).ok()
}

/// Parses a residue number of four columns: decimal, or hybrid-36 (`A000` is 10000, `a000` follows `ZZZZ`).
pub(super) fn hybrid36(raw: &[u8]) -> Option<i32> {
    let [first, rest @ ..] = raw else { return None };
    if !first.is_ascii_alphabetic() || raw.len() != 4 {
        return integer(raw);
    }
    let lower = first.is_ascii_lowercase();
    let mut value = 0_i32;
    for (i, b) in std::iter::once(first).chain(rest).enumerate() {
        let digit = match b {
            b'0'..=b'9' if i > 0 => b - b'0',
            b'A'..=b'Z' if !lower => b - b'A' + 10,
            b'a'..=b'z' if lower => b - b'a' + 10,
            _ => return None,
        };
        value = value * 36 + i32::from(digit);
    }
    let cube = 36 * 36 * 36;
    Some(value - 10 * cube + 10_000 + if lower { 26 * cube } else { 0 })
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    fn parse(text: &str) -> Option<f64> {
        let padded = [text.as_bytes(), b" 7.7 5555555555"].concat();
        let fast = real(&padded, 0, text.len());
        // The fast path cannot read beyond the end of the text.
        assert_eq!(fast.map(f64::to_bits), real(text.as_bytes(), 0, text.len()).map(f64::to_bits), "{text}");
        fast
    }

    #[test]
    fn usual_numbers_are_the_nearest_ones() {
        for text in [
            "0.000",
            "-0.000",
            "1",
            "12345678",
            "-1234.567",
            "245.05200",
            "-99999.999",
            "1.",
            ".5",
            "-.5",
            "0.1",
            "999999.99",
            "123456789.5",
            "1234567.89",
            "3.3",
            "1e5",
            "1.5E-3",
            "+1.25",
            "12345678.",
            "0.1234567",
        ] {
            assert_eq!(parse(text), text.parse().ok(), "{text}");
        }
        assert!(parse("-0.000").is_some_and(f64::is_sign_negative));
        assert_eq!(parse("1.234(5)"), Some(1.234));
        assert_eq!(parse("-12(3)"), Some(-12.0));
    }

    #[test]
    fn what_is_no_number_is_none() {
        for text in [
            "", "-", ".", "-.", "1.2.3", "1-2", "--1", "1,5", "nan", "NaN", "inf", "-inf", "Infinity", "1e400",
            "********", "1.0(a)", "1(2", "1.0x", "0x10", "1 2", "1.5:", "1./5", "/.55",
        ] {
            assert_eq!(parse(text), None, "{text}");
        }
    }

    #[test]
    fn integers_and_hybrid_36() {
        assert_eq!(integer(b"-12"), Some(-12));
        assert_eq!(integer(b"2147483647"), Some(i32::MAX));
        assert_eq!(integer(b"2147483648"), None);
        for bad in [&b""[..], b"-", b"1.0", b"a", b"99999999999", b"1 "] {
            assert_eq!(integer(bad), None);
        }
        let cases: [(&[u8], _); 9] = [
            (b"9999", Some(9999)),
            (b"A000", Some(10_000)),
            (b"A001", Some(10_001)),
            (b"ZZZZ", Some(10_000 + 26 * 46_656 - 1)),
            (b"a000", Some(10_000 + 26 * 46_656)),
            (b"-999", Some(-999)),
            (b"Aa00", None),
            (b"****", None),
            (b"A00", None),
        ];
        for (text, value) in cases {
            assert_eq!(hybrid36(text), value);
        }
    }

    proptest::proptest! {
        #[test]
        fn every_fixed_point_number_is_the_nearest(value in -99_999_999_i64..=99_999_999, decimals in 0_usize..=8) {
            let text = format!("{:.*}", decimals, value as f64 / 10_f64.powi(decimals as i32));
            proptest::prop_assert_eq!(parse(&text), text.parse().ok());
        }

        #[test]
        fn any_text_is_read_as_the_general_parser_reads_it(text in "[-+0-9.eE]{0,12}") {
            proptest::prop_assert_eq!(parse(&text), text.parse().ok().filter(|v: &f64| v.is_finite()));
        }
    }
}
