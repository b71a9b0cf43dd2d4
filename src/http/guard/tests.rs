//! Unit tests of the guard.

use super::*;

#[test]
fn a_request_without_a_recorded_scope_is_not_open() {
    let mut request = Request::default();
    assert_eq!(RequiredScope::of(&request), Some(Scope::Mesh));
    request.extensions_mut().insert(RequiredScope(None));
    assert_eq!(RequiredScope::of(&request), None);
}

#[test]
fn equal_keys_in_two_headers_are_accepted_and_different_ones_rejected() {
    let text = |pairs: &[(&'static str, &'static str)]| {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(HeaderName::from_static(name), HeaderValue::from_static(value));
        }
        match presented(&headers) {
            Presented::Nothing => None,
            Presented::Text(text) => Some(text),
            Presented::Nonsense => Some("nonsense".to_owned()),
        }
    };
    let (auth, key) = ("authorization", "x-api-key");
    for (pairs, expected) in [
        (&[][..], None),
        (&[(auth, "Bearer abc")], Some("abc")),
        (&[(auth, "bearer   abc ")], Some("abc")),
        (&[(auth, "Basic abc")], None),
        (&[(auth, "Bearer")], None),
        (&[(key, "abc")], Some("abc")),
        (&[(auth, "Basic abc"), (key, "abc")], Some("abc")),
        (&[(auth, "Bearer abc"), (key, "abc")], Some("abc")),
        (&[(auth, "Bearer abc"), (key, "abd")], Some("nonsense")),
        (&[(key, "abc"), (key, "abd")], Some("nonsense")),
    ] {
        assert_eq!(text(pairs).as_deref(), expected, "{pairs:?}");
    }
    let no_text = HeaderMap::from_iter([(API_KEY, HeaderValue::from_bytes(b"\xff").unwrap())]);
    assert!(matches!(presented(&no_text), Presented::Nonsense));
}

#[test]
fn addresses_are_clients_by_network() {
    for (address, name) in
        [("192.0.2.1", "192.0.2.1"), ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"), ("::1", "0:0:0:0::/64")]
    {
        assert_eq!(client_name(address.parse().unwrap()), name);
    }
}

#[test]
fn caching_ends_with_the_signature() {
    for (value, limited) in [
        ("private, max-age=31536000, immutable", "private, max-age=60"),
        ("private, max-age=5", "private, max-age=5"),
        ("private, max-age=86400, stale-while-revalidate=604800", "private, max-age=60"),
        ("private, no-cache", "private, no-cache"),
        ("no-store", "no-store"),
    ] {
        assert_eq!(cached_for(value, 60), limited);
    }
}

#[test]
fn public_responses_become_private() {
    for (value, private) in [
        ("public, max-age=5, immutable", "private, max-age=5, immutable"),
        ("no-store", "no-store"),
        ("public, no-cache", "private, no-cache"),
    ] {
        let mut headers = HeaderMap::from_iter([(header::CACHE_CONTROL, HeaderValue::from_static(value))]);
        keep_private(&mut headers);
        assert_eq!(headers[header::CACHE_CONTROL], private);
    }
}
