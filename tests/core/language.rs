//! Checks of the language in all files: the first words and the length of comments, the length of lines of Markdown,
//! retired words, and the options of example commands. Every checker has a negative control.

use std::path::Path;

use crate::architecture::{CODE, Source, assert_none, files, source};

/// Extensions of files with comments.
const COMMENTED: &[&str] = &["rs", "ts", "mjs", "py", "sh", "toml", "wgsl"];

/// Limit for the columns of prose and comments.
const MAX_COLUMNS: usize = 120;

/// Folders and files besides [`CODE`] with scripts, pages and settings.
const MORE: &[&str] = &[
    ".ci",
    "Cargo.toml",
    "clippy.toml",
    "deny.toml",
    "deploy",
    "docs",
    "molmesh.example.toml",
    "rustfmt.toml",
    "web/measure.mjs",
    "web/pack.mjs",
    "web/build.sh",
    "web/src",
    "web/client/src",
    "web/client/generate.mjs",
];

/// Words with which no comment begins.
const QUESTION_WORDS: [&str; 9] = ["What", "How", "Whether", "Where", "Who", "Whose", "When", "Which", "Why"];

/// Retired words, each with the word before it that makes a technical term. An empty word stands for none.
const RETIRED: &[(&str, &str)] = &[
    ("anew", ""),
    ("crew", ""),
    ("crews", ""),
    ("flight", "in"),
    ("flight", "single"),
    ("keeper", ""),
    ("keepers", ""),
    ("landing", ""),
    ("landings", ""),
    ("ledger", ""),
    ("patience", ""),
    ("pour", ""),
    ("poured", ""),
    ("promise", ""),
    ("promised", ""),
    ("promises", ""),
    ("proven", ""),
    ("referee", ""),
    ("seat", ""),
    ("seats", ""),
    ("victim", ""),
    ("victims", ""),
    ("whatever", ""),
    ("wherever", ""),
    ("whoever", ""),
    ("wish", ""),
    ("wished", ""),
    ("wishes", ""),
];

/// Files that list retired words.
const WORD_LISTS: &[&str] = &["tests/core/architecture.rs", "tests/core/language.rs"];

/// Returns the files with one of the `extensions`.
fn all(extensions: &[&str]) -> Vec<Source> {
    files(&[CODE, MORE].concat(), extensions)
}

fn extension(source: &Source) -> &str {
    Path::new(&source.path).extension().and_then(|e| e.to_str()).unwrap_or_default()
}

/// Line of a comment.
struct CommentLine<'a> {
    /// Line number, from 1.
    number: usize,
    line: &'a str,
    /// The text without its marker.
    text: &'a str,
    /// True for the first line with text of a comment that documents an item. In Rust, ordinary comments do not.
    is_summary: bool,
}

/// Returns the lines that are comments: `//` in Rust, `//` and `/*` in TypeScript, JavaScript and WGSL, `#` in Python,
/// shell and TOML, and the docstrings of Python.
fn comment_lines(source: &Source) -> Vec<CommentLine<'_>> {
    let (is_rust, is_python) = (extension(source) == "rs", extension(source) == "py");
    let markers: &[&str] = match extension(source) {
        "rs" => &["////", "///", "//!", "//"],
        "py" | "sh" | "toml" => &["#"],
        _ => &["/**", "/*", "*", "//"],
    };
    let mut found = Vec::new();
    let mut in_docstring = false;
    // Marker of the current comment, and true once it has text.
    let (mut current, mut has_summary) = ("", false);
    for (i, line) in source.text.lines().enumerate() {
        let start = line.trim_start();
        let quotes = if is_python { start.matches("\"\"\"").count() } else { 0 };
        let marked = if in_docstring {
            Some((current, start))
        } else if quotes > 0 && start.starts_with("\"\"\"") {
            current = "";
            Some(("\"\"\"", &start[3..]))
        } else if start.starts_with("#!") {
            None
        } else {
            markers.iter().find_map(|marker| Some((*marker, start.strip_prefix(marker)?)))
        };
        in_docstring ^= quotes % 2 == 1;
        let Some((marker, text)) = marked else {
            current = "";
            continue;
        };
        if marker.starts_with("/*") || (marker != current && marker != "*") {
            (current, has_summary) = (marker, false);
        }
        let has_text = text.contains(char::is_alphanumeric);
        let documents = !is_rust || ["///", "//!"].contains(&marker);
        found.push(CommentLine { number: i + 1, line, text, is_summary: has_text && documents && !has_summary });
        has_summary |= has_text;
    }
    found
}

/// Returns comments that begin with a question word.
fn questions(sources: &[Source]) -> Vec<String> {
    let first_word = |text: &str| -> String {
        text.chars().skip_while(|c| !c.is_alphanumeric()).take_while(|c| c.is_alphabetic()).collect()
    };
    let mut found = Vec::new();
    for source in sources {
        for comment in comment_lines(source).iter().filter(|comment| comment.is_summary) {
            let word = first_word(comment.text);
            if QUESTION_WORDS.contains(&word.as_str()) {
                found.push(format!("{}:{}: begins with `{word}`", source.path, comment.number));
            }
        }
    }
    found
}

/// Returns true if a line exceeds [`MAX_COLUMNS`] and could be wrapped: a bare link, with or without a label, cannot.
fn is_overlong(line: &str) -> bool {
    let text = line.trim_start_matches(|c: char| c.is_whitespace() || "/!#*->".contains(c));
    let text = text.split_once("]: ").map_or(text, |(label, link)| if label.starts_with('[') { link } else { text });
    let bare_link = text.contains("://") && !text.trim().contains(' ');
    line.chars().count() > MAX_COLUMNS && !bare_link
}

/// Returns lines of comments that exceed [`MAX_COLUMNS`]. Rows of tables are exempt.
fn overlong(sources: &[Source]) -> Vec<String> {
    let too_long = |source: &Source| -> Vec<String> {
        let lines = comment_lines(source).into_iter();
        lines
            .filter(|comment| !comment.text.trim_start().starts_with('|') && is_overlong(comment.line))
            .map(|comment| format!("{}:{}: {} columns", source.path, comment.number, comment.line.chars().count()))
            .collect()
    };
    sources.iter().flat_map(too_long).collect()
}

/// Returns lines of Markdown prose that exceed [`MAX_COLUMNS`]. Tables and fenced code blocks are exempt.
fn long_prose(documents: &[Source]) -> Vec<String> {
    let mut found = Vec::new();
    for document in documents {
        let mut fence = None;
        for (i, line) in document.text.lines().enumerate() {
            let start = line.trim_start();
            let marker = ["```", "~~~"].into_iter().find(|marker| start.starts_with(marker));
            if marker.is_some() && (fence.is_none() || fence == marker) {
                fence = if fence.is_none() { marker } else { None };
            } else if fence.is_none() && !start.starts_with('|') && is_overlong(line) {
                found.push(format!("{}:{}: {} columns", document.path, i + 1, line.chars().count()));
            }
        }
    }
    found
}

/// Returns the words of a line in lower case: `SingleFlight` and `single_flight` are two words.
fn words(line: &str) -> Vec<String> {
    let mut found = vec![String::new()];
    let mut before = ' ';
    for c in line.chars() {
        if !c.is_alphabetic() || (before.is_lowercase() && c.is_uppercase()) {
            found.push(String::new());
        }
        if c.is_alphabetic() {
            found.last_mut().expect("there is one").extend(c.to_lowercase());
        }
        before = c;
    }
    found.retain(|word| !word.is_empty());
    found
}

/// Returns the retired words in comments and names.
fn retired(sources: &[Source]) -> Vec<String> {
    let mut found = Vec::new();
    for source in sources.iter().filter(|s| !WORD_LISTS.contains(&s.path.as_str())) {
        // JavaScript has a type of this name.
        let has_promises = ["ts", "mjs"].contains(&extension(source));
        for (i, line) in source.text.lines().enumerate() {
            let mut before = String::new();
            for word in words(line) {
                let mut rows = RETIRED.iter().filter(|(retired, _)| *retired == word).peekable();
                let is_term = has_promises && word.starts_with("promise");
                if rows.peek().is_some() && !is_term && rows.all(|(_, term)| term.is_empty() || *term != before) {
                    found.push(format!("{}:{}: `{word}`", source.path, i + 1));
                }
                before = word;
            }
        }
    }
    found
}

/// Returns commands with curl that do not fail if the server returns an error.
fn commands_that_hide_errors(sources: &[Source]) -> Vec<String> {
    let mut found = Vec::new();
    for source in sources {
        for (i, line) in source.text.lines().enumerate() {
            if line.matches("curl -").count() > line.matches("curl -sS --fail-with-body").count() {
                found.push(format!("{}:{}: no --fail-with-body", source.path, i + 1));
            }
        }
    }
    found
}

#[test]
fn comments_do_not_begin_with_question_words() {
    let sources = all(COMMENTED);
    assert!(sources.len() > 100, "only {} files found: wrong folder?", sources.len());
    assert_none(&questions(&sources));
}

#[test]
fn comments_fit_the_line() {
    assert_none(&overlong(&all(COMMENTED)));
}

#[test]
fn prose_fits_the_line() {
    let documents = files(&["."], &["md"]);
    assert!(documents.len() > 10, "only {} documents found: wrong folder?", documents.len());
    assert_none(&long_prose(&documents));
}

#[test]
fn retired_words_are_not_used() {
    assert_none(&retired(&all(COMMENTED)));
}

#[test]
fn example_commands_fail_if_the_server_returns_an_error() {
    let mut sources = files(&["README.md", "docs", "src", "crates", "web/src", "web/client/src"], &["md", "rs", "ts"]);
    // Decision records mention commands that hide errors.
    sources.retain(|source| !source.path.starts_with("docs/adr/"));
    sources.extend(files(&["web/none.html"], &["html"]));
    assert!(sources.iter().any(|s| s.text.contains("curl -")), "no command found: wrong folder?");
    assert_none(&commands_that_hide_errors(&sources));
}

// -------------------------------------------------------------------------------------------- negative controls

#[test]
fn control_question_words_are_reported() {
    let bad = [
        ("src/x.rs", "/// What it is.\nfn f() {}"),
        ("src/x.rs", "//! **How** it works."),
        ("src/x.rs", "//! Layers.\n/// Which one.\nfn f() {}"),
        ("web/src/x.ts", "/** Whether it holds. */"),
        ("web/src/x.ts", "let a = 1;\n/**\n * Why it holds.\n */"),
        ("tests/x.mjs", "// Rows.\nlet a = 1;\n// Where a row begins."),
        ("tests/x.py", "\"\"\"Rows.\"\"\"\n\ndef f():\n    \"\"\"What f does.\"\"\""),
        ("tests/x.sh", "#!/bin/sh\n# Which folder is used."),
        ("x.toml", "# Rows\na = 1\n# How many."),
        ("shaders/x.wgsl", "fn f() {}\n// Who calls it."),
        ("shaders/x.wgsl", "// Where a vertex lies."),
    ];
    for (path, text) in bad {
        assert_eq!(questions(&source(path, text)).len(), 1, "{path}: {text}");
    }
    let good = [
        ("src/x.rs", "/// Returns the layer.\n/// Which one depends on the path.\nfn f() {}"),
        ("src/x.rs", "// What follows is an ordinary comment.\n//// Why not.\nfn f() {}"),
        ("src/x.rs", "/// Whatever.\nfn f() {}"),
        ("shaders/x.wgsl", "fn f() {}\n// Density at one grid point.\n// What follows is the second line."),
        ("web/src/x.ts", "/**\n * Returns a row.\n * Which one depends on the path.\n */\nconst a = \"// What\";"),
        ("tests/x.mjs", "// The rows.\n// What follows is the second line."),
        ("tests/x.py", "\"\"\"Rows.\n\nWhat follows is the second paragraph.\n\"\"\"\na = \"# What\""),
        ("tests/x.sh", "#!/bin/sh\n# Lists rows.\n# Which ones depends on the folder."),
    ];
    for (path, text) in good {
        assert_eq!(questions(&source(path, text)), Vec::<String>::new(), "{path}: {text}");
    }
}

#[test]
fn control_long_comments_are_reported() {
    let long = "å ".repeat(MAX_COLUMNS / 2);
    for (path, text) in [
        ("x.rs", format!("// {long}")),
        ("x.rs", format!("    ///! {long}")),
        ("x.ts", format!("/** {long} */")),
        ("x.mjs", format!("  // {long}")),
        ("x.py", format!("\"\"\"Rows.\n\n{long}a\n\"\"\"")),
        ("x.sh", format!("# {long}")),
        ("x.toml", format!("# {long}")),
        ("x.wgsl", format!("// {long}")),
    ] {
        assert_eq!(overlong(&source(path, &text)).len(), 1, "{path}");
        assert_eq!(overlong(&source(path, &format!("let x = \"{long}\";"))).len(), 0, "{path}");
    }
    let link = format!("https://example.org/{}", "x".repeat(MAX_COLUMNS));
    for good in [format!("// {}", &long[..MAX_COLUMNS]), format!("/// {link}"), format!("//! | {long} |")] {
        assert_eq!(overlong(&source("x.rs", &good)), Vec::<String>::new(), "{good}");
    }
}

#[test]
fn control_long_prose_is_reported() {
    let words = "å ".repeat(MAX_COLUMNS / 2);
    let link = format!("https://example.org/{}", "x".repeat(MAX_COLUMNS));
    for bad in [format!("- {words}a"), format!("[a]: {link} {words}"), format!("```\n{words}a\n```\n{words}a")] {
        assert_eq!(long_prose(&source("x.md", &bad)).len(), 1, "{bad}");
    }
    let exempt = [
        format!("| {words} |"),
        format!("```\n{words}a\n~~~\n{words}a\n```"),
        format!("- {link}"),
        format!("[a]: {link}"),
    ];
    for good in exempt {
        assert_eq!(long_prose(&source("x.md", &good)), Vec::<String>::new(), "{good}");
    }
}

#[test]
fn control_retired_words_are_reported() {
    let bad = [
        ("src/x.rs", "struct JobPromise;"),
        ("src/x.rs", "/// Makes it anew."),
        ("src/x.rs", "fn pour(flight: u8) {}\nconst PATIENCE: u8 = 1;"),
        ("shaders/x.wgsl", "// Whatever the case."),
        ("tests/x.mjs", "const landing = 1;"),
    ];
    let numbers = [1, 1, 3, 1, 1];
    for ((path, text), number) in bad.into_iter().zip(numbers) {
        assert_eq!(retired(&source(path, text)).len(), number, "{path}: {text}");
    }
    let good = [
        ("src/x.rs", "use crate::single_flight::SingleFlight; // requests in flight"),
        ("web/src/x.ts", "const promise = new Promise(done);"),
        ("src/x.rs", "// The wisher compromises; a seating."),
    ];
    for (path, text) in good {
        assert_eq!(retired(&source(path, text)), Vec::<String>::new(), "{path}: {text}");
    }
}

#[test]
fn control_commands_that_hide_errors_are_reported() {
    let found = |text: &str| commands_that_hide_errors(&source("README.md", text)).len();
    assert_eq!(found("curl -sS --fail-with-body http://x | curl -sS --fail-with-body http://y"), 0);
    assert_eq!(found("curl -sS http://x"), 1);
    assert_eq!(found("curl -sS --fail-with-body http://x | curl -sS http://y"), 1);
}
