//! Unit tests of the MessagePack reader.

use super::*;

fn token(bytes: &[u8]) -> PackToken<'_> {
    let mut cursor = Cursor::new(bytes);
    let token = cursor.next().unwrap();
    assert_eq!(cursor.at, bytes.len(), "{bytes:x?}");
    token
}

fn refusal(bytes: &[u8]) -> String {
    let fault = Cursor::new(bytes).skip().unwrap_err();
    super::super::super::error::StructureError::from(fault).to_string()
}

/// Covers every first byte in the table of the specification.
#[test]
fn every_form_of_every_value() {
    let cases: [(&[u8], PackToken<'_>); 29] = [
        (b"\xc0", PackToken::Nil),
        (b"\xc2", PackToken::Bool(false)),
        (b"\xc3", PackToken::Bool(true)),
        (b"\x7f", PackToken::Integer(127)),
        (b"\xe0", PackToken::Integer(-32)),
        (b"\xff", PackToken::Integer(-1)),
        (b"\xcc\xff", PackToken::Integer(255)),
        (b"\xcd\x01\x00", PackToken::Integer(256)),
        (b"\xce\xff\xff\xff\xff", PackToken::Integer(4_294_967_295)),
        (b"\xcf\0\0\0\x01\0\0\0\0", PackToken::Integer(1 << 32)),
        (b"\xcf\x80\0\0\0\0\0\0\0", PackToken::Real(9_223_372_036_854_775_808.0)),
        (b"\xd0\x80", PackToken::Integer(-128)),
        (b"\xd1\x80\0", PackToken::Integer(-32768)),
        (b"\xd2\x80\0\0\0", PackToken::Integer(-2_147_483_648)),
        (b"\xd3\xff\xff\xff\xff\xff\xff\xff\xfe", PackToken::Integer(-2)),
        (b"\xca\x3f\xc0\0\0", PackToken::Real(1.5)),
        (b"\xcb\xc0\x04\0\0\0\0\0\0", PackToken::Real(-2.5)),
        (b"\xa2ab", PackToken::Text(b"ab")),
        (b"\xd9\x01a", PackToken::Text(b"a")),
        (b"\xda\0\x01a", PackToken::Text(b"a")),
        (b"\xdb\0\0\0\x01a", PackToken::Text(b"a")),
        (b"\xc4\x02\0\x01", PackToken::Bytes(&[0, 1])),
        (b"\xc5\0\x01\x07", PackToken::Bytes(&[7])),
        (b"\xc6\0\0\0\x01\x07", PackToken::Bytes(&[7])),
        (b"\x90", PackToken::Array(0)),
        (b"\x80", PackToken::Map(0)),
        (b"\xd5\x01ab", PackToken::Extension),
        (b"\xc7\x03\x01abc", PackToken::Extension),
        (b"\xc8\0\x01\x01a", PackToken::Extension),
    ];
    for (bytes, expected) in cases {
        assert_eq!(token(bytes), expected, "{bytes:x?}");
        // A truncated value is an error at every length.
        for cut in 0..bytes.len() {
            assert!(refusal(&bytes[..cut]).contains("the end of the file"), "{bytes:x?} cut at {cut}");
        }
    }
    assert!(refusal(b"\xc1").starts_with("byte 0: found c1"));
}

#[test]
fn lengths_that_lie_are_refused_before_anything_is_made_of_them() {
    for lie in [&b"\xdf\xff\xff\xff\xff"[..], b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff"]
    {
        assert!(refusal(lie).starts_with("byte 5: found the end of the file after 0 bytes"), "{}", refusal(lie));
    }
    assert_eq!(
        refusal(b"\xde\x00\x02\xc0"),
        "byte 3: found the end of the file after 1 bytes, expected 4 bytes or more"
    );
}

#[test]
fn depth_costs_nothing() {
    let deep = [&[0x91; 2_000_000][..], &[0xc0]].concat();
    let mut cursor = Cursor::new(&deep);
    cursor.skip().unwrap();
    assert_eq!(cursor.at, deep.len());
    assert!(refusal(&deep[..deep.len() - 1]).starts_with("byte 2000000"));
}

#[test]
fn maps_and_arrays_give_positions() {
    let bytes = b"\x82\xa1a\x93\x01\x02\x03\xa1b\x81\xa1c\xc0";
    let mut seen = Vec::new();
    let mut cursor = Cursor::new(bytes);
    cursor
        .map(|key, value| {
            if key == b"a" {
                value.array(|i, item| {
                    seen.push((i, item.whole::<u32>("a number")?));
                    Ok(())
                })?;
            }
            Ok(())
        })
        .unwrap();
    assert_eq!((seen, cursor.at), (vec![(0, 1), (1, 2), (2, 3)], bytes.len()));
    let not_text = Cursor::new(b"\x81\x01\x02").map(|_, _| Ok(())).unwrap_err();
    assert_eq!(not_text, Fault::new("1", "a text"));
}

#[test]
fn whole_numbers_may_be_written_as_real_ones() {
    assert_eq!(Cursor::new(b"\xcb\x40\x08\0\0\0\0\0\0").whole::<u32>("a count").unwrap(), 3);
    for bad in
        [&b"\xcb\x40\x04\0\0\0\0\0\0"[..], b"\xff", b"\xcb\x7f\xf8\0\0\0\0\0\0", b"\xa11", b"\xcb\x7f\xf0\0\0\0\0\0\0"]
    {
        Cursor::new(bad).whole::<u32>("a count").unwrap_err();
    }
    for bad in [&b"\xcb\x7f\xf8\0\0\0\0\0\0"[..], b"\xcb\x7f\xf0\0\0\0\0\0\0", b"\xc0"] {
        Cursor::new(bad).number().unwrap_err();
    }
}
