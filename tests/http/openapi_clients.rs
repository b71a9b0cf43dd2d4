//! Clients generated from the OpenAPI document: each meshes a file, follows a job to its end, fetches the result,
//! requests a report and receives a typed error. The hand-written client, `web/client`, passes its own tests.

use crate::http_support;
use crate::tools;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, LazyLock};

use http_support::{Running, start};
use molmesh::surface::CpuBackend;
use tempfile::TempDir;

/// Service whose archive has the samples.
static SERVER: LazyLock<Running> = LazyLock::new(|| {
    start(Arc::new(CpuBackend::new(None).unwrap()), |config| config.archive.dir = Some(root("samples")))
});

fn root(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn url() -> String {
    format!("http://{}", SERVER.addr)
}

/// Runs a tool and returns its output; panics with the output if it fails.
fn run(command: &mut Command) -> String {
    let output = command.env("PYTHONDONTWRITEBYTECODE", "1").output().unwrap();
    let text = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(output.status.success(), "{command:?}: {text}");
    text
}

/// Returns a folder with `openapi.json`, beside the Node packages of the tests, where generated code finds them.
fn folder() -> (TempDir, PathBuf) {
    let node = root("target/test-tools/node");
    std::fs::create_dir_all(&node).unwrap();
    let folder = tempfile::tempdir_in(node).unwrap();
    let document = folder.path().join("openapi.json");
    std::fs::write(&document, SERVER.get("/openapi.json").body).unwrap();
    (folder, document)
}

/// Runs a Python script on the generated package in `folder`.
fn python(interpreter: &Path, script: &str, folder: &Path) {
    let script = root("tests/openapi_clients").join(script);
    run(Command::new(interpreter).arg(script).arg(url()).arg(folder).arg(root("samples/1crn.cif")));
}

/// Compiles a TypeScript program with the generated client in `folder`, strictly, and runs it.
fn typescript(script: &str, folder: &Path) {
    let node = root("target/test-tools/node/node_modules");
    let scripts = root("tests/openapi_clients");
    std::fs::copy(scripts.join(script), folder.join("main.ts")).unwrap();
    std::fs::copy(scripts.join("tsconfig.json"), folder.join("tsconfig.json")).unwrap();
    std::fs::write(folder.join("package.json"), "{}").unwrap();
    let types = node.join("@types");
    run(Command::new(node.join(".bin/tsc")).arg("-p").arg(folder).arg("--typeRoots").arg(types));
    let (program, file) = (folder.join("dist/main.js"), root("samples/1crn.cif"));
    run(Command::new("node").arg(program).arg(url()).arg(file));
}

/// Generates a client with openapi-generator.
fn openapi_generator(interpreter: &Path, generator: &str, document: &Path, output: &Path) {
    let mut command = Command::new(interpreter.with_file_name("openapi-generator-cli"));
    command.args(["generate", "--additional-properties", "packageName=client", "--generator-name", generator]);
    run(command.arg("--input-spec").arg(document).arg("--output").arg(output));
}

#[test]
fn openapi_python_client() {
    let Some(interpreter) = tools::python_interpreter() else {
        return tools::missing("openapi-python-client").unwrap_or(());
    };
    let (folder, document) = folder();
    let mut generate = Command::new(interpreter.with_file_name("openapi-python-client"));
    // The generator formats its output with ruff, from the same environment.
    let path = std::env::join_paths(
        [interpreter.parent().unwrap().to_owned()]
            .into_iter()
            .chain(std::env::split_paths(&std::env::var_os("PATH").unwrap())),
    );
    generate
        .args(["generate", "--meta", "none", "--fail-on-warning", "--path"])
        .arg(document)
        .env("PATH", path.unwrap());
    run(generate.arg("--output-path").arg(folder.path().join("client")));
    python(&interpreter, "openapi_python_client.py", folder.path());
}

#[test]
fn openapi_generator_for_python() {
    let Some(interpreter) = tools::python_interpreter() else {
        return tools::missing("openapi-generator").unwrap_or(());
    };
    let (folder, document) = folder();
    openapi_generator(&interpreter, "python", &document, folder.path());
    python(&interpreter, "openapi_generator.py", folder.path());
}

#[test]
fn openapi_generator_for_typescript() {
    let Some(interpreter) = tools::python_interpreter() else {
        return tools::missing("openapi-generator").unwrap_or(());
    };
    let (folder, document) = folder();
    openapi_generator(&interpreter, "typescript-fetch", &document, &folder.path().join("client"));
    typescript("typescript_fetch.ts", folder.path());
}

#[test]
fn hey_api() {
    let generator = root("target/test-tools/node/node_modules/.bin/openapi-ts");
    if !generator.is_file() {
        return tools::missing("@hey-api/openapi-ts").unwrap_or(());
    }
    let (folder, document) = folder();
    let mut generate = Command::new(generator);
    generate.args(["--client", "@hey-api/client-fetch", "--no-log-file", "--input"]).arg(document);
    run(generate.arg("--output").arg(folder.path().join("client")));
    typescript("hey_api.ts", folder.path());
}

#[test]
fn openapi_fetch() {
    let generator = root("target/test-tools/node/node_modules/.bin/openapi-typescript");
    if !generator.is_file() {
        return tools::missing("openapi-typescript").unwrap_or(());
    }
    let (folder, document) = folder();
    run(Command::new(generator).arg(document).arg("--output").arg(folder.path().join("client.ts")));
    typescript("openapi_fetch.ts", folder.path());
}

#[test]
fn typed_client() {
    let package = root("web/client");
    let compiler = root("target/test-tools/node/node_modules/.bin/tsc");
    if !package.join("dist").is_dir() || !compiler.is_file() {
        return tools::missing("the package @molmesh/client (make web), or its compiler,").unwrap_or(());
    }
    run(Command::new("node").arg(package.join("test/client.test.mjs")).env("MOLMESH_URL", url()));
    for project in ["tsconfig.json", "tsconfig.react.json"] {
        run(Command::new(&compiler).arg("-p").arg(package.join("test").join(project)));
    }
}
