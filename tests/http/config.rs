//! Layers of the configuration and their errors; the parameter table compared with the ranges of the core.

use std::path::Path;

use crate::defaults::choices;
use molmesh::config::{Config, ConfigError, LogFormat, load};
use molmesh::pipeline::params::{Domain, ParamError, TABLE, canonical, parse};

fn pairs(list: &[(&str, &str)]) -> Vec<(String, String)> {
    list.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect()
}

fn file(text: &str) -> tempfile::NamedTempFile {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    file
}

#[test]
fn the_example_is_the_default_and_complete() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("molmesh.example.toml");
    assert_eq!(load(Some(&path), [], &[]).unwrap().config, Config::default());
    let text = std::fs::read_to_string(path).unwrap();
    let defaults = serde_json::to_value(Config::default()).unwrap();
    for (section, keys) in defaults.as_object().unwrap() {
        assert!(text.contains(&format!("[{section}]")), "{section}");
        for key in keys.as_object().unwrap().keys() {
            assert!(text.contains(&format!("\n{key} = ")), "{section}.{key}");
        }
    }
}

#[test]
fn later_layers_override_earlier_ones() {
    let file = file("[jobs]\nworkers = 3\nqueue = 5\ndeadline_ms = 7\n[log]\nformat = \"json\"\n");
    let env = pairs(&[
        ("MOLMESH__JOBS__QUEUE", "6"),
        ("MOLMESH__JOBS__DEADLINE_MS", "8"),
        ("MOLMESH__LIMITS__BODY_BYTES", "1MiB"),
        ("MOLMESH__SERVER__METRICS_LISTEN", "127.0.0.1:9"),
        ("HOME", "/root"),
        ("MOLMESH_OTHER", "x"),
    ]);
    let flags = pairs(&[("jobs.deadline_ms", "9"), ("server.metrics_listen", "none"), ("archive.dir", "/pdb")]);
    let config = load(Some(file.path()), env, &flags).unwrap().config;
    assert_eq!((config.jobs.workers, config.jobs.queue, config.jobs.deadline_ms), (3, 6, 9));
    assert_eq!((config.limits.body_bytes, config.log.format), (1 << 20, LogFormat::Json));
    assert_eq!((config.server.metrics_listen, config.archive_dir()), (None, "/pdb".into()));
    assert_eq!(Config::default().archive_dir(), Path::new("molmesh-data/archive"));
}

#[test]
fn archives_are_configured_as_text_or_as_a_list() {
    let urls = |config: &Config| config.archive.url.as_ref().map(ToString::to_string);
    let both = Some("http://a/{id} http://b/{middle}/{id_upper}".to_owned());
    let list = file("[archive]\nurl = [\"http://a/{id}\", \"http://b/{middle}/{id_upper}\"]\nallow_private = true\n");
    let config = load(Some(list.path()), [], &[]).unwrap().config;
    assert_eq!((urls(&config), config.archive.allow_private), (both.clone(), true));
    let env = pairs(&[
        ("MOLMESH__ARCHIVE__URL", "http://a/{id} http://b/{middle}/{id_upper}"),
        ("MOLMESH__ARCHIVE__ALLOW_PRIVATE", "true"),
        ("MOLMESH__ARCHIVE__PROXY", "http://p:3128"),
    ]);
    let config = load(None, env, &[]).unwrap().config;
    assert_eq!((urls(&config), config.archive.allow_private), (both, true));
    assert_eq!(config.archive.proxy.unwrap().as_str(), "http://p:3128");
    let off = load(None, pairs(&[("MOLMESH__ARCHIVE__URL", "none")]), &[]).unwrap().config;
    assert_eq!((urls(&off), urls(&Config::default()).is_some()), (None, true));
}

#[test]
fn errors_of_unknown_keys_name_the_nearest_key_and_the_source() {
    for (text, env, flag, key, near, from) in [
        ("[limits]\nbody_byte = 1", None, None, "limits.body_byte", "limits.body_bytes", ".tmp"),
        ("[limit]\natoms = 1", None, None, "limit.atoms", "limits.atoms", ".tmp"),
        ("queue = 3", None, None, "queue", "jobs.queue", ".tmp"),
        ("", Some("MOLMESH__JOBS__WORKER"), None, "jobs.worker", "jobs.workers", "MOLMESH__JOBS__WORKER"),
        ("", Some("MOLMESH__LISTEN"), None, "listen", "server.listen", "MOLMESH__LISTEN"),
        // A fixed value has no key.
        ("[server]\nheader_timeout_ms = 1", None, None, "server.header_timeout_ms", "", ".tmp"),
        ("", Some("MOLMESH__STORE__SWEEP_MS"), None, "store.sweep_ms", "", "MOLMESH__STORE__SWEEP_MS"),
        ("", None, Some("jobs.deliveries"), "jobs.deliveries", "", "command line"),
        ("", None, Some("server.lisen"), "server.lisen", "server.listen", "command line"),
        ("", None, Some("server"), "server", "", "command line"),
    ] {
        let file = file(text);
        let env = env.map(|name| (name.to_owned(), "1".to_owned()));
        let flags = flag.map(|path| pairs(&[(path, "1")])).unwrap_or_default();
        let error = load(Some(file.path()), env, &flags).unwrap_err();
        let message = error.to_string();
        let ConfigError::UnknownKey { key: named, nearest, .. } = error else { panic!("{message}") };
        assert_eq!(named, key);
        if !near.is_empty() {
            assert_eq!(nearest.as_deref(), Some(near), "{message}");
        }
        assert!(message.contains(from), "{message}");
    }
}

#[test]
fn errors_of_bad_values_name_key_value_and_expected_range() {
    for (key, value) in [
        ("jobs.workers", "many"),
        ("jobs.workers", "0"),
        ("jobs.workers", "-1"),
        ("jobs.queue", "5MiB"),
        ("jobs.queue", "none"),
        ("server.termination_notice_ms", "0"),
        ("limits.body_bytes", "5 MB"),
        ("limits.body_bytes", "99999999999GiB"),
        ("server.listen", "localhost"),
        ("server.listen", "none"),
        ("log.format", "xml"),
        ("archive.url", ""),
        ("archive.url", "file:///pdb/{id}"),
        ("archive.url", "https://h/4pti.cif"),
        ("archive.proxy", "proxy"),
        ("archive.allow_private", "maybe"),
        ("server.trusted_proxies", "proxy"),
        ("access.address_requests", "many"),
        ("access.address_requests", "0"),
        ("access.address_work_s", "-1"),
        ("access.cors_origins", "https://viewer.example/"),
        ("access.cors_credentials", "perhaps"),
    ] {
        let message = load(None, [], &pairs(&[(key, value)])).unwrap_err().to_string();
        assert!(message.contains(key) && message.contains("expected") && message.contains("command line"), "{message}");
    }
    let broken = file("[server\nlisten = 3");
    assert!(load(Some(broken.path()), [], &[]).unwrap_err().to_string().contains("line 1"));
    let wrong = file("[jobs]\nworkers = 1.5");
    assert!(load(Some(wrong.path()), [], &[]).unwrap_err().to_string().contains("jobs.workers"));
    assert!(load(Some(Path::new("/nowhere.toml")), [], &[]).unwrap_err().to_string().contains("/nowhere.toml"));
}

#[test]
fn optional_numbers_are_cleared_by_none_and_set_again() {
    let notice = |flags: &[(&str, &str)]| load(None, [], &pairs(flags)).unwrap().config.server.termination_notice_ms;
    assert_eq!(notice(&[]), Some(3000));
    assert_eq!(notice(&[("server.termination_notice_ms", "none")]), None);
    let again = [("server.termination_notice_ms", "none"), ("server.termination_notice_ms", "5_000")];
    assert_eq!(notice(&again), Some(5000));
}

#[test]
fn optional_counts_are_read_from_every_layer() {
    let requests = |flags: &[(&str, &str)]| load(None, [], &pairs(flags)).unwrap().config.access.address_requests;
    assert_eq!(requests(&[]), None);
    assert_eq!(requests(&[("access.address_requests", "1_000")]), Some(1000));
    assert_eq!(requests(&[("access.address_requests", "5"), ("access.address_requests", "none")]), None);
    let lists = file(
        "[access]\naddress_requests = 7\ncors_origins = [\"https://a.example\", \"http://b.example:81\"]\n\
         [server]\ntrusted_proxies = [\"10.0.0.0/8\", \"::1\"]",
    );
    let config = load(Some(lists.path()), [], &[]).unwrap().config;
    assert_eq!(config.access.address_requests, Some(7));
    assert_eq!(config.access.cors_origins.unwrap().to_string(), "https://a.example http://b.example:81");
    assert!(config.server.trusted_proxies.unwrap().contains("10.9.9.9".parse().unwrap()));
    let off = load(None, [], &pairs(&[("access.cors_origins", "none")])).unwrap().config;
    assert_eq!(off.access.cors_origins, None);
    // The secret is not printed.
    let config = load(None, pairs(&[("MOLMESH__ACCESS__SIGNING_SECRET", "a:geheim")]), &[]).unwrap().config;
    assert_eq!(config.access.signing_secret.as_ref().unwrap().reveal(), "a:geheim");
    assert!(!format!("{config:?}").contains("geheim"));
}

#[test]
fn the_table_and_the_core_agree_on_every_range() {
    let mut numbers = 0;
    for parameter in TABLE {
        let Domain::Number { min, max, .. } = parameter.domain else { continue };
        if parameter.name.starts_with("paper_") {
            continue;
        }
        numbers += 1;
        // Only some surfaces and pockets have a probe, and only colours by a map an offset.
        let others: &[(&str, &str)] = match parameter.name {
            "probe" => &[("surface", "ses")],
            "pocket_probe" => &[("pockets", "true"), ("surface", "ses"), ("probe", "0.7")],
            "color_offset" => &[("color", "map")],
            _ => &[],
        };
        let give = |value: f64| {
            let others = others.iter().map(|(name, value)| (*name, (*value).to_owned()));
            parse(others.chain([(parameter.name, value.to_string())]))
        };
        for good in [min, max] {
            give(good).unwrap_or_else(|e| panic!("{e}"));
        }
        for bad in [min - min.abs() * 1e-3 - 1e-9, max * (1.0 + 1e-9)] {
            assert!(matches!(give(bad), Err(ParamError::BadValue { .. })), "{} {bad}", parameter.name);
        }
    }
    assert_eq!(numbers, 12);
    let mut integers = 0;
    for parameter in TABLE {
        let Domain::Integer { min, max } = parameter.domain else { continue };
        integers += 1;
        // A unit is that of an assembly.
        let assembly = (parameter.name == "unit").then(|| ("assembly", "1".to_owned()));
        let give = |value: i64| parse(assembly.clone().into_iter().chain([(parameter.name, value.to_string())]));
        for (good, bad) in [(min, min - 1), (max, max + 1)] {
            give(good).unwrap_or_else(|e| panic!("{e}"));
            assert!(matches!(give(bad), Err(ParamError::BadValue { .. })), "{} {bad}", parameter.name);
        }
    }
    assert_eq!(integers, 5);
    // The ranges of the paper depend on the kernel: the table contains their union.
    let hull = |name: &str| TABLE.iter().find(|p| p.name == name).unwrap().domain;
    for (kernel, a, b) in [("gaussian", [1e-3, 100.0], [1e-2, 1e6]), ("soft-object", [1e-2, 1e6], [0.1, 50.0])] {
        for (x, y) in [(a[0], b[0]), (a[1], b[1])] {
            let given = [("surface", kernel.to_owned()), ("paper_a", x.to_string()), ("paper_b", y.to_string())];
            parse(given).unwrap_or_else(|e| panic!("{e}"));
            for (name, value) in [("paper_a", x), ("paper_b", y)] {
                let Domain::Number { min, max, .. } = hull(name) else { panic!() };
                assert!((min..=max).contains(&value));
            }
        }
    }
}

#[test]
fn canonical_texts_differ_exactly_if_the_jobs_differ() {
    let text = |list: &[(&str, &str)]| canonical(&parse(list.iter().copied()).unwrap().options);
    let plain = text(&[]);
    // The same job with equivalent parameters.
    for same in [
        &[("resolution", "0.50")][..],
        &[("surface", "gaussian"), ("preset", "default")],
        &[("select", "polymer")],
        &[("select", "nucleic or (protein or polymer)")],
        &[("format", "stl")],
        &[("compress", "none")],
        &[("normals", "smooth")],
        &[("units", "angstrom")],
        &[("isovalue", "1e0")],
    ] {
        assert_eq!(text(same), plain, "{same:?}");
    }
    let mut seen = vec![plain];
    let others = [
        &[("resolution", "0.51")][..],
        &[("select", "polymer,ligand")],
        &[("select", "all")],
        &[("select", "polymer,hydrogens")],
        &[("select", "chain A")],
        &[("select", "resn \"A&chains=B\"")],
        &[("chains", "A")],
        &[("chains", "A,B")],
        &[("model", "2")],
        &[("altloc", "B")],
        &[("assembly", "1")],
        &[("instances", "true"), ("assembly", "1")],
        &[("unit", "1"), ("assembly", "1")],
        &[("atom_ids", "true")],
        // The same spacing for a small structure, different ones for a large one.
        &[("detail", "4")],
        &[("detail", "3")],
        &[("max_triangles", "40000")],
        &[("max_triangles", "40001")],
        &[("paper_a", "1"), ("paper_b", "2")],
        &[("paper_a", "2"), ("paper_b", "1")],
        &[("surface", "ses"), ("probe", "1.5")],
    ];
    let choices = choices().into_iter().filter(|other| other[0].0 != "check");
    for other in others.into_iter().map(<[_]>::to_vec).chain(choices) {
        let text = text(&other);
        assert!(!seen.contains(&text), "{other:?}");
        seen.push(text);
    }
}

#[test]
fn variables_without_two_underscores_are_reported() {
    let warnings = |name: &str| load(None, pairs(&[(name, "7")]), &[]).unwrap().warnings;
    for name in ["MOLMESH_LIMITS_ATOMS", "MOLMESH_LIMITS__ATOMS", "MOLMESH_limits_atoms"] {
        let [warning] = &warnings(name)[..] else { panic!("{name}: {:?}", warnings(name)) };
        assert!(warning.contains(name) && warning.contains(" MOLMESH__LIMITS__ATOMS,"), "{warning}");
    }
    let [of_many] = &warnings("MOLMESH_SERVER_DRAIN_TIMEOUT_MS")[..] else { panic!("one warning") };
    assert!(of_many.contains(" MOLMESH__SERVER__DRAIN_TIMEOUT_MS,"), "{of_many}");
    for name in ["MOLMESH_CONFIG", "MOLMESH_KEY", "LIMITS_ATOMS", "OTHER_LIMITS_ATOMS"] {
        assert_eq!(warnings(name), [""; 0], "{name}");
    }
    assert_eq!(load(None, pairs(&[("MOLMESH_LIMITS_ATOMS", "7")]), &[]).unwrap().config, Config::default());
}

#[test]
fn syntax_errors_do_not_quote_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let error = |text: &str| {
        let path = folder.path().join("molmesh.toml");
        std::fs::write(&path, text).unwrap();
        let message = load(Some(&path), pairs(&[]), &[]).unwrap_err().to_string();
        assert!(!message.contains("hush"), "{message}");
        message.split_once(" is not valid TOML: ").unwrap().1.to_owned()
    };
    for (text, position) in [
        ("[store]\nsecret_access_key = \"hush\n", "line 2, column 26, key `secret_access_key`: "),
        ("[store]\nsecret_access_key = hush\n", "line 2, column 21, key `secret_access_key`: "),
        ("[access]\nsigning_secret = \"é\" hush", "line 2, column 22, key `signing_secret`: "),
        ("hush = = 1", "line 1, column 8: "),
        ("hush", "line 1, column "),
        ("\n\n[hush", "line 3, column "),
    ] {
        let message = error(text);
        assert!(message.starts_with(position), "{text:?}: {message}");
    }
}
