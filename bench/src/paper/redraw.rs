//! `molmesh-bench figures`: figures and tables from stored results.

use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;

use super::result::Document;
use super::{figures, markdown, replace};
use crate::error::{Error, Result};
use crate::print;

/// Arguments of `molmesh-bench figures`.
#[derive(Debug, clap::Args)]
pub(crate) struct FiguresArgs {
    /// Results of `molmesh-bench paper --out`: JSON files or folders of them
    #[arg(value_name = "RESULTS", default_value = "docs/results/paper")]
    results: Vec<PathBuf>,
    /// Folder for the figures
    #[arg(long, value_name = "DIR", default_value = "docs/figures")]
    out: PathBuf,
    /// Markdown page in which tables replace the parts from `<!-- measured: NAME -->` to `<!-- end -->`
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
}

/// Runs the command.
pub(crate) fn run(args: &FiguresArgs) -> Result<()> {
    let documents = read(&args.results)?;
    let figures = figures::all(&documents).into_iter();
    let mut files: Vec<(PathBuf, String)> = figures.map(|(name, svg)| (args.out.join(name), svg + "\n")).collect();
    if let Some(path) = &args.page {
        let text = fs::read_to_string(path).map_err(Error::file(path))?;
        let page = filled(&text, &documents).map_err(|why| Error::Failed(format!("{}: {why}", path.display())))?;
        files.push((path.clone(), page));
    }
    fs::create_dir_all(&args.out).map_err(Error::file(&args.out))?;
    for (path, text) in &files {
        replace(path, text.as_bytes())?;
        print(&format!("{}\n", path.display()))?;
    }
    Ok(())
}

/// Reads the results of files and folders, sorted by path.
fn read(paths: &[PathBuf]) -> Result<Vec<Document>> {
    let mut files = Vec::new();
    for path in paths {
        if path.is_dir() {
            for entry in fs::read_dir(path).map_err(Error::file(path))? {
                let path = entry.map_err(Error::file(path))?.path();
                if path.extension().is_some_and(|extension| extension == "json") {
                    files.push(path);
                }
            }
        } else {
            files.push(path.clone());
        }
    }
    if files.is_empty() {
        return Err(Error::Usage("no results found; create them with `molmesh-bench paper --out`".to_owned()));
    }
    files.sort();
    let document = |path: &PathBuf| {
        let text = fs::read_to_string(path).map_err(Error::file(path))?;
        let why = |e| Error::Failed(format!("{} is not a result of `molmesh-bench paper`: {e}", path.display()));
        serde_json::from_str(&text).map_err(why)
    };
    files.iter().map(document).collect()
}

/// Mark before the name of a part of a page.
const OPEN: &str = "<!-- measured: ";
/// Mark at the end of a part.
const CLOSE: &str = "<!-- end -->";

/// Replaces the marked parts of a page.
fn filled(page: &str, documents: &[Document]) -> std::result::Result<String, String> {
    let (mut out, mut rest, mut parts) = (String::new(), page, 0);
    while let Some((before, marked)) = rest.split_once(OPEN) {
        let (name, body) = marked.split_once(" -->").ok_or("a mark has no end")?;
        let (_, after) = body.split_once(CLOSE).ok_or_else(|| format!("`{name}` has no {CLOSE}"))?;
        let part = markdown::part(name, documents).ok_or_else(|| format!("no part is called `{name}`"))?;
        // Writing to a string does not fail.
        _ = write!(out, "{before}{OPEN}{name} -->\n{part}{CLOSE}");
        (rest, parts) = (after, parts + 1);
    }
    if parts == 0 {
        return Err(format!("no part is marked by `{OPEN}NAME -->`"));
    }
    Ok(out + rest)
}

#[cfg(test)]
mod tests {
    use super::super::result::tests::made_up;
    use super::*;

    #[test]
    fn marked_parts_are_replaced_repeatedly() {
        let page = "before\n<!-- measured: table-1 -->\nold\n<!-- end -->\nafter\n";
        let once = filled(page, &[made_up(false)]).unwrap();
        assert!(once.starts_with("before\n<!-- measured: table-1 -->\n") && once.ends_with("<!-- end -->\nafter\n"));
        assert!(once.contains("| 1BIJ") && !once.contains("old"), "{once}");
        assert_eq!(filled(&once, &[made_up(false)]).unwrap(), once);
        assert_ne!(filled(&once, &[made_up(true)]).unwrap(), once);
        for (bad, why) in [
            ("nothing", "no part"),
            ("<!-- measured: table-1 -->", "has no"),
            ("<!-- measured: table-9 --><!-- end -->", "no part is called `table-9`"),
        ] {
            assert!(filled(bad, &[made_up(false)]).unwrap_err().contains(why), "{bad}");
        }
    }
}
