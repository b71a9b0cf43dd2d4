//! The gallery: its page shows all pictures, they are small, and the command of a picture renders it.

use crate::cli_support;

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::{Path, PathBuf};

use cli_support::{Folder, assert_code, run};

/// Maximum size of all pictures in bytes, as they are part of every clone.
const MAX_BYTES: u64 = 1_500_000;

fn docs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("docs")
}

/// Returns the pictures that a page shows.
fn shown(page: &str) -> BTreeSet<String> {
    let links = page.split("](../gallery/").skip(1).filter_map(|rest| rest.split(')').next());
    links.map(str::to_owned).collect()
}

/// Returns the flags after the name of a picture in its command.
fn flags<'a>(page: &'a str, picture: &str) -> Option<Vec<&'a str>> {
    let command = page.split(&format!("`molmesh render FILE -o {picture} ")).nth(1)?.split('`').next()?;
    Some(command.split(' ').collect())
}

/// Returns the faults of a page.
fn faults(page: &str) -> Vec<String> {
    let named = shown(page);
    let existing: BTreeSet<String> = fs::read_dir(docs().join("gallery"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| Path::new(name).extension().is_some_and(|extension| extension == "png"))
        .collect();
    let mut faults: Vec<String> = named
        .symmetric_difference(&existing)
        .map(|name| format!("{name}: on the page or in the folder only"))
        .collect();
    faults.extend(named.iter().filter(|name| flags(page, name).is_none()).map(|name| format!("{name}: no command")));
    faults
}

/// Returns width, height and pixels.
fn pixels(path: &Path) -> (u32, u32, Vec<u8>) {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path).unwrap())).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    (info.width, info.height, bytes)
}

#[test]
fn page_shows_exactly_the_existing_pictures() {
    let page = fs::read_to_string(docs().join("research/gallery.md")).unwrap();
    assert_eq!(faults(&page), Vec::<String>::new());
    let named = shown(&page);
    assert!(named.len() >= 12, "{named:?}");
    let bytes: u64 = named.iter().map(|name| fs::metadata(docs().join("gallery").join(name)).unwrap().len()).sum();
    assert!(bytes <= MAX_BYTES, "{bytes} bytes");
    // Controls: a missing picture, a picture on no page, a picture without a command.
    assert_eq!(faults(&page.replace("](../gallery/4pti-gaussian.png)", "](../gallery/none.png)")).len(), 3);
    assert_eq!(faults(&page.replace("FILE -o 4pti-gaussian.png", "FILE -o it")).len(), 1);
}

#[test]
fn command_on_the_page_renders_the_picture() {
    let page = fs::read_to_string(docs().join("research/gallery.md")).unwrap();
    let folder = Folder::new();
    let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/4pti.pdb");
    let draw = |picture: &str| {
        let output = folder.path(picture);
        let mut line =
            vec!["render", sample.to_str().unwrap(), "-o", output.to_str().unwrap(), "-q", "--backend", "cpu"];
        line.extend(flags(&page, picture).unwrap());
        assert_code(&run(line), 0);
        pixels(&output)
    };
    let (width, height, drawn) = draw("4pti-gaussian.png");
    let difference = |kept: &str| {
        let kept = pixels(&docs().join("gallery").join(kept));
        assert_eq!((kept.0, kept.1, kept.2.len()), (width, height, drawn.len()));
        let sum: f64 = kept.2.iter().zip(&drawn).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
        sum / drawn.len() as f64
    };
    // Processors with other vector extensions round differently: about one level in a hundred channels.
    let same = difference("4pti-gaussian.png");
    assert!(same < 0.05, "{same} levels per channel");
    let other = difference("4pti-inverse-square.png");
    assert!(other > 20.0 * same.max(0.05), "{other} levels per channel");
}
