//! The description as a table that answers are compared with: which operations there are, which statuses each may have.
#![allow(dead_code, reason = "every test binary uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::Mutex;

use serde_json::Value;

use crate::http_support::{Reply, send};

/// Methods that a path of the description may have.
const METHODS: [&str; 7] = ["get", "put", "post", "delete", "head", "options", "patch"];

/// An operation: `GET /v1/…`.
pub(crate) type Operation = String;

/// The operations of a description, with the responses of each by status.
pub(crate) fn operations(description: &Value) -> BTreeMap<Operation, BTreeMap<u16, Value>> {
    let mut found = BTreeMap::new();
    for (path, item) in description["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap().iter().filter(|(m, _)| METHODS.contains(&m.as_str())) {
            let responses = operation["responses"].as_object().unwrap();
            let responses = responses.iter().map(|(status, r)| (status.parse().unwrap(), r.clone())).collect();
            found.insert(format!("{} {path}", method.to_uppercase()), responses);
        }
    }
    found
}

/// Whether `path` is one of `template`'s.
fn matches(template: &str, path: &str) -> bool {
    let (mut ours, mut theirs) = (template.split('/'), path.split('/'));
    loop {
        match (ours.next(), theirs.next()) {
            (None, None) => return true,
            (Some(a), Some(b)) if a == b || (a.starts_with('{') && !b.is_empty()) => {}
            _ => return false,
        }
    }
}

/// What was seen of a description.
pub(crate) struct Seen {
    described: BTreeMap<Operation, BTreeMap<u16, Value>>,
    seen: Mutex<BTreeSet<(Operation, u16)>>,
}

impl Seen {
    pub(crate) fn of(description: &Value) -> Self {
        Self { described: operations(description), seen: Mutex::default() }
    }

    /// The operation of a request, if it is described.
    fn operation(&self, method: &str, path: &str) -> Option<Operation> {
        let path = path.split('?').next().unwrap();
        let is = |operation: &&Operation| {
            operation.split_once(' ').is_some_and(|(m, template)| m == method && matches(template, path))
        };
        self.described.keys().find(is).cloned()
    }

    /// Notes an answer, and says what of it is not described.
    pub(crate) fn note(&self, method: &str, path: &str, reply: &Reply) -> Result<(), String> {
        let operation = self.operation(method, path).ok_or_else(|| format!("{method} {path} is not described"))?;
        let status = reply.status;
        let described = self.described[&operation].get(&status);
        let described =
            described.ok_or_else(|| format!("{operation}: {status} is not described: {:?}", reply.body()))?;
        self.seen.lock().unwrap().insert((operation.clone(), status));
        let Some(content) = described["content"].as_object() else {
            return if reply.body.is_empty() { Ok(()) } else { Err(format!("{operation}: {status} has a body")) };
        };
        let media_type = reply.header("content-type").unwrap_or_default();
        let described = content.get(media_type);
        let schema = &described.ok_or_else(|| format!("{operation}: {status} is no {media_type}"))?["schema"];
        if media_type == "application/problem+json" {
            let (types, found) = (&schema["allOf"][1]["properties"]["type"]["enum"], &reply.json()["type"]);
            if !types.as_array().unwrap().contains(found) {
                return Err(format!("{operation}: {status} is {found}, not one of {types}"));
            }
        }
        for (name, _) in reply.headers.iter().filter(|(name, _)| name.starts_with("molmesh-")) {
            if status < 300 && self.described[&operation][&status]["headers"].get(name).is_none() {
                return Err(format!("{operation}: {status} has a header {name} that is not described"));
            }
        }
        Ok(())
    }

    /// What is described and was never seen.
    pub(crate) fn unseen(&self) -> Vec<String> {
        let seen = self.seen.lock().unwrap();
        let all = self
            .described
            .iter()
            .flat_map(|(operation, responses)| responses.keys().map(move |status| (operation.clone(), *status)));
        all.filter(|pair| !seen.contains(pair)).map(|(operation, status)| format!("{operation}: {status}")).collect()
    }

    /// Sends a request and notes the answer.
    #[track_caller]
    pub(crate) fn ask(
        &self,
        addr: SocketAddr,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: &[u8],
    ) -> Reply {
        let reply = send(addr, method, path, headers, body);
        self.note(method, path, &reply).unwrap_or_else(|wrong| panic!("{wrong}"));
        reply
    }

    /// The same, with the status that is expected.
    #[track_caller]
    pub(crate) fn expect(
        &self,
        status: u16,
        addr: SocketAddr,
        (method, path): (&str, &str),
        headers: &[(&str, &str)],
        body: &[u8],
    ) -> Reply {
        let reply = self.ask(addr, method, path, headers, body);
        assert_eq!(reply.status, status, "{method} {path}: {}", String::from_utf8_lossy(&reply.body));
        reply
    }

    /// The described operations.
    pub(crate) fn described(&self) -> impl Iterator<Item = (&str, &str)> {
        self.described.keys().map(|operation| operation.split_once(' ').unwrap())
    }
}

impl Reply {
    /// The body as text, for messages.
    fn body(&self) -> String {
        String::from_utf8_lossy(&self.body[..self.body.len().min(400)]).into_owned()
    }
}
