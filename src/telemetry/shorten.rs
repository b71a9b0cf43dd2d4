//! Shortened ids for logs and traces.

/// Length from which a run of hexadecimal digits is an id or a digest, which gives access to what it names.
const ID_DIGITS: usize = 32;
/// Digits that are kept.
const KEPT: usize = 8;

/// Replaces all but the first digits of each id and digest in `text` by `…`.
pub(crate) fn shorten(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let run = rest.bytes().take_while(u8::is_ascii_hexdigit).count();
        let taken = run.max(first.len_utf8());
        out.push_str(&rest[..if run >= ID_DIGITS { KEPT } else { taken }]);
        if run >= ID_DIGITS {
            out.push('…');
        }
        rest = &rest[taken..];
    }
    out
}

#[cfg(test)]
mod tests {
    use super::shorten;

    #[test]
    fn ids_and_digests_are_cut() {
        let (id, digest) = ("0123456789abcdef".repeat(2), "0123456789ABCDEF".repeat(4));
        for (text, short) in [
            (format!("/v1/jobs/{id}/events"), "/v1/jobs/01234567…/events"),
            (format!("/v1/results/{digest}.glb"), "/v1/results/01234567….glb"),
            (format!("{id}é{id}"), "01234567…é01234567…"),
            ("/v1/pdb/4pti/surface.glb".to_owned(), "/v1/pdb/4pti/surface.glb"),
            ("0123456789abcdef0123456789abcde".to_owned(), "0123456789abcdef0123456789abcde"),
            (String::new(), ""),
        ] {
            assert_eq!(shorten(&text), short);
        }
    }
}
