//! Keys and signed URLs from the command line to the service: they work as printed and are not logged.
#![cfg(unix)]

use crate::cli_support;

use std::process::Command;

use cli_support::{Folder, Service, assert_code, molmesh, run, stderr, stdout};

/// Creates a key. Returns the key and its entry for the key file.
fn key(args: &[&str]) -> (String, String) {
    let created = run(["key", "new"].iter().chain(args));
    assert_code(&created, 0);
    (stderr(&created).lines().last().unwrap().to_owned(), stdout(&created))
}

/// Runs curl. Returns the status and the body.
fn curl(args: &[&str]) -> (String, String) {
    let done = Command::new("curl").args(["-sS", "-w", "\n%{http_code}"]).args(args).output().unwrap();
    let reply = String::from_utf8_lossy(&done.stdout).into_owned();
    let (body, status) = reply.rsplit_once('\n').unwrap_or_else(|| panic!("{args:?}: {done:?}"));
    (status.to_owned(), body.to_owned())
}

#[test]
fn keys_and_signed_urls_work_and_are_not_logged() {
    let folder = Folder::new();
    let (text, lines) = key(&["--id", "viewer-1", "--requests", "100", "--window", "1h", "--note", "a \"test\""]);
    assert!(text.starts_with("mm_viewer-1_") && !lines.contains(&text), "{text}\n{lines}");
    for line in
        ["id = \"viewer-1\"", "hash = \"sha256:", "scopes = [\"mesh\", \"read\"]", "requests = 100", "window_s = 3600"]
    {
        assert!(lines.contains(line), "no {line} in\n{lines}");
    }
    let (reader, more) = key(&["--id", "reader", "--group", "viewer-1", "--scopes", "read", "--expires", "90d"]);
    assert!(more.contains("group = \"viewer-1\"") && !lines.contains("group"), "{lines}{more}");
    let file = folder.file("keys.toml", format!("{lines}{more}"));
    let secret = stdout(&run(["key", "signing", "--id", "2030a", "--group", "viewer-1"])).trim().to_owned();
    let config = folder.file("molmesh.toml", format!("[access]\nsigning_secret = \"{secret}\"\n"));
    let (config, file) = (config.to_str().unwrap(), format!("access.keys_file={}", file.display()));
    let service =
        Service::start(&folder, &["--config", config, "--set", &file, "--set", "log.filter=trace", "--log", "json"]);
    let base = format!("http://{}", service.addr);
    let address = format!("{base}/v1/capabilities");
    let signed = stdout(&run(["sign", &address, "--expires", "1h", "--config", config]));
    let signed = signed.trim();
    assert!(
        signed.starts_with(&format!("{address}?expires=")) && signed.contains("&key_id=2030a&signature="),
        "{signed}"
    );

    let bearer = format!("Authorization: Bearer {text}");
    let plain = format!("X-Api-Key: {reader}");
    let broken = format!("X-Api-Key: {}", text.replace("viewer", "other"));
    let cookie = "Cookie: session=chocolate-with-nuts";
    for version in ["--http1.1", "--http2-prior-knowledge"] {
        let ask = |args: &[&str]| curl(&[&[version, "-H", cookie], args].concat());
        assert_eq!(ask(&[&address]).0, "401", "{version}");
        assert_eq!(ask(&["-H", &bearer, &address]).0, "200");
        assert_eq!(ask(&["-H", &plain, &address]).0, "200");
        assert_eq!(ask(&["-H", &plain, "--data-binary", "x", &format!("{base}/v1/meshes")]).0, "403");
        assert_eq!(ask(&["-H", &broken, &address]).0, "401");
        let (status, body) = ask(&[signed]);
        assert!(status == "200" && body.contains("molmesh"), "{status} {body}");
        assert_eq!(ask(&[&format!("{signed}&x=1")]).0, "403");
        assert_eq!(ask(&["-H", &bearer, &format!("{base}/v1/pdb/4pti/surface.glb?resolution=%ff{text}")]).0, "400");
    }
    let (code, log) = service.stop("TERM");
    assert_eq!(code, Some(0), "{log}");
    assert!(
        log.contains("\"level\":\"TRACE\"") && log.contains("viewer-1") && log.contains("/v1/capabilities"),
        "{log}"
    );
    let (_, signature) = signed.split_once("signature=").unwrap();
    let (_, hidden) = secret.split_once(':').unwrap();
    for private in [&text[12..], &reader[10..], "chocolate", signature, hidden] {
        let leak = log.lines().find(|line| line.contains(private));
        assert_eq!(leak, None, "the log contains {private}");
    }
}

#[test]
fn hangup_reloads_the_keys() {
    let folder = Folder::new();
    let (text, lines) = key(&["--id", "a"]);
    let file = folder.file("keys.toml", "");
    let set = format!("access.keys_file={}", file.display());
    let service = Service::start(&folder, &["--set", &set]);
    let address = format!("http://{}/v1/capabilities", service.addr);
    let header = format!("X-Api-Key: {text}");
    assert_eq!(curl(&["-H", &header, &address]).0, "401");
    folder.file("keys.toml", lines);
    service.signal("HUP");
    let start = std::time::Instant::now();
    while curl(&["-H", &header, &address]).0 != "200" {
        assert!(start.elapsed().as_secs() < 60, "the key is still unknown after a minute");
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    let (code, log) = service.stop("TERM");
    assert_eq!(code, Some(0), "{log}");
    assert!(log.contains("reloaded the keys"), "{log}");
}

#[test]
fn invalid_keys_and_urls_are_rejected_with_a_reason() {
    for (args, why) in [
        (&["--id", "A b"][..], "lower-case letters"),
        (&["--id", "a", "--group", "A b"], "parameter `group`"),
        (&["--id", "a", "--scopes", "admin"], "expected mesh, read"),
        (&["--id", "a", "--work", "long"], "parameter `work`"),
        (&["--id", "a", "--window", "1ms"], "parameter `window`"),
        (&["--id", "a", "--expires", "soon"], "parameter `expires`"),
        (&["--id", "a", "--expires", "2001-01-01T00:00:00Z"], "is in the past"),
        (&["--id", "a", "--expires", "-1h"], "parameter `expires`: `-1h` is not allowed; expected a time from now"),
        (&["--id", "a", "--work", "-1h"], "parameter `work`: `-1h` is not allowed"),
        (&["--id", "a", "--window", "1h"], "parameter `window`: `1h` is not allowed; expected a quota per window"),
        (&["--id", "a", "--window", "1h", "--concurrent", "2"], "--requests or --work"),
        (&["--id", "a", "--requests", "0"], "--requests"),
    ] {
        let refused = run(["key", "new"].iter().chain(args));
        assert_eq!(refused.status.code(), Some(2), "{args:?}");
        assert!(stderr(&refused).contains(why), "{}", stderr(&refused));
    }
    let secret = "access.signing_secret=a:0123456789abcdef0123456789abcdef";
    for (args, why) in [
        (&["/x"][..], "molmesh key signing"),
        (&["/x", "--set", "access.signing_secret=a:short"], "fewer than 32"),
        (&["https://host", "--set", secret], "expected http(s)://host/path"),
        (&["/x?a b", "--set", secret], "%XX"),
        (&["/x?signature=1", "--set", secret], "already"),
        (&["/x", "--set", secret, "--key-id", "b"], "expected one of a"),
        (&["/x", "--set", secret, "--expires", "0s"], "parameter `expires`"),
        (&["/x", "--set", secret, "--expires", "-1h"], "`-1h` is not allowed; expected a time from now such as 1h"),
        (&["/v1/capabilities", "--set", secret, "--expires", "2001-01-01T00:00:00Z"], "is in the past"),
        (&["/nonexistent", "--set", secret], "no such path"),
        (&["http://host/v1/meshes", "--set", secret], "GET only"),
        (&["/v1/pdb/4pti/surface.glb?sginature=1", "--set", secret], "unknown parameter `sginature`"),
    ] {
        let refused = run(["sign"].iter().chain(args));
        assert_code(&refused, 2);
        assert!(
            stderr(&refused).contains(why) && !stderr(&refused).contains("0123456789abcdef"),
            "{}",
            stderr(&refused)
        );
    }
    let folder = Folder::new();
    let file = folder.file("keys.toml", "[[key]]\nid = \"a\"\nscope = [\"read\"]\n");
    let set = format!("access.keys_file={}", file.display());
    let refused =
        molmesh().args(["serve", "--listen", "127.0.0.1:0", "--backend", "cpu", "--set", &set]).output().unwrap();
    assert_code(&refused, 2);
    assert!(stderr(&refused).contains("line 3: unknown name `scope`; did you mean `scopes`?"), "{}", stderr(&refused));
}
