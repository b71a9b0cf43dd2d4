//! Targets: plain functions over bytes that panic if a property is violated.

mod http;
mod map;
mod structure;
mod text;

use molmesh::pipeline::params;

use crate::engine::Target;

/// All targets. The name of a target is also the folder of its seeds.
pub(crate) const TARGETS: &[Target] = &[
    Target { name: "pdb", run: structure::mesh, max_memory: 64 << 20, words: || owned(structure::PDB) },
    Target { name: "mmcif", run: structure::mesh, max_memory: 64 << 20, words: || owned(structure::MMCIF) },
    Target { name: "binarycif", run: structure::mesh, max_memory: 64 << 20, words: || owned(structure::BINARYCIF) },
    Target { name: "pqr", run: structure::mesh, max_memory: 64 << 20, words: || owned(structure::PQR) },
    Target { name: "xyz", run: structure::mesh, max_memory: 64 << 20, words: || owned(structure::XYZ) },
    Target { name: "map", run: map::sample, max_memory: 16 << 20, words: || owned(map::WORDS) },
    Target {
        name: "parameters",
        run: text::parameters,
        max_memory: 4 << 20,
        words: || with_parameters(text::PARAMETERS),
    },
    Target { name: "config", run: text::config, max_memory: 8 << 20, words: text::config_words },
    Target { name: "key_file", run: text::key_file, max_memory: 8 << 20, words: || owned(text::KEY_FILE) },
    Target { name: "signature", run: text::signature, max_memory: 8 << 20, words: || owned(text::SIGNATURE) },
    Target { name: "forwarded", run: text::forwarded, max_memory: 8 << 20, words: || owned(text::FORWARDED) },
    Target { name: "record", run: text::record, max_memory: 8 << 20, words: || with_parameters(text::RECORD) },
    Target { name: "archive_copy", run: text::archive_copy, max_memory: 8 << 20, words: || owned(text::ARCHIVE_COPY) },
    Target { name: "http", run: http::request, max_memory: 128 << 20, words: || with_parameters(http::WORDS) },
];

fn owned(words: &[&str]) -> Vec<String> {
    words.iter().map(|word| (*word).to_owned()).collect()
}

/// Adds the names of all parameters, and their values that are words.
fn with_parameters(words: &[&str]) -> Vec<String> {
    let mut words = owned(words);
    for parameter in params::TABLE {
        words.push(format!("{}=", parameter.name));
        if let params::Domain::Choice(values) = parameter.domain {
            words.extend(values.iter().map(|value| (*value).to_owned()));
        }
    }
    words
}

/// Asserts that an error message is short, so that a client or a log cannot be flooded with its own input.
fn assert_short(message: &str) {
    assert!(message.len() <= 4096, "a message of {} bytes: {message:.200}", message.len());
}
