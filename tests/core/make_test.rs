//! `make test` names its steps, stops at the first failure, and then prints the skipped checks.
#![cfg(unix)]

use std::process::Command;

/// Rule of a step that is skipped.
const SKIPPED_STEP: &str = "skipped-step:\n\t@echo 'SKIPPED: a check' | tee -a \"$$SKIPPED\"\n";

/// Runs `make test` with other steps. Returns success, standard output and standard error.
fn make_test(steps: &str) -> (bool, String, String) {
    let folder = tempfile::tempdir().unwrap();
    let rules = folder.path().join("rules");
    std::fs::write(&rules, SKIPPED_STEP).unwrap();
    let mut make = Command::new("make");
    make.current_dir(env!("CARGO_MANIFEST_DIR")).env_remove("MAKEFLAGS").env_remove("MAKELEVEL");
    make.env("MAKEFILES", rules).args(["test", &format!("STEPS={steps}")]);
    let done = make.arg(format!("SKIPPED={}", folder.path().join("skipped").display())).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (done.status.success(), text(done.stdout), text(done.stderr))
}

#[test]
fn make_test_names_its_steps_and_reports_skipped_checks_after_a_failure() {
    if !["/usr/bin/make", "/bin/make"].iter().any(|path| std::path::Path::new(path).is_file()) {
        return crate::tools::missing("make").unwrap_or(());
    }
    let skipped = "SKIPPED: a check";
    let (passes, out, err) = make_test("skipped-step help");
    assert!(passes, "{err}");
    assert!(err.contains("make test: step 1 of 2: skipped-step\nmake test: step 2 of 2: help\n"), "{err}");
    assert_eq!(out.matches(skipped).count(), 1, "{out}");
    let (passes, out, err) = make_test("skipped-step no-such-step help");
    assert!(!passes && err.contains("make test: step no-such-step failed") && !err.contains("3 of 3"), "{err}");
    assert_eq!(out.matches(skipped).count(), 2, "once by the step, once at the end: {out}");
}
