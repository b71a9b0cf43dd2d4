//! Comparison with other programs (`benches/peers`): its mesh checker, tables and runs, with molmesh only.

use crate::tools;

use std::path::Path;
use std::process::Command;

#[test]
fn the_tests_of_the_comparison_pass() {
    let Some(python) = tools::python_interpreter() else {
        tools::missing::<()>("the Python of the comparison's tests");
        return;
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers/test_peers.py");
    let output = Command::new(python)
        .arg("-B")
        .arg(script)
        .env("MOLMESH", env!("CARGO_BIN_EXE_molmesh"))
        .env("MOLMESH__ARCHIVE__URL", "none")
        .output();
    match output {
        Ok(output) => assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr)),
        Err(error) => assert_eq!(error.to_string(), "", "cannot start the tests"),
    }
}
