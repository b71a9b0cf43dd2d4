//! Comparison of the help with files. After an intended change, run the test with `MOLMESH_BLESS=1` and read the
//! difference.

use crate::cli_support;

use std::path::Path;

use cli_support::{assert_code, run, stdout};

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
fn help_is_stable() {
    snapshot("molmesh", &["--help"]);
    snapshot("mesh", &["mesh", "--help"]);
    snapshot("render", &["render", "--help"]);
    snapshot("serve", &["serve", "--help"]);
    snapshot("doctor", &["doctor", "--help"]);
    snapshot("config", &["config", "--help"]);
    snapshot("config-print", &["config", "print", "--help"]);
    snapshot("healthcheck", &["healthcheck", "--help"]);
    snapshot("key", &["key", "--help"]);
    snapshot("key_new", &["key", "new", "--help"]);
    snapshot("key_signing", &["key", "signing", "--help"]);
    snapshot("sign", &["sign", "--help"]);
}

#[test]
fn help_and_readme_agree_on_exit_codes() {
    let help = stdout(&run(["--help"]));
    let readme = include_str!("../../README.md");
    let codes: Vec<&str> = help.split("Exit codes:\n").nth(1).unwrap().lines().collect();
    assert_eq!(codes.len(), 10, "{help}");
    for line in codes {
        let (code, meaning) = line.trim().split_once("  ").unwrap();
        let row = format!("| {code} | {} |", meaning.trim());
        assert!(readme.contains(&row), "the README has no row `{row}`");
    }
}

#[test]
fn every_flag_of_mesh_is_in_the_readme() {
    let help = stdout(&run(["mesh", "--help"]));
    let readme = include_str!("../../README.md");
    let flags: Vec<&str> = help.split_whitespace().filter(|w| w.starts_with("--") && w.len() > 2).collect();
    assert!(flags.len() > 20, "{flags:?}");
    for flag in flags {
        let flag = flag.trim_end_matches([',', '.', ')', ']', ':']);
        if flag != "--help" {
            assert!(readme.contains(flag), "the README does not mention {flag}");
        }
    }
}
