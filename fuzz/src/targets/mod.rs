//! Targets: plain functions over bytes that panic if a property is violated.

mod http;
mod structure;
mod text;

use crate::engine::Target;

/// All targets. The name of a target is also the folder of its seeds.
pub(crate) const TARGETS: &[Target] = &[
    Target { name: "pdb", run: structure::mesh, max_memory: 64 << 20, words: structure::PDB },
    Target { name: "mmcif", run: structure::mesh, max_memory: 64 << 20, words: structure::MMCIF },
    Target { name: "binarycif", run: structure::mesh, max_memory: 64 << 20, words: structure::BINARYCIF },
    Target { name: "parameters", run: text::parameters, max_memory: 4 << 20, words: text::PARAMETERS },
    Target { name: "config", run: text::config, max_memory: 8 << 20, words: text::CONFIG },
    Target { name: "key_file", run: text::key_file, max_memory: 8 << 20, words: text::KEY_FILE },
    Target { name: "signature", run: text::signature, max_memory: 8 << 20, words: text::SIGNATURE },
    Target { name: "record", run: text::record, max_memory: 8 << 20, words: text::RECORD },
    Target { name: "archive_copy", run: text::archive_copy, max_memory: 8 << 20, words: text::ARCHIVE_COPY },
    Target { name: "http", run: http::request, max_memory: 128 << 20, words: http::WORDS },
];

/// Asserts that an error message is short, so that a client or a log cannot be flooded with its own input.
fn assert_short(message: &str) {
    assert!(message.len() <= 4096, "a message of {} bytes: {message:.200}", message.len());
}
