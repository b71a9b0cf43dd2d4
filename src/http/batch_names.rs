//! Names of the entries of a batch and of their results.

use std::collections::BTreeMap;

/// Maximum length of an entry's name, bytes: the usual limit of a file name.
pub(super) const MAX_NAME_BYTES: usize = 255;
/// Name of the summary. No result has its extension.
pub(super) const SUMMARY: &str = "summary.jsonl";

/// Returns the name of an entry's results without their extension: the entry's own without that of a compression and
/// that of its format.
pub(super) fn stem(name: &str) -> &str {
    let file = name.rfind('/').map_or(0, |slash| slash + 1);
    let without = |name: &str, known: &dyn Fn(&str) -> bool| {
        let dot = name[file..].rfind('.').filter(|dot| *dot > 0 && known(&name[file + dot + 1..]));
        dot.map_or(name.len(), |dot| file + dot)
    };
    let inflated =
        &name[..without(name, &|end| ["gz", "zst", "zstd"].iter().any(|known| end.eq_ignore_ascii_case(known)))];
    &inflated[..without(inflated, &|_| true)]
}

/// Returns a name that is safe as a relative path, without `./` at its start, or the reason for which it is refused.
pub(super) fn check_name(name: &[u8]) -> Result<&str, &'static str> {
    if name.len() > MAX_NAME_BYTES {
        return Err("has more than 255 bytes");
    }
    let name = str::from_utf8(name).map_err(|_bad| "is not UTF-8")?;
    let name = name.trim_start_matches("./");
    if name.starts_with('/') || name.chars().any(|c| c.is_control() || matches!(c, '\\' | ':')) {
        return Err("is absolute or has a control character, a backslash or a colon");
    }
    if name.split('/').any(|part| matches!(part, "" | "." | "..")) {
        return Err("has an empty part, `.` or `..`");
    }
    Ok(name)
}

/// Names of the results of the entries so far.
pub(super) struct ResultNames<'a> {
    /// Extensions of the results of an entry.
    extensions: &'a [&'static str],
    /// Names of the entries, by their stems in lower case, which some file systems do not distinguish.
    stems: BTreeMap<String, String>,
}

impl<'a> ResultNames<'a> {
    pub(super) fn new(extensions: &'a [&'static str]) -> Self {
        Self { extensions, stems: BTreeMap::new() }
    }

    /// Adds an entry. Returns the reason if its results cannot be unpacked beside those of an earlier one.
    pub(super) fn add(&mut self, name: &str) -> Result<(), String> {
        let (shown, stem) = (stem(name), stem(name).to_lowercase());
        if let Some(extension) = self.extensions.iter().find(|end| shown.len() + 1 + end.len() > MAX_NAME_BYTES) {
            return Err(format!("the name of its result `….{extension}` would have more than {MAX_NAME_BYTES} bytes"));
        }
        if let Some(first) = self.stems.get(&stem) {
            return Err(if first == name {
                "the archive has an earlier entry of this name".to_owned()
            } else {
                format!("the results of `{first}` and of this entry would have one name, `{shown}`")
            });
        }
        for folder in stem.match_indices('/').map(|(slash, _)| &stem[..slash]) {
            if let Some(result) = self.describe(folder) {
                return Err(format!("`{folder}` would be {result} and a folder of the results of this entry"));
            }
        }
        for extension in self.extensions {
            let file = format!("{stem}.{extension}");
            let folder = format!("{file}/");
            let next = self.stems.range(folder.clone()..).next();
            if let Some((_, inside)) = next.filter(|(stem, _)| stem.starts_with(&folder)) {
                return Err(format!("`{file}` would be a result of this entry and a folder of those of `{inside}`"));
            }
        }
        self.stems.insert(stem, name.to_owned());
        Ok(())
    }

    /// Describes the result that has this name in lower case; `None` if there is none.
    fn describe(&self, file: &str) -> Option<String> {
        if file == SUMMARY {
            return Some("the summary of all results".to_owned());
        }
        let (stem, _) = file.rsplit_once('.').filter(|(_, extension)| self.extensions.contains(extension))?;
        self.stems.get(stem).map(|name| format!("a result of `{name}`"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_relative_paths() {
        assert_eq!(
            ["a.pdb", "./a/b.cif", "ä b"].map(|name| check_name(name.as_bytes())),
            [Ok("a.pdb"), Ok("a/b.cif"), Ok("ä b")]
        );
        for bad in ["", "/a", "../a", "a/../b", "a//b", "a/", "c:a", "a\\b", "a\nb", "a\0", ".", &"a".repeat(256)] {
            assert!(check_name(bad.as_bytes()).is_err(), "{bad}");
        }
        assert!(check_name(b"\xff").is_err());
    }

    #[test]
    fn results_have_the_stem_of_their_entry() {
        for (name, expected) in [
            ("1crn.cif", "1crn"),
            ("a.b/1crn.cif.gz", "a.b/1crn"),
            ("1crn.PDB.ZST", "1crn"),
            ("AF-P1-F1-model_v4.1.cif", "AF-P1-F1-model_v4.1"),
            ("plain", "plain"),
            ("a.b/.hidden", "a.b/.hidden"),
        ] {
            assert_eq!(stem(name), expected, "{name}");
        }
    }

    #[test]
    fn a_result_is_no_folder_of_others() {
        let mut results = ResultNames::new(&["glb", "csv"]);
        let mut add = |name: &str| results.add(name);
        for free in
            ["x.pdb", "x.stl/y.pdb", "x.GL/y.pdb", "z.GLB/deep/y.pdb", "w.glb.pdb", "summary.pdb", "a", "a/b.pdb"]
        {
            assert_eq!(add(free), Ok(()), "{free}");
        }
        for (refused, other) in [
            ("X.glb/y.pdb", "a result of `x.pdb`"),
            ("x.CSV/b/y.pdb", "a result of `x.pdb`"),
            ("w.glb.glb/y.pdb", "a result of `w.glb.pdb`"),
            ("Z.pdb", "`z.GLB/deep/y.pdb`"),
            ("Summary.jsonl/y.pdb", "the summary"),
            ("x.cif", "`x.pdb` and of this entry would have one name"),
        ] {
            let detail = add(refused).unwrap_err();
            assert!(detail.contains(other), "{refused}: {detail}");
        }
        assert!(add(&"l".repeat(252)).unwrap_err().contains("more than 255 bytes"));
        assert_eq!(add(&"l".repeat(251)), Ok(()));
        // The refused ones have no results.
        assert_eq!(add("x.glb.pdb"), Ok(()));
    }
}
