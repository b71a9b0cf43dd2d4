//! Consistency of the deployment with itself and the program: Dockerfile, Compose, Kubernetes, configurations.
#![cfg(unix)]

use crate::cli_support;
use crate::deploy_support;
use crate::tools;

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;

use deploy_support::{Recipe, at, bytes, kinds, only, read, root, sections, strings, under, yaml};
use molmesh::config::{Config, Role, load};
use molmesh::telemetry::BROKER_QUEUED;
use serde_json::{Value, json};

/// User id of the service in a container.
const USER: u64 = 65532;
/// Seconds between the end of the drain and SIGKILL.
const MARGIN: u64 = 5;
/// Memory of the process in addition to its configured budgets, bytes.
const OTHER_MEMORY: u64 = 1 << 30;

const CONFIGURATIONS: [&str; 2] = ["deploy/container/molmesh.toml", "deploy/kubernetes/base/molmesh.toml"];

fn recipe() -> Recipe {
    Recipe::parse(&read("Dockerfile"))
}

fn config(path: &str) -> Config {
    load(Some(&root().join(path)), [], &[]).unwrap_or_else(|e| panic!("{path}: {e}")).config
}

/// Returns the ports of the service and of its metrics.
fn ports(config: &Config) -> [u16; 2] {
    let address = |a: SocketAddr| {
        assert!(a.ip().is_unspecified(), "{a} cannot be reached from outside the container");
        a.port()
    };
    [address(config.server.listen), address(config.server.metrics_listen.unwrap())]
}

// ------------------------------------------------------------------------------------------------------- image

#[test]
fn dockerfile_matches_its_configuration() {
    let recipe = recipe();
    let stages = ["cpu", "gpu"].map(|name| recipe.stage(name));
    for stage in &stages {
        assert_eq!(stage.last("USER"), Some(&format!("{USER}:{USER}")), "user of {}", stage.name);
    }
    let [cpu, gpu] = stages;
    assert_eq!(gpu.from, "cpu");
    let config = config(CONFIGURATIONS[0]);
    assert_eq!(cpu.last("EXPOSE").unwrap(), &ports(&config).map(|p| p.to_string()).join(" "));
    assert_eq!(cpu.last("VOLUME").map(Path::new), Some(config.server.data_dir.as_path()));
    let copied = format!("{} /etc/molmesh/molmesh.toml", CONFIGURATIONS[0]);
    assert!(cpu.all("COPY").any(|line| *line == copied), "the configuration is not copied");
    assert_eq!(cpu.last("CMD").unwrap(), r#"["serve"]"#);
    assert_eq!(cpu.last("ENV").unwrap(), "MOLMESH_CONFIG=/etc/molmesh/molmesh.toml");
    assert_eq!(cpu.last("ENTRYPOINT").unwrap(), r#"["molmesh"]"#);
    // The default address of the check is that of the configuration.
    assert!(cpu.last("HEALTHCHECK").unwrap().ends_with(r#"CMD ["molmesh", "healthcheck"]"#));
    let help = cli_support::stdout(&cli_support::run(["healthcheck", "--help"]));
    assert!(help.contains(&format!("http://127.0.0.1:{}/readyz", config.server.listen.port())), "{help}");
    // A shell would not forward signals to the program.
    for name in ["CMD", "ENTRYPOINT"] {
        assert!(cpu.all(name).chain(gpu.all(name)).all(|line| line.starts_with('[')), "{name} starts a shell");
    }
}

#[test]
fn dockerfile_uses_the_compiler_of_the_package() {
    let manifest: toml::Table = read("Cargo.toml").parse().unwrap();
    let version = manifest["workspace"]["package"]["rust-version"].as_str().unwrap();
    let image = recipe().argument("RUST_IMAGE").unwrap();
    let (_, tag) = image.rsplit_once(':').unwrap();
    assert!(tag.starts_with(&format!("{version}-")), "{image} is not Rust {version}");
    let base = recipe().argument("BASE_IMAGE").unwrap();
    let suite = base.rsplit_once(':').unwrap().1.strip_suffix("-slim").unwrap().to_owned();
    assert!(tag.ends_with(&suite), "a build on {image} may not run on {base}");
}

/// Returns the files that the build reads, relative to the root: sources, shaders, files that sources name by a
/// relative path (`"../web/…"`), and the targets of the package, without which cargo rejects it.
fn read_by_the_build() -> BTreeSet<PathBuf> {
    let mut files: BTreeSet<PathBuf> =
        ["src", "crates", "shaders"].into_iter().flat_map(deploy_support::files).collect();
    let named: Vec<PathBuf> = files
        .iter()
        .filter(|path| path.extension().is_some_and(|extension| extension == "rs"))
        .flat_map(|path| {
            let folder = path.parent().unwrap().to_owned();
            let text = std::fs::read_to_string(root().join(path)).unwrap();
            let literals: Vec<String> = text.split('"').filter(|l| l.starts_with("../")).map(str::to_owned).collect();
            literals.into_iter().map(move |literal| deploy_support::plain(&folder.join(literal)))
        })
        .filter(|path| root().join(path).is_file())
        .collect();
    assert!(named.iter().any(|path| path.starts_with("web")), "no web page in {named:?}");
    let manifest: toml::Table = read("Cargo.toml").parse().unwrap();
    let benches = manifest["bench"].as_array().unwrap().iter();
    let benches = benches.map(|bench| PathBuf::from(format!("benches/{}.rs", bench["name"].as_str().unwrap())));
    files.extend(named.into_iter().chain(benches));
    files
}

#[test]
fn all_files_of_the_build_are_sent_to_the_builder() {
    let ignore = read(".dockerignore");
    let mut files = read_by_the_build();
    assert!(files.len() > 100, "only {} files", files.len());
    let more = [
        "Cargo.toml",
        "Cargo.lock",
        "build.rs",
        "LICENSE-MIT",
        "LICENSE-APACHE",
        "web/swagger/NOTICE",
        "web/build.sh",
        "bench/Cargo.toml",
        "bench/src/main.rs",
        "fuzz/Cargo.toml",
        "fuzz/src/main.rs",
    ];
    files.extend(more.into_iter().chain([CONFIGURATIONS[0], "deploy/notices.py"]).map(PathBuf::from));
    let left_out: Vec<_> = files.iter().filter(|path| !deploy_support::sent(&ignore, path)).collect();
    assert!(left_out.is_empty(), "not sent to the builder: {left_out:?}");
    for other in [
        ".git/config",
        "target/release/molmesh",
        "tests/cli/deploy.rs",
        "bench/src/device.rs",
        "web/node_modules/x/y.js",
        "web/dist/index.html.gz",
    ] {
        assert!(!deploy_support::sent(&ignore, Path::new(other)), "{other} is sent to the builder");
    }
}

#[test]
fn copied_files_exist_and_are_sent() {
    let ignore = read(".dockerignore");
    let mut n = 0;
    for stage in &recipe().stages {
        for line in stage.all("COPY").filter(|line| !line.starts_with("--from")) {
            let words: Vec<&str> = line.split_whitespace().collect();
            for file in words[..words.len() - 1].iter().filter(|file| ![".", "dist/image/"].contains(*file)) {
                assert!(root().join(file).is_file(), "{file}");
                assert!(deploy_support::sent(&ignore, Path::new(file)), "{file} is not sent");
                n += 1;
            }
        }
    }
    assert!(n >= 3, "{n} files");
}

// ------------------------------------------------------------------------------------------------- configurations

#[test]
fn configurations_load_and_listen_on_all_addresses() {
    for path in CONFIGURATIONS {
        let config = config(path);
        assert_eq!(ports(&config), [8080, 9090], "{path}");
        assert_eq!(config.server.data_dir, Path::new("/data"), "{path}");
    }
}

// --------------------------------------------------------------------------------------------------------- Compose

#[test]
fn compose_matches_the_image() {
    let Some(found) = yaml(&["deploy/compose.yaml"]) else { return };
    assert_eq!(found[0].errors, [""; 0]);
    let compose = &found[0].documents[0];
    let config = config(CONFIGURATIONS[0]);
    let services = compose["services"].as_object().unwrap();
    assert_eq!(services.keys().collect::<Vec<_>>(), ["cpu", "gpu"]);
    for (name, service) in services {
        assert_eq!(service["profiles"], json!([name]));
        assert_eq!(service["build"], json!({ "context": "..", "target": name }));
        assert_eq!(service["user"], json!(format!("{USER}:{USER}")));
        assert_eq!((&service["read_only"], &service["cap_drop"]), (&json!(true), &json!(["ALL"])));
        assert_eq!(service["healthcheck"]["test"], json!(["CMD", "molmesh", "healthcheck"]));
        let volumes = strings(&service["volumes"]);
        assert_eq!(volumes, [format!("data:{}", config.server.data_dir.display())]);
        let inside: Vec<u16> =
            strings(&service["ports"]).iter().map(|p| p.rsplit_once(':').unwrap().1.parse().unwrap()).collect();
        assert_eq!(inside, ports(&config));
        // Both are published on the loopback address unless configured.
        let published = strings(&service["ports"]);
        assert!(published[0].starts_with("${MOLMESH_ADDRESS:-127.0.0.1}:") && published[1].starts_with("127.0.0.1:"));
        assert_eq!(service["environment"]["MOLMESH__SERVER__HOSTS"], json!("${MOLMESH_HOSTS:-localhost}"));
        assert_eq!(service["secrets"][0]["target"], json!("/etc/molmesh/molmesh.toml"));
        let grace = service["stop_grace_period"].as_str().unwrap().strip_suffix('s').unwrap().parse::<u64>().unwrap();
        assert!(grace >= config.server.drain_timeout_ms / 1000 + MARGIN, "{grace} s to stop");
        let memory = service["deploy"]["resources"]["limits"]["memory"].as_str().unwrap();
        let default = memory.trim_end_matches('}').rsplit_once(":-").unwrap().1;
        assert!(bytes(default) >= budget(&config), "{memory}");
    }
    let gpu = &services["gpu"]["deploy"]["resources"]["reservations"]["devices"][0];
    let capabilities: BTreeSet<_> = strings(&gpu["capabilities"]).into_iter().collect();
    assert!(capabilities.contains("graphics"), "the Vulkan driver needs this capability");
    let secret = compose["secrets"]["configuration"]["file"].as_str().unwrap();
    let default = secret.trim_end_matches('}').rsplit_once(":-").unwrap().1;
    assert_eq!(Path::new("deploy").join(default), Path::new("deploy/./container/molmesh.toml"));
}

#[test]
fn compose_of_a_cluster_sets_existing_keys() {
    let Some(found) = yaml(&["deploy/compose.cluster.yaml"]) else { return };
    assert_eq!(found[0].errors, [""; 0]);
    let services = found[0].documents[0]["services"].as_object().unwrap();
    let mut roles = Vec::new();
    for (name, service) in services.iter().filter(|(name, _)| *name != "nats") {
        let environment = service["environment"].as_object().unwrap();
        let set = environment.iter().map(|(key, value)| (key.clone(), value.as_str().unwrap().to_owned()));
        // Variables of Compose have their values when it starts.
        let environment = set.filter(|(_, value)| !value.starts_with("${"));
        let config = load(None, environment, &[]).unwrap().config;
        assert_eq!(config.broker.url.as_deref(), Some("nats://nats:4222"), "{name}");
        let folder = config.store.url.unwrap();
        let volume = service["volumes"][0].as_str().unwrap().split(':').nth(1).unwrap();
        assert!(folder.starts_with(&format!("file://{volume}/")), "{name}: {folder} is not in the volume {volume}");
        roles.push(config.server.role);
    }
    assert_eq!(roles, [Role::Api, Role::Worker]);
}

/// Renders the Helm chart with `settings`. Returns the documents, or the message of the error.
fn chart(settings: &[&str]) -> Option<Result<String, String>> {
    let program = root().join("target/test-tools/venv/bin/helm");
    if !program.exists() {
        return tools::skip("helm is missing; run tests/tools/setup.sh");
    }
    let mut command = Command::new(program);
    command.args(["template", "surfaces"]).arg(root().join("deploy/helm/molmesh"));
    let output = command.args(settings.iter().flat_map(|set| ["--set", set])).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    Some(if output.status.success() { Ok(text(output.stdout)) } else { Err(text(output.stderr)) })
}

#[test]
fn the_chart_renders_valid_manifests() {
    let shared = ["broker.url=nats://nats:4222", "store.url=s3://meshes"];
    let Some(rendered) = chart(&shared) else { return };
    let folder = cli_support::Folder::new();
    let keda = chart(&[&shared[..], &["keda.enabled=true", "broker.secret=nats"]].concat()).unwrap();
    let files = [rendered, keda].map(Result::unwrap);
    let names = ["chart.yaml", "keda.yaml"];
    let files: Vec<_> = names.iter().zip(&files).map(|(name, text)| folder.file(name, text)).collect();
    let Some(found) = yaml(&files) else { return };
    assert_eq!(found[0].errors, [""; 0]);
    // The schema of Kubernetes lacks the kinds of KEDA.
    assert_eq!(found[1].errors, ["no such kind: keda.sh/v1alpha1 ScaledObject"]);
    let kinds = |n: usize| -> BTreeSet<&str> {
        found[n].documents.iter().map(|document| document["kind"].as_str().unwrap()).collect()
    };
    for kind in ["Deployment", "Service", "HorizontalPodAutoscaler", "PodDisruptionBudget", "NetworkPolicy"] {
        assert!(kinds(0).contains(kind), "no {kind}");
    }
    assert!(kinds(1).contains("ScaledObject"));
    let kind = |n: usize, kind: &str| found[n].documents.iter().find(|document| document["kind"] == kind).unwrap();
    let triggers = kind(1, "ScaledObject")["spec"]["triggers"].as_array().unwrap();
    let [trigger] = &triggers[..] else { panic!("one number for each kind of workers") };
    assert_eq!(trigger["metadata"]["valueLocation"], BROKER_QUEUED);
    assert_eq!(trigger["metadata"]["url"], "http://surfaces.default:9090/metrics");
    // Only the autoscalers need the metrics of the service.
    let has_metrics = |n: usize| {
        let ports = kind(n, "Service")["spec"]["ports"].as_array().unwrap();
        ports.iter().any(|port| port["name"] == "metrics" && port["port"] == 9090)
    };
    assert_eq!([0, 1].map(has_metrics), [false, true]);
    // The configuration of the pods is valid.
    let map = kind(0, "ConfigMap");
    let file = folder.file("molmesh.toml", map["data"]["molmesh.toml"].as_str().unwrap());
    let config = load(Some(&file), [], &[]).unwrap().config;
    assert_eq!((config.broker.url.as_deref(), config.broker.replicas), (Some("nats://nats:4222"), 3));
    assert!(config.access.keys_file.is_some());
    // Control: without a queue or a store nothing is rendered.
    for (setting, missing) in [(shared[0], "store.url is required"), (shared[1], "broker.url is required")] {
        assert!(chart(&[setting]).unwrap().unwrap_err().contains(missing));
    }
}

/// Returns the memory that a configuration allows, bytes.
fn budget(config: &Config) -> u64 {
    config.limits.memory_bytes + config.store.memory_bytes + OTHER_MEMORY
}

// ------------------------------------------------------------------------------------------------------ Kubernetes

const BASE: &str = "deploy/kubernetes/base";

#[test]
fn manifests_match_the_schemas_of_kubernetes() {
    let resources = under("deploy/kubernetes", |kustomization, folder| {
        strings(&kustomization["resources"]).into_iter().map(|file| folder.join(file)).collect()
    });
    let Some(resources) = resources else { return };
    let files: Vec<_> = resources.iter().filter(|path| root().join(path).is_file()).collect();
    let found = yaml(&files).unwrap();
    for (path, manifest) in files.iter().zip(&found) {
        assert_eq!(manifest.errors, [""; 0], "{}", path.display());
    }
    let names: BTreeSet<_> = found.iter().flat_map(|m| &m.documents).map(|d| d["kind"].as_str().unwrap()).collect();
    for kind in [
        "Deployment",
        "Service",
        "PersistentVolumeClaim",
        "PodDisruptionBudget",
        "HorizontalPodAutoscaler",
        "NetworkPolicy",
    ] {
        assert!(names.contains(kind), "no {kind}");
    }
}

#[test]
fn kustomizations_name_existing_files() {
    let listed = under("deploy/kubernetes", |kustomization, folder| {
        let generated = kustomization["configMapGenerator"].as_array().into_iter().flatten();
        let patches = kustomization["patches"].as_array().into_iter().flatten();
        let mut files: Vec<String> = strings(&kustomization["resources"]);
        files.extend(generated.flat_map(|map| strings(&map["files"])));
        files.extend(patches.map(|patch| patch["path"].as_str().unwrap().to_owned()));
        files.into_iter().map(|file| folder.join(file)).collect()
    });
    let Some(listed) = listed else { return };
    for path in &listed {
        assert!(root().join(path).exists(), "{}", path.display());
    }
    // Every file is listed in a kustomization.
    let mut n = 0;
    for folder in ["base", "scaled", "gpu"].map(|name| root().join("deploy/kubernetes").join(name)) {
        for file in std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()) {
            let path = file.strip_prefix(root()).unwrap().to_owned();
            assert!(
                path.ends_with("kustomization.yaml") || listed.contains(&path),
                "{} is in no kustomization",
                path.display()
            );
            n += 1;
        }
    }
    assert!(n >= 15, "{n} files");
    // Patches change resources of the base.
    let Some(base) = kinds(BASE) else { return };
    for overlay in ["scaled", "gpu"] {
        let folder = format!("deploy/kubernetes/{overlay}");
        let patches = kinds(&folder).unwrap();
        assert!(!patches.is_empty());
        for (kind, name) in patches.iter().filter(|(kind, _)| kind != "HorizontalPodAutoscaler") {
            assert!(base.contains(&(kind.clone(), name.clone())), "{overlay} patches {kind} {name}");
        }
    }
}

#[test]
fn pod_matches_the_image_and_its_configuration() {
    let Some(found) = yaml(&["deployment", "storage", "service", "network"].map(|f| format!("{BASE}/{f}.yaml"))) else {
        return;
    };
    let [deployment, storage, service, network] = only(&found);
    let config = config(CONFIGURATIONS[1]);
    let pod = &deployment["spec"]["template"]["spec"];
    let container = &pod["containers"][0];
    for field in ["runAsUser", "runAsGroup", "fsGroup"] {
        assert_eq!(pod["securityContext"][field], json!(USER), "{field}");
    }
    let security = &container["securityContext"];
    assert_eq!(
        (&security["readOnlyRootFilesystem"], &security["allowPrivilegeEscalation"], &security["capabilities"]["drop"]),
        (&json!(true), &json!(false), &json!(["ALL"]))
    );
    let named: Vec<_> =
        container["ports"].as_array().unwrap().iter().map(|p| p["containerPort"].as_u64().unwrap()).collect();
    let [service_port, metrics_port] = ports(&config).map(u64::from);
    assert_eq!(named, [service_port, metrics_port]);
    assert_eq!(
        deployment["spec"]["template"]["metadata"]["annotations"]["prometheus.io/port"],
        json!(metrics_port.to_string())
    );
    assert_eq!(service["spec"]["ports"][0]["targetPort"], container["ports"][0]["name"]);
    let open: Vec<_> =
        network["spec"]["ingress"].as_array().unwrap().iter().map(|rule| &rule["ports"][0]["port"]).collect();
    assert_eq!(open, [&json!(service_port), &json!(metrics_port)]);
    // Only labelled pods reach the service.
    let from = &network["spec"]["ingress"][0]["from"];
    assert_eq!(from[0]["podSelector"], json!({ "matchLabels": { "molmesh-client": "true" } }));
    assert_eq!(from.as_array().unwrap().len(), 1);
    // Time to stop: the pause, the drain, a margin.
    let grace = pod["terminationGracePeriodSeconds"].as_u64().unwrap();
    let pause = container["lifecycle"]["preStop"]["sleep"]["seconds"].as_u64().unwrap();
    let drain = config.server.drain_timeout_ms / 1000;
    assert!(grace >= pause + drain + MARGIN, "{grace} s to stop, of which {pause} s pause and {drain} s drain");
    // Memory and volume.
    let memory = container["resources"]["limits"]["memory"].as_str().unwrap();
    assert!(bytes(memory) >= budget(&config), "{memory} of memory for {} bytes", budget(&config));
    let volume = storage["spec"]["resources"]["requests"]["storage"].as_str().unwrap();
    let files = config.store.max_bytes + config.archive.cache_bytes + config.limits.scratch_bytes;
    assert!(bytes(volume) > files, "{volume} on the volume");
    // Paths of the probes exist.
    let described = read("openapi.yaml");
    for (probe, path) in [("startupProbe", "/livez"), ("readinessProbe", "/readyz"), ("livenessProbe", "/livez")] {
        assert_eq!(container[probe]["httpGet"], json!({ "path": path, "port": "http" }), "{probe}");
        assert!(described.contains(&format!("\n  {path}:\n")), "{path} is not described");
    }
    // Mounts of the configuration and the data.
    let mounts: Vec<_> =
        container["volumeMounts"].as_array().unwrap().iter().map(|m| m["mountPath"].as_str().unwrap()).collect();
    let keys = config.access.keys_file.as_ref().unwrap().parent().unwrap().to_str().unwrap();
    assert_eq!(mounts, [config.server.data_dir.to_str().unwrap(), "/etc/molmesh", "/tmp", keys]);
    let secret = pod["volumes"].as_array().unwrap().iter().find(|volume| volume["name"] == "keys").unwrap();
    assert_eq!(
        (&secret["secret"]["secretName"], &secret["secret"]["optional"]),
        (&json!("molmesh-keys"), &json!(null))
    );
}

#[test]
fn scaled_pods_fit_their_ephemeral_storage() {
    let Some(found) = yaml(&["deployment", "autoscaler"].map(|f| format!("deploy/kubernetes/scaled/{f}.yaml"))) else {
        return;
    };
    let [patch, autoscaler] = only(&found);
    let pod = &patch["spec"]["template"]["spec"];
    let environment: Vec<(String, String)> = pod["containers"][0]["env"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| (v["name"].as_str().unwrap().to_owned(), v["value"].as_str().unwrap().to_owned()))
        .collect();
    assert!(environment.iter().all(|(name, _)| name.starts_with("MOLMESH__")));
    let config = load(Some(&root().join(CONFIGURATIONS[1])), environment, &[]).unwrap().config;
    let volume = bytes(pod["volumes"][0]["emptyDir"]["sizeLimit"].as_str().unwrap());
    let files = config.store.max_bytes + config.archive.cache_bytes + config.limits.scratch_bytes;
    assert!(volume > files, "{volume} bytes on the volume");
    let ephemeral = bytes(pod["containers"][0]["resources"]["limits"]["ephemeral-storage"].as_str().unwrap());
    assert!(ephemeral > volume, "{ephemeral} bytes of ephemeral storage for {volume}");
    assert_eq!(autoscaler["spec"]["scaleTargetRef"]["name"], patch["metadata"]["name"]);
    assert_eq!(patch["spec"]["replicas"], Value::Null, "the autoscaler sets the replicas");
}

// -------------------------------------------------------------------------------------------------- documentation

#[test]
fn documentation_names_existing_files_targets_and_keys() {
    let text = ["container", "kubernetes", "gpu"].map(|page| read(&format!("docs/operate/{page}.md"))).join("\n");
    let makefile = read("Makefile");
    let mut n = 0;
    for word in text.split(|c: char| c.is_whitespace() || "`()[],;\"'".contains(c)) {
        let word = word.trim_end_matches(['.', ':']);
        if word.starts_with("deploy/") || word.starts_with("samples/") {
            assert!(root().join(word).exists(), "{word}");
            n += 1;
        }
    }
    for line in text.lines().filter_map(|line| line.trim().strip_prefix("make ")) {
        let target = line.split_whitespace().next().unwrap();
        assert!(makefile.contains(&format!("\n{target}:")), "make {target}");
        n += 1;
    }
    assert!(n >= 10, "{n} names");
    // Configuration keys in the text exist.
    let defaults = serde_json::to_value(Config::default()).unwrap();
    for key in sections(&text, &defaults) {
        assert!(at(&defaults, &key).is_some(), "the configuration has no key `{key}`");
    }
}

// ------------------------------------------------------------------------------------------------ negative controls

#[test]
fn control_ignore_patterns_are_applied() {
    let sent = |path: &str| {
        deploy_support::sent("# all\n*\n!src\n!web\nweb/node_modules\n!deploy/container\n", Path::new(path))
    };
    assert!(sent("src/a/b.rs") && sent("web/index.html") && sent("deploy/container/x") && sent("src"));
    assert!(!sent("build.rs") && !sent("web/node_modules/x") && !sent("deploy/compose.yaml") && !sent("srcs/a"));
}

#[test]
fn control_dockerfiles_are_parsed() {
    let text = "ARG A=x:1\n# note\nFROM ${A} AS one\nRUN a \\\n    # why\n    && b\nFROM one AS two\nUSER 1\nUSER 2\n";
    let recipe = Recipe::parse(text);
    assert_eq!(recipe.argument("A").as_deref(), Some("x:1"));
    let [one, two] = ["one", "two"].map(|name| recipe.stage(name));
    assert_eq!((one.from.as_str(), one.last("RUN").unwrap().as_str()), ("${A}", "a && b"));
    assert_eq!((two.from.as_str(), two.last("USER").unwrap().as_str(), two.last("CMD")), ("one", "2", None));
}

#[test]
fn control_sizes_and_keys_are_parsed() {
    assert_eq!(
        [bytes("1Ki"), bytes("5376Mi"), bytes("2Gi"), bytes("10G")],
        [1 << 10, 5376 << 20, 2 << 30, 10_000_000_000]
    );
    let defaults = serde_json::to_value(Config::default()).unwrap();
    assert_eq!(sections("`store.nothing` and `limits.atoms`, not `x.y`", &defaults), ["store.nothing", "limits.atoms"]);
    assert!(at(&defaults, "store.nothing").is_none() && at(&defaults, "limits.atoms").is_some());
}

#[test]
fn control_schemas_reject_invalid_manifests() {
    let folder = cli_support::Folder::new();
    let broken = |path: &str, from: &str, to: &str| {
        let text = read(path);
        assert!(text.contains(from), "{path} lacks {from}");
        let name = Path::new(path).file_name().unwrap().to_str().unwrap();
        folder.file(name, text.replace(from, to))
    };
    let files = [
        broken(&format!("{BASE}/deployment.yaml"), "replicas: 1", "replica: 1"),
        broken(&format!("{BASE}/service.yaml"), "port: 80,", "port: eighty,"),
        broken(&format!("{BASE}/storage.yaml"), "kind: PersistentVolumeClaim", "kind: PersistentVolumeClaims"),
        broken("deploy/compose.yaml", "read_only:", "readonly:"),
        broken(&format!("{BASE}/network.yaml"), "policyTypes: [", "policyTypes: [["),
    ];
    let Some(found) = yaml(&files) else { return };
    for (file, manifest) in files.iter().zip(&found) {
        assert!(!manifest.errors.is_empty(), "{}", file.display());
    }
}
