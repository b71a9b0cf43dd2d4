//! `molmesh bench figures`: figures and tables from results that were measured before, here or elsewhere.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;

use super::super::super::error::CliError;
use super::result::{Document, MADE_BY};
use super::{figures, markdown};

/// `molmesh bench figures`.
#[derive(Debug, ClapArgs)]
pub(crate) struct FiguresArgs {
    /// Results of `molmesh bench paper --out`: JSON files, or folders with some
    #[arg(value_name = "RESULTS", default_value = "docs/results/paper")]
    pub(crate) results: Vec<PathBuf>,
    /// Folder for the figures
    #[arg(long, value_name = "DIR", default_value = "docs/figures")]
    pub(crate) out: PathBuf,
    /// A Markdown page whose marked parts are replaced by the tables: from `<!-- measured: NAME -->` to `<!-- end -->`
    #[arg(long, value_name = "FILE")]
    pub(crate) page: Option<PathBuf>,
}

/// Runs the command.
pub(in crate::cli::bench) fn run(args: &FiguresArgs) -> Result<(), CliError> {
    let documents = read(&args.results)?;
    // Before anything is written.
    let page = match &args.page {
        None => None,
        Some(path) => {
            let text = fs::read_to_string(path).map_err(|source| CliError::Input { name: shown(path), source })?;
            let page = filled(&text, &documents).map_err(|why| CliError::usage(format!("{}: {why}", shown(path))))?;
            Some((path.clone(), page))
        }
    };
    fs::create_dir_all(&args.out).map_err(|source| CliError::Output { name: shown(&args.out), source })?;
    let mut files: Vec<(PathBuf, String)> =
        figures::all(&documents).into_iter().map(|(name, svg)| (args.out.join(name), svg + "\n")).collect();
    files.extend(page);
    for (path, text) in &files {
        super::put(path, text.as_bytes())?;
        super::super::super::say(&format!("{}\n", shown(path)))?;
    }
    Ok(())
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

/// The results of these files and folders, by their names.
fn read(paths: &[PathBuf]) -> Result<Vec<Document>, CliError> {
    let mut files = Vec::new();
    for path in paths {
        let failed = |source| CliError::Input { name: shown(path), source };
        if fs::metadata(path).map_err(failed)?.is_dir() {
            let entries = fs::read_dir(path).map_err(failed)?.collect::<Result<Vec<_>, _>>().map_err(failed)?;
            let json = entries.into_iter().map(|e| e.path()).filter(|p| p.extension().is_some_and(|e| e == "json"));
            files.extend(json);
        } else {
            files.push(path.clone());
        }
    }
    files.sort();
    let mut documents = Vec::new();
    for path in &files {
        let text = fs::read_to_string(path).map_err(|source| CliError::Input { name: shown(path), source })?;
        let document: Document = serde_json::from_str(&text)
            .map_err(|e| CliError::usage(format!("{} holds no results of `{MADE_BY}`: {e}", shown(path))))?;
        if document.made_by != MADE_BY {
            return Err(CliError::usage(format!("{} holds results of `{}`", shown(path), document.made_by)));
        }
        documents.push(document);
    }
    if documents.is_empty() {
        return Err(CliError::usage("no results: `molmesh bench paper --out` writes some"));
    }
    Ok(documents)
}

/// Opens and closes a part of a page.
const OPEN: &str = "<!-- measured: ";
const CLOSE: &str = "<!-- end -->";

/// A page with its marked parts replaced by what was measured.
pub(super) fn filled(page: &str, documents: &[Document]) -> Result<String, String> {
    let (mut out, mut rest, mut parts) = (String::new(), page, 0);
    while let Some((before, marked)) = rest.split_once(OPEN) {
        let (name, body) = marked.split_once(" -->").ok_or("a mark does not end")?;
        let (_, after) = body.split_once(CLOSE).ok_or_else(|| format!("`{name}` has no {CLOSE}"))?;
        let part = markdown::part(name, documents).ok_or_else(|| format!("nothing is called `{name}`"))?;
        // A string takes everything.
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
    fn marked_parts_are_replaced_again_and_again() {
        let page = "before\n<!-- measured: table-1 -->\nold\n<!-- end -->\nafter\n";
        let once = filled(page, &[made_up(false)]).unwrap();
        assert!(once.starts_with("before\n<!-- measured: table-1 -->\n") && once.ends_with("<!-- end -->\nafter\n"));
        assert!(once.contains("| 1BIJ") && !once.contains("old"), "{once}");
        assert_eq!(filled(&once, &[made_up(false)]).unwrap(), once);
        assert_ne!(filled(&once, &[made_up(true)]).unwrap(), once);
        for (bad, why) in [
            ("nothing", "no part"),
            ("<!-- measured: table-1 -->", "has no"),
            ("<!-- measured: table-9 --><!-- end -->", "nothing is called `table-9`"),
        ] {
            assert!(filled(bad, &[made_up(false)]).unwrap_err().contains(why), "{bad}");
        }
    }
}
