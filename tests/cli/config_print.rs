//! Printing of the effective configuration: it loads to the same configuration, names the sources of values and
//! contains no secrets. Reading secrets from files.

use crate::cli_support;

use std::path::Path;

use cli_support::{Folder, assert_code, molmesh, run, stderr, stdout};
use molmesh::config::{ConfigError, ConfigSource, Loaded, load};
use serde_json::Value;

fn pairs(list: &[(&str, &str)]) -> Vec<(String, String)> {
    list.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect()
}

fn reload(folder: &Folder, loaded: &Loaded) -> molmesh::config::Config {
    load(Some(&folder.file("reload.toml", loaded.to_toml())), [], &[])
        .unwrap_or_else(|e| panic!("{e}\n{}", loaded.to_toml()))
        .config
}

/// Creates a file that only its owner can read.
fn secret_file(folder: &Folder, text: &str) -> std::path::PathBuf {
    use std::os::unix::fs::PermissionsExt as _;
    let path = folder.file("secret", text);
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o400)).unwrap();
    path
}

#[test]
fn the_printed_configuration_loads_to_the_same() {
    let folder = Folder::new();
    let defaults = load(None, [], &[]).unwrap();
    assert_eq!(reload(&folder, &defaults), defaults.config);
    let secret = secret_file(&folder, "from a file\n");
    let file = folder.file(
        "molmesh.toml",
        format!(
            "[store]\nsecret_access_key_file = {:?}\n[archive]\nurl = [\"http://a/{{id}}\", \"http://b/{{id}}\"]\n\
             [jobs]\nworkers = 3\nqueue = 4\n",
            secret.display().to_string()
        ),
    );
    let odd = "quote\" back\\slash \u{7f}tab\t line\n Å end";
    let env = pairs(&[("MOLMESH__JOBS__QUEUE", "5"), ("MOLMESH__SERVER__TERMINATION_NOTICE_MS", "none")]);
    let flags = pairs(&[("server.data_dir", odd), ("limits.atoms", "18446744073709551615")]);
    let loaded = load(Some(&file), env, &flags).unwrap();
    assert_eq!(loaded.config.store.secret_access_key.as_ref().unwrap().reveal(), "from a file");
    assert_eq!(loaded.config.server.data_dir, Path::new(odd));
    assert_eq!(reload(&folder, &loaded), loaded.config);
    // Control: a different value gives a different configuration.
    let other = loaded.to_toml().replace("workers = 3", "workers = 4");
    assert_ne!(load(Some(&folder.file("other.toml", other)), [], &[]).unwrap().config, loaded.config);
}

#[test]
fn every_value_is_printed_with_its_source() {
    let folder = Folder::new();
    let file = folder.file("molmesh.toml", "[jobs]\nworkers = 3\nqueue = 4\nrecords_per_client = 7\n");
    let done = molmesh()
        .env("MOLMESH__JOBS__QUEUE", "5")
        .args(["config", "print", "--set", "jobs.records_per_client=8", "--backend", "cpu", "--config"])
        .arg(&file)
        .output()
        .unwrap();
    assert_code(&done, 0);
    let text = stdout(&done);
    for line in [
        format!("workers = 3 # {}", file.display()),
        "queue = 5 # MOLMESH__JOBS__QUEUE".to_owned(),
        "records_per_client = 8 # command line".to_owned(),
        "attempts = 3 # default".to_owned(),
        "# Not part of this file: --backend cpu".to_owned(),
    ] {
        assert!(text.lines().any(|l| l == line), "no `{line}` in\n{text}");
    }
    let json = |args: &[&str]| -> Value { serde_json::from_str(&stdout(&run(args))).unwrap() };
    let printed = json(&["config", "print", "--format", "json", "--listen", "127.0.0.1:0"]);
    assert_eq!(printed["config"]["server"]["listen"], "127.0.0.1:0");
    assert_eq!(printed["sources"]["server"]["listen"], serde_json::json!({ "source": "command line" }));
    assert_eq!(printed["sources"]["archive"]["url"]["variable"], "MOLMESH__ARCHIVE__URL");
    assert_eq!(printed["sources"]["jobs"]["queue"]["source"], "default");
    for (section, keys) in printed["config"].as_object().unwrap() {
        let of = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        assert_eq!(of(keys), of(&printed["sources"][section]), "{section}");
    }
    assert_eq!(stdout(&run(["config", "schema"])), format!("{:#}\n", molmesh::config::schema()));
    assert_code(&run(["config", "print", "--set", "jobs.worker=1"]), 2);
}

#[test]
fn secrets_are_printed_as_set_only() {
    let folder = Folder::new();
    let file = folder.file("molmesh.toml", "[store]\nsecret_access_key = \"hush-one\"\n");
    let secret = secret_file(&folder, "hush-two");
    let variable = "MOLMESH__STORE__SECRET_ACCESS_KEY";
    let file_variable = format!("{variable}_FILE");
    for format in ["toml", "json"] {
        let print = |set: &dyn Fn(&mut std::process::Command)| {
            let mut command = molmesh();
            command.args(["config", "print", "--format", format, "--set", "archive.proxy=http://me:hush-three@p:1"]);
            set(&mut command);
            let done = command.output().unwrap();
            assert_code(&done, 0);
            stdout(&done)
        };
        let from_file = print(&|command| {
            command.arg("--config").arg(&file);
        });
        let from_env = print(&|command| {
            command.env(variable, "hush-one");
        });
        let named = print(&|command| {
            command.env(&file_variable, &secret);
        });
        for (text, source) in [
            (&from_file, file.display().to_string()),
            (&from_env, variable.to_owned()),
            (&named, file_variable.clone()),
        ] {
            assert!(!text.contains("hush"), "{text}");
            assert!(text.contains(&source), "no {source} in\n{text}");
        }
        if format == "json" {
            let printed: Value = serde_json::from_str(&named).unwrap();
            let of = &printed["sources"]["store"]["secret_access_key"];
            assert_eq!((&of["hidden"], &of["key"]), (&true.into(), &"secret_access_key_file".into()), "{of}");
            assert!(printed["config"]["store"].get("secret_access_key").is_none());
            assert!(printed["config"]["archive"].get("proxy").is_none());
        } else {
            assert!(from_env.contains("# secret_access_key is set and not shown"), "{from_env}");
        }
    }
    // Errors do not quote secrets either.
    for (key, value) in [("archive.proxy", "ftp://me:hush@p:1"), ("store.secret_access_key", "none")] {
        let message = load(None, [], &pairs(&[(key, value)])).map_or_else(|e| e.to_string(), |_| String::new());
        assert!(!message.contains("hush"), "{message}");
    }
}

#[test]
fn secrets_are_read_from_files_without_one_line_break() {
    let folder = Folder::new();
    let read = |text: &str| {
        let path = folder.file("secret", text).display().to_string();
        let env = pairs(&[("MOLMESH__STORE__SECRET_ACCESS_KEY_FILE", &path)]);
        load(None, env, &[]).map(|loaded| loaded.config.store.secret_access_key.unwrap().reveal().to_owned())
    };
    for (text, secret) in [
        ("key", "key"),
        ("key\n", "key"),
        ("key\r\n", "key"),
        ("key\n\n", "key\n"),
        (" none \n", " none "),
        ("none", "none"),
    ] {
        assert_eq!(read(text).unwrap(), secret, "{text:?}");
    }
    for (text, why) in [("", "it is empty"), ("\n", "it is empty"), (&"x".repeat(70_000), "more than 65536 bytes")] {
        let error = read(text).unwrap_err();
        let message = error.to_string();
        assert!(matches!(error, ConfigError::SecretFile { .. }) && message.contains(why), "{message}");
        for part in ["store.secret_access_key_file", "MOLMESH__STORE__SECRET_ACCESS_KEY_FILE", "secret: "] {
            assert!(message.contains(part), "{message}");
        }
    }
    let of = |path: &Path| {
        let flags = pairs(&[("store.secret_access_key_file", path.to_str().unwrap())]);
        load(None, [], &flags).unwrap_err().to_string()
    };
    assert!(of(Path::new("/no/such/file")).contains("/no/such/file"));
    assert!(of(&folder.path("")).contains("it is a folder"));
}

#[test]
fn a_secret_and_its_file_exclude_each_other() {
    let folder = Folder::new();
    let secret = secret_file(&folder, "hush").display().to_string();
    let file = folder.file("molmesh.toml", "[store]\nsecret_access_key = \"hush\"\n");
    let env = pairs(&[("MOLMESH__STORE__SECRET_ACCESS_KEY_FILE", &secret)]);
    let message = load(Some(&file), env.clone(), &[]).unwrap_err().to_string();
    for part in [
        "`store.secret_access_key`",
        "`store.secret_access_key_file`",
        "molmesh.toml",
        "MOLMESH__STORE__SECRET_ACCESS_KEY_FILE",
    ] {
        assert!(message.contains(part) && !message.contains("hush"), "{message}");
    }
    // Clearing one of them resolves the conflict.
    let cleared = load(Some(&file), env.clone(), &pairs(&[("store.secret_access_key", "none")])).unwrap().config;
    assert_eq!(cleared.store.secret_access_key.unwrap().reveal(), "hush");
    load(Some(&file), env, &pairs(&[("store.secret_access_key_file", "none")])).unwrap();
}

#[test]
fn secret_files_that_all_users_can_read_cause_a_warning() {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = Folder::new();
    let path = folder.file("secret", "hush");
    for (mode, warned) in [(0o400, false), (0o440, false), (0o600, false), (0o444, true), (0o644, true)] {
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
        let flags = pairs(&[("store.secret_access_key_file", path.to_str().unwrap())]);
        let loaded = load(None, [], &flags).unwrap();
        assert_eq!(loaded.warnings.len(), usize::from(warned), "{mode:o}: {:?}", loaded.warnings);
        assert!(loaded.warnings.iter().all(|w| w.contains(path.to_str().unwrap()) && !w.contains("hush")));
        assert_eq!(loaded.source("store.secret_access_key_file"), ConfigSource::Flag);
    }
    // The service logs the warning before it can fail.
    let set = format!("store.secret_access_key_file={}", path.display());
    let blocked = folder.file("blocked", "");
    let done = run([
        "serve",
        "--listen",
        "127.0.0.1:0",
        "--devices",
        "cpu",
        "--set",
        &set,
        "--data-dir",
        blocked.to_str().unwrap(),
    ]);
    assert_eq!(done.status.code(), Some(1), "{}", stderr(&done));
    assert!(stderr(&done).contains("WARN") && stderr(&done).contains("mode 644"), "{}", stderr(&done));
}
