//! A place in a trace, as W3C Trace Context writes it: `traceparent` and `tracestate`.

use std::collections::HashSet;
use std::fmt;
use std::hash::{BuildHasher as _, RandomState};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, LazyLock};

/// Members of a `tracestate` at most, by the standard.
const MAX_MEMBERS: usize = 32;
/// Characters of a `tracestate` that are passed on at most: the number that the standard asks for at least.
const MAX_STATE: usize = 512;
/// Members longer than this go first where it is too long.
const LONG_MEMBER: usize = 128;
/// The flag that says that spans are recorded.
const SAMPLED: u8 = 1;

/// Which span of which trace, whether it is recorded, and what vendors on the way have added.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TraceContext {
    trace: u128,
    span: u64,
    sampled: bool,
    state: Option<Arc<str>>,
}

impl TraceContext {
    /// Reads the headers of a request: each `traceparent` and each `tracestate` that it has. None unless there is one
    /// `traceparent` and it is right to the letter. A `tracestate` that is not is left out.
    #[must_use]
    pub fn read<'a>(
        parents: impl IntoIterator<Item = &'a [u8]>,
        states: impl IntoIterator<Item = &'a [u8]>,
    ) -> Option<Self> {
        let mut parents = parents.into_iter();
        let (parent, None) = (parents.next()?, parents.next()) else { return None };
        let mut context = Self::parse(parent)?;
        context.state = state(states);
        Some(context)
    }

    /// Reads a `traceparent`: `00-`, 32 hexadecimal digits, `-`, 16, `-`, 2, in lower case; ids are not zero. What later
    /// versions append is not looked at.
    fn parse(text: &[u8]) -> Option<Self> {
        let dashes = [2, 35, 52].iter().all(|at| text.get(*at) == Some(&b'-'));
        let version = hex(text.get(..2)?)?;
        let ends = match version {
            0 => text.len() == 55,
            0xff => false,
            _ => text.len() == 55 || text.get(55) == Some(&b'-'),
        };
        if !dashes || !ends {
            return None;
        }
        let trace = hex(&text[3..35]).filter(|id| *id != 0)?;
        let span = hex(&text[36..52]).and_then(|id| u64::try_from(id).ok()).filter(|id| *id != 0)?;
        let flags = u8::try_from(hex(&text[53..55])?).ok()?;
        Some(Self { trace, span, sampled: flags & SAMPLED != 0, state: None })
    }

    /// The first span of a new trace. `sample` decides by the trace's id whether it is recorded.
    pub(super) fn root(sample: impl FnOnce(u128) -> bool) -> Self {
        let trace = (u128::from(random()) << 64) | u128::from(random());
        Self { trace, span: random(), sampled: sample(trace), state: None }
    }

    /// A new span below this one.
    pub(super) fn child(&self) -> Self {
        Self { span: random(), ..self.clone() }
    }

    /// The trace's id.
    #[must_use]
    pub fn trace(&self) -> u128 {
        self.trace
    }

    /// The span's id.
    #[must_use]
    pub fn span(&self) -> u64 {
        self.span
    }

    /// Whether whoever is above records spans, or wants them recorded.
    #[must_use]
    pub fn is_sampled(&self) -> bool {
        self.sampled
    }

    /// The value of `tracestate`.
    #[must_use]
    pub fn tracestate(&self) -> Option<&str> {
        self.state.as_deref()
    }
}

impl fmt::Display for TraceContext {
    /// The value of `traceparent`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "00-{:032x}-{:016x}-{:02x}", self.trace, self.span, u8::from(self.sampled) * SAMPLED)
    }
}

/// Hexadecimal digits in lower case.
fn hex(digits: &[u8]) -> Option<u128> {
    digits.iter().try_fold(0, |value, digit| {
        let digit = match digit {
            b'0'..=b'9' => digit - b'0',
            b'a'..=b'f' => digit - b'a' + 10,
            _ => return None,
        };
        Some(value << 4 | u128::from(digit))
    })
}

/// A random number that is not zero. The standard library's hash keys are random, which is all that an id needs.
fn random() -> u64 {
    static KEYS: LazyLock<RandomState> = LazyLock::new(RandomState::new);
    static NEXT: AtomicU64 = AtomicU64::new(0);
    KEYS.hash_one(NEXT.fetch_add(1, Ordering::Relaxed)).max(1)
}

/// The members of all `tracestate` headers in one list. None if there is none, or if any is not as the standard wants it.
fn state<'a>(headers: impl IntoIterator<Item = &'a [u8]>) -> Option<Arc<str>> {
    let (mut members, mut keys) = (Vec::new(), HashSet::new());
    for header in headers {
        for member in std::str::from_utf8(header).ok()?.split(',') {
            let member = member.trim_matches([' ', '\t']);
            if member.is_empty() {
                continue;
            }
            let (key, value) = member.split_once('=')?;
            if !is_key(key) || !is_value(value) || !keys.insert(key) || members.len() == MAX_MEMBERS {
                return None;
            }
            members.push(member);
        }
    }
    let length = |members: &[&str]| members.iter().map(|member| member.len() + 1).sum::<usize>().saturating_sub(1);
    while length(&members) > MAX_STATE {
        let long = members.iter().rposition(|member| member.len() > LONG_MEMBER);
        members.remove(long.unwrap_or(members.len() - 1));
    }
    (!members.is_empty()).then(|| members.join(",").into())
}

/// A vendor's key: `name`, or `tenant@system`.
fn is_key(key: &str) -> bool {
    let rest = |text: &str| text.bytes().all(|b| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'_' | b'-' | b'*' | b'/'));
    let letter = |text: &str| text.starts_with(|c: char| c.is_ascii_lowercase());
    match key.split_once('@') {
        None => letter(key) && rest(key) && key.len() <= 256,
        Some((tenant, system)) => {
            let begins = letter(tenant) || tenant.starts_with(|c: char| c.is_ascii_digit());
            begins && rest(tenant) && tenant.len() <= 241 && letter(system) && rest(system) && system.len() <= 14
        }
    }
}

/// A vendor's value: visible characters and blanks but `,` and `=`, no blank at its end.
fn is_value(value: &str) -> bool {
    (1..=256).contains(&value.len())
        && value.bytes().all(|b| matches!(b, b' '..=b'~') && b != b',' && b != b'=')
        && !value.ends_with(' ')
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";

    fn read(parent: &str, states: &[&str]) -> Option<TraceContext> {
        TraceContext::read([parent.as_bytes()], states.iter().map(|state| state.as_bytes()))
    }

    #[test]
    fn a_traceparent_is_read_to_the_letter() {
        let context = read(GOOD, &[]).unwrap();
        assert_eq!(
            (context.trace(), context.span()),
            (0x0af7_6519_16cd_43dd_8448_eb21_1c80_319c, 0xb7ad_6b71_6920_3331)
        );
        assert!(context.is_sampled() && context.to_string() == GOOD);
        let child = context.child();
        assert_eq!((child.trace(), child.is_sampled()), (context.trace(), true));
        assert_ne!(child.span(), context.span());
        // Flags that nobody has defined yet are not passed on.
        assert!(read(&GOOD.replace("-01", "-ff"), &[]).unwrap().to_string().ends_with("-01"));
        assert!(!read(&GOOD.replace("-01", "-fe"), &[]).unwrap().is_sampled());
        // Later versions may append.
        for later in ["cc-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01", &format!("01{}-what-else", &GOOD[2..])]
        {
            assert!(read(later, &[]).is_some_and(|c| c.to_string() == GOOD), "{later}");
        }
    }

    #[test]
    fn what_is_no_traceparent_is_none() {
        for bad in [
            "",
            "00",
            "ff-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01-",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01-x",
            "01-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01x",
            "01-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-0",
            "00-0AF7651916CD43DD8448EB211C80319C-b7ad6b7169203331-01",
            "00-00000000000000000000000000000000-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-0000000000000000-01",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-0g",
            "00_0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "0x-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319-b7ad6b71692033311-01",
            " 00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
        ] {
            assert_eq!(read(bad, &["a=b"]), None, "{bad}");
        }
        assert_eq!(TraceContext::read([GOOD.as_bytes(), GOOD.as_bytes()], []), None);
        assert_eq!(TraceContext::read([], [&b"a=b"[..]]), None);
    }

    #[test]
    fn a_tracestate_is_passed_on_or_left_out_as_a_whole() {
        let state = |states: &[&str]| read(GOOD, states).unwrap().tracestate().map(str::to_owned);
        for (states, passed) in [
            (&["rojo=00f067aa0ba902b7,congo=t61rcWkgMzE"][..], Some("rojo=00f067aa0ba902b7,congo=t61rcWkgMzE")),
            (&["a=1 , b=2,", ", c=3"], Some("a=1,b=2,c=3")),
            (&["0tenant@system=x y"], Some("0tenant@system=x y")),
            (&["a=1,a=2"], None),
            (&["a=1", "a=2"], None),
            (&["A=1"], None),
            (&["1a=1"], None),
            (&["a@1b=1"], None),
            (&["a@b@c=1"], None),
            (&["a="], None),
            (&["a"], None),
            (&["a=b=c"], None),
            (&["a=\u{e4}"], None),
            (&["", ","], None),
        ] {
            assert_eq!(state(states).as_deref(), passed, "{states:?}");
        }
        let many = |n: usize| (0..n).map(|n| format!("k{n}=v")).collect::<Vec<_>>().join(",");
        assert_eq!(state(&[&many(32)]), Some(many(32)));
        assert_eq!(state(&[&many(33)]), None);
        // Too long: long members go first, then the last ones.
        let long = format!("a={},b=1,c={}", "x".repeat(250), "y".repeat(256));
        assert_eq!(state(&[&long]), Some(format!("a={},b=1", "x".repeat(250))));
        let short = (0..30).map(|n| format!("k{n:02}={}", "v".repeat(20))).collect::<Vec<_>>();
        assert_eq!(state(&[&short.join(",")]), Some(short[..20].join(",")));
        assert_eq!(state(&[&format!("{}=1", "k".repeat(257))]), None);
        assert_eq!(state(&[&format!("a={}", "v".repeat(257))]), None);
    }

    #[test]
    fn new_traces_are_random_and_never_zero() {
        let roots: HashSet<u128> = (0..1000).map(|_| TraceContext::root(|_| true).trace()).collect();
        assert_eq!(roots.len(), 1000);
        let root = TraceContext::root(|_| false);
        assert!(root.span() != 0 && !root.is_sampled());
        assert_eq!(read(&root.to_string(), &[]), Some(root));
    }
}
