//! Table of the documented operations and statuses, for comparison with the responses of a server.
#![allow(dead_code, reason = "every test binary uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::Mutex;

use serde_json::Value;

use crate::http_support::{Reply, send};

/// Methods of a documented path.
const METHODS: [&str; 7] = ["get", "put", "post", "delete", "head", "options", "patch"];

/// Operation: `GET /v1/…`.
pub(crate) type Operation = String;

/// Follows a reference into `components`; any other value is returned as it is.
pub(crate) fn resolved<'a>(description: &'a Value, value: &'a Value) -> &'a Value {
    value["$ref"].as_str().map_or(value, |at| description.pointer(&at[1..]).unwrap_or_else(|| panic!("no {at}")))
}

/// Returns the operations of an OpenAPI document with their responses by status.
pub(crate) fn operations(description: &Value) -> BTreeMap<Operation, BTreeMap<u16, Value>> {
    let mut found = BTreeMap::new();
    for (path, item) in description["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap().iter().filter(|(m, _)| METHODS.contains(&m.as_str())) {
            let responses = operation["responses"].as_object().unwrap();
            let responses =
                responses.iter().map(|(status, r)| (status.parse().unwrap(), resolved(description, r).clone()));
            let responses = responses.collect();
            found.insert(format!("{} {path}", method.to_uppercase()), responses);
        }
    }
    found
}

/// Returns true if `path` matches `template`.
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

/// Records which documented responses were seen.
pub(crate) struct Seen {
    described: BTreeMap<Operation, BTreeMap<u16, Value>>,
    seen: Mutex<BTreeSet<(Operation, u16)>>,
}

impl Seen {
    pub(crate) fn of(description: &Value) -> Self {
        Self { described: operations(description), seen: Mutex::default() }
    }

    /// Returns the operation of a request, if it is documented.
    fn operation(&self, method: &str, path: &str) -> Option<Operation> {
        let path = path.split('?').next().unwrap();
        let is = |operation: &&Operation| {
            operation.split_once(' ').is_some_and(|(m, template)| m == method && matches(template, path))
        };
        self.described.keys().find(is).cloned()
    }

    /// Records a response. Fails if a part of it is not documented.
    pub(crate) fn note(&self, method: &str, path: &str, reply: &Reply) -> Result<(), String> {
        let operation = self.operation(method, path).ok_or_else(|| format!("{method} {path} is not documented"))?;
        let status = reply.status;
        let described = self.described[&operation].get(&status);
        let described =
            described.ok_or_else(|| format!("{operation}: {status} is not documented: {:?}", reply.body()))?;
        self.seen.lock().unwrap().insert((operation.clone(), status));
        let Some(content) = described["content"].as_object() else {
            return if reply.body.is_empty() { Ok(()) } else { Err(format!("{operation}: {status} has a body")) };
        };
        let media_type = reply.header("content-type").unwrap_or_default();
        let range = format!("{}/*", media_type.split('/').next().unwrap());
        if !content.contains_key(media_type) && !content.contains_key(&range) {
            return Err(format!("{operation}: {status} must not have the media type {media_type}"));
        }
        if media_type == "application/problem+json" {
            let (types, found) = (described["description"].as_str().unwrap(), reply.json()["type"].clone());
            let slug = found.as_str().and_then(|found| found.strip_prefix("/problems/")).unwrap_or_default();
            if !types.contains(&format!("`{slug}`")) {
                return Err(format!("{operation}: {status} is {found}, not one of {types}"));
            }
        }
        for (name, _) in reply.headers.iter().filter(|(name, _)| name.starts_with("molmesh-")) {
            // The document lists these headers for status 200; a part of a file has them too.
            let whole = if status == 206 { 200 } else { status };
            if status < 300 && self.described[&operation][&whole]["headers"].get(name).is_none() {
                return Err(format!("{operation}: {status} has a header {name} that is not documented"));
            }
        }
        Ok(())
    }

    /// Returns the documented responses that were never seen.
    pub(crate) fn unseen(&self) -> Vec<String> {
        let seen = self.seen.lock().unwrap();
        let all = self
            .described
            .iter()
            .flat_map(|(operation, responses)| responses.keys().map(move |status| (operation.clone(), *status)));
        all.filter(|pair| !seen.contains(pair)).map(|(operation, status)| format!("{operation}: {status}")).collect()
    }

    /// Sends a request and records the response.
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

    /// Sends a request, records the response and checks its status.
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

    /// Returns the documented operations.
    pub(crate) fn described(&self) -> impl Iterator<Item = (&str, &str)> {
        self.described.keys().map(|operation| operation.split_once(' ').unwrap())
    }
}

impl Reply {
    /// Returns the start of the body as text, for messages.
    fn body(&self) -> String {
        String::from_utf8_lossy(&self.body[..self.body.len().min(400)]).into_owned()
    }
}
