//! Links between Markdown files lead to files and headings that exist.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::path::{Component, Path, PathBuf};

/// Folders without documents of the project. Build folders, whose names begin with `target`, are skipped too.
const SKIPPED: [&str; 4] = [".git", "node_modules", "dist", "build"];

/// Returns the text of each Markdown file below `root` by path.
fn documents(root: &Path) -> BTreeMap<PathBuf, String> {
    let mut found = BTreeMap::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            if path.is_dir() && !path.is_symlink() {
                if !SKIPPED.contains(&name.as_str()) && !name.starts_with("target") {
                    folders.push(path);
                }
            } else if path.extension().is_some_and(|extension| extension == "md") {
                let text = fs::read_to_string(&path).unwrap();
                found.insert(path, text);
            }
        }
    }
    found
}

/// Returns the lines of a document outside fenced code blocks with their numbers.
fn prose(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut is_code = false;
    text.lines().enumerate().filter_map(move |(index, line)| {
        let is_fence = line.trim_start().starts_with("```");
        is_code ^= is_fence;
        (!is_code && !is_fence).then_some((index + 1, line))
    })
}

/// Returns the targets of the inline links and images in a line. Skips code spans.
fn targets(line: &str) -> Vec<&str> {
    let spans = line.split('`').step_by(2);
    let after = spans.flat_map(|span| span.split("](").skip(1));
    after.filter_map(|rest| rest.split(')').next()?.split_whitespace().next()).collect()
}

/// Returns the anchors of a document's headings as GitHub generates them.
fn anchors(text: &str) -> Vec<String> {
    let mut seen: HashMap<String, u32> = HashMap::new();
    let headings = prose(text).filter(|(_, line)| line.starts_with('#'));
    headings
        .map(|(_, line)| {
            let title = line.trim_start_matches('#').trim().to_lowercase();
            let kept = title.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
            let anchor: String = kept.map(|c| if c == ' ' { '-' } else { c }).collect();
            let times = seen.entry(anchor.clone()).or_default();
            *times += 1;
            if *times == 1 { anchor } else { format!("{anchor}-{}", *times - 1) }
        })
        .collect()
}

/// Removes `.` and `..` from a path.
fn normal(path: &Path) -> PathBuf {
    let mut result = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => {
                result.pop();
            }
            Component::CurDir => {}
            other => result.push(other),
        }
    }
    result
}

/// Returns the broken links below `root`. Links to other sites are not checked.
fn broken(root: &Path) -> Vec<String> {
    let documents = documents(root);
    let anchors: HashMap<&Path, Vec<String>> =
        documents.iter().map(|(path, text)| (path.as_path(), anchors(text))).collect();
    let mut found = Vec::new();
    for (path, text) in &documents {
        for (number, line) in prose(text) {
            for target in targets(line) {
                if target.contains("://") || target.starts_with("mailto:") {
                    continue;
                }
                let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
                let mut to = if file.is_empty() { path.clone() } else { normal(&path.parent().unwrap().join(file)) };
                let exists = to.exists();
                if to.is_dir() {
                    to.push("README.md");
                }
                let has_anchor = || anchors.get(to.as_path()).is_some_and(|all| all.iter().any(|a| a == anchor));
                if !exists || !anchor.is_empty() && !has_anchor() {
                    let shown = path.strip_prefix(root).unwrap_or(path).display();
                    found.push(format!("{shown}:{number}: {target}"));
                }
            }
        }
    }
    found
}

#[test]
fn every_link_has_a_target() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    assert!(documents(root).len() >= 20, "documents are missing");
    assert_eq!(broken(root), Vec::<String>::new());
}

#[test]
fn control_broken_links_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    fs::create_dir(folder.path().join("sub")).unwrap();
    write("sub/README.md", "# A title: `code`, *more*\n\n# Twice\n\n# Twice\n");
    write(
        "good.md",
        "# Here\n[a](sub/README.md) [b](sub/#a-title-code-more) [c](#here) [`d`](sub/README.md#twice-1)\n\
         ![e](sub/README.md \"title\") <https://x.y> [f](https://x.y#z) `[g](absent)`\n```\n[h](absent)\n```\n",
    );
    assert_eq!(broken(folder.path()), Vec::<String>::new());
    write("bad.md", "[a](absent.md)\n\n[b](good.md#absent) [c](#none)\n[`d`](sub/README.md#twice-2)\n");
    let expected =
        ["bad.md:1: absent.md", "bad.md:3: good.md#absent", "bad.md:3: #none", "bad.md:4: sub/README.md#twice-2"];
    assert_eq!(broken(folder.path()), expected);
}
