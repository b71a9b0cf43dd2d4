//! Comparison of the help, and of the summary in the documentation, with files. After an intended change, run the test
//! with `MOLMESH_BLESS=1` and read the difference.

use crate::cli_support;

use std::path::Path;

use cli_support::{Folder, assert_code, molmesh, run, stderr, stdout};

fn snapshot(name: &str, args: &[&str]) {
    let done = run(args);
    assert_code(&done, 0);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/cli_help/{name}.txt"));
    let now = stdout(&done);
    if std::env::var_os("MOLMESH_BLESS").is_some() {
        std::fs::write(&path, &now).unwrap();
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(now, kept, "the help of {args:?} has changed");
}

#[test]
fn the_summary_in_the_documentation_is_current() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (path, folder) = (root.join("docs/start/cli.md"), Folder::new());
    std::os::unix::fs::symlink(root.join("samples"), folder.path("samples")).unwrap();
    let done =
        molmesh().args(["mesh", "samples/4pti.pdb", "-o", "4pti.glb"]).current_dir(folder.path("")).output().unwrap();
    assert_code(&done, 0);
    let summary = stderr(&done);
    let page = std::fs::read_to_string(&path).unwrap();
    let (start, rest) = page.split_once("```\n4PTI").expect("the page has the summary");
    let (block, end) = rest.split_once("```").unwrap();
    let documented = format!("4PTI{block}");
    // The page has some of the lines.
    let label = |line: &str| line.get(..12).unwrap_or_default().to_owned();
    let labels: Vec<String> = documented.lines().map(label).collect();
    let lines: Vec<&str> = summary.lines().filter(|line| labels.contains(&label(line))).collect();
    if std::env::var_os("MOLMESH_BLESS").is_some() {
        std::fs::write(&path, format!("{start}```\n{}\n```{end}", lines.join("\n"))).unwrap();
    }
    let documented: Vec<&str> = documented.lines().collect();
    assert_eq!(lines, documented, "docs/start/cli.md has another summary; MOLMESH_BLESS=1 writes it");
}

#[test]
fn help_is_stable() {
    snapshot("molmesh", &["--help"]);
    snapshot("mesh", &["mesh", "--help"]);
    snapshot("render", &["render", "--help"]);
    snapshot("tileset", &["tileset", "--help"]);
    snapshot("areas", &["areas", "--help"]);
    snapshot("serve", &["serve", "--help"]);
    snapshot("doctor", &["doctor", "--help"]);
    snapshot("config", &["config", "--help"]);
    snapshot("config-print", &["config", "print", "--help"]);
    snapshot("healthcheck", &["healthcheck", "--help"]);
    snapshot("key", &["key", "--help"]);
    snapshot("key_new", &["key", "new", "--help"]);
    snapshot("key_signing", &["key", "signing", "--help"]);
    snapshot("sign", &["sign", "--help"]);
    snapshot("completions", &["completions", "--help"]);
    snapshot("man", &["man", "--help"]);
}

#[test]
fn help_completions_and_man_pages_know_every_flag() {
    let help = run(["mesh", "--help"]);
    assert_eq!(stdout(&run(["help", "mesh"])), stdout(&help));
    assert_eq!(stdout(&run(["help", "key", "new"])), stdout(&run(["key", "new", "--help"])));
    for shell in ["bash", "zsh", "fish"] {
        let script = run(["completions", shell]);
        assert_code(&script, 0);
        for word in ["skip-existing", "max-triangles", "healthcheck"] {
            assert!(stdout(&script).contains(word), "{shell}: no {word}");
        }
    }
    let page = run(["man", "mesh"]);
    assert_code(&page, 0);
    assert!(stdout(&page).contains(".TH molmesh-mesh 1") && stdout(&page).contains("\\-\\-max\\-triangles"));
    assert!(stdout(&run(["man"])).contains("molmesh\\-areas(1)"), "{}", stdout(&run(["man"])));
    assert_code(&run(["man", "key", "old"]), 2);
}

#[test]
fn help_and_guide_list_the_same_exit_codes() {
    let help = stdout(&run(["--help"]));
    let guide = include_str!("../../docs/start/cli.md");
    let codes: Vec<&str> = help.split("Exit codes:\n").nth(1).unwrap().lines().collect();
    assert_eq!(codes.len(), 11, "{help}");
    for line in codes {
        let (code, meaning) = line.trim().split_once("  ").unwrap();
        let row = format!("| {code} | {} |", meaning.trim());
        assert!(guide.contains(&row), "docs/start/cli.md has no row `{row}`");
    }
}

#[test]
fn the_guide_mentions_every_flag_of_mesh() {
    let help = stdout(&run(["mesh", "--help"]));
    let guide = include_str!("../../docs/start/cli.md");
    // Examples contain flags of curl.
    let lines = help.lines().filter(|line| !line.contains("curl "));
    let flags: Vec<&str> =
        lines.flat_map(str::split_whitespace).filter(|w| w.starts_with("--") && w.len() > 2).collect();
    assert!(flags.len() > 20, "{flags:?}");
    for flag in flags {
        // `--areas[=<LEVEL>]` has an optional value.
        let flag = flag.split(['[', '=']).next().unwrap().trim_end_matches([',', '.', ')', ']', ':']);
        if flag != "--help" {
            assert!(guide.contains(flag), "docs/start/cli.md does not mention {flag}");
        }
    }
}
