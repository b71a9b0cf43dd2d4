//! `molmesh serve` as a process: banner, addresses, log, memory, stop.
#![cfg(unix)]

use crate::cli_support;

#[cfg(target_os = "linux")]
use std::io::Write as _;
use std::process::Command;
#[cfg(target_os = "linux")]
use std::time::{Duration, Instant};

use cli_support::{Folder, Service, assert_code, molmesh, run, stderr};

#[test]
fn example_command_of_the_banner_works() {
    let folder = Folder::new();
    let service = Service::start(&folder, &["--devices", "cpu"]);
    assert!(service.banner.lines().count() <= 10 && !service.banner.contains('\x1b'), "{}", service.banner);
    for part in ["viewer", "/docs", "metrics", "device", "cpu: ", "not gpu: "] {
        assert!(service.banner.contains(part), "no `{part}` in\n{}", service.banner);
    }
    let line = service.banner.lines().last().unwrap().trim().strip_prefix("try").unwrap().trim();
    let elsewhere = Folder::new();
    let pasted = Command::new("sh").args(["-c", line]).current_dir(elsewhere.path("")).output().unwrap();
    assert!(pasted.status.success(), "{line}: {}", String::from_utf8_lossy(&pasted.stderr));
    let mesh = std::fs::read(elsewhere.path("4pti.glb")).unwrap();
    assert!(mesh.starts_with(b"glTF") && mesh.len() > 100_000, "{line}: {}", String::from_utf8_lossy(&mesh));
}

#[test]
fn stops_on_signals_without_warnings() {
    for signal in ["TERM", "INT"] {
        let folder = Folder::new();
        let service = Service::start(&folder, &["--log", "json", "--devices", "cpu"]);
        let (mut lines, addr) = (service.banner.clone(), service.addr.clone());
        let (code, log) = service.stop(signal);
        assert_eq!(code, Some(0), "{log}");
        lines.push_str(&log);
        let mut listening = 0;
        for line in lines.lines() {
            let value: serde_json::Value = serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}"));
            assert!(!["WARN", "ERROR"].contains(&value["level"].as_str().unwrap()), "{line}");
            if value["message"] == "listening" {
                listening += 1;
                assert_eq!(value["address"], addr, "{line}");
                assert!(value["metrics"].as_str().is_some_and(|metrics| metrics.starts_with("127.0.0.1:")), "{line}");
                assert!(value["device"].as_str().is_some_and(|device| device.starts_with("cpu")), "{line}");
            }
        }
        assert_eq!(listening, 1, "{lines}");
    }
}

/// A service whose log cannot be written drops lines and continues.
#[cfg(target_os = "linux")]
#[test]
fn a_log_that_cannot_be_written_stops_nothing() {
    let folder = Folder::new();
    let listen = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    for log in ["pretty", "json"] {
        let mut child = molmesh()
            .args(["serve", "--listen", &listen, "--metrics-listen", "127.0.0.1:0", "--log", log, "--data-dir"])
            .arg(folder.path("data"))
            .args(["--devices", "cpu", "--set", "log.filter=debug"])
            .stderr(std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap())
            .spawn()
            .unwrap();
        let url = format!("http://{listen}/readyz");
        let ready = || run(["healthcheck", "--url", &url]).status.success();
        let start = std::time::Instant::now();
        while !ready() {
            assert_eq!(child.try_wait().unwrap(), None, "{log}");
            assert!(start.elapsed().as_secs() < 30, "the service is not ready after 30 s");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        for _ in 0..5 {
            assert!(ready(), "{log}");
        }
        child.kill().unwrap();
        child.wait().unwrap();
    }
}

#[test]
fn log_lines_name_their_request_and_job() {
    let folder = Folder::new();
    let service = Service::start(&folder, &["--log", "json", "--set", "log.filter=info"]);
    let pdb = folder.file("rod.pdb", cli_support::rod());
    let trace = "0af7651916cd43dd8448eb211c80319c";
    let ask = |id: &str, more: &[&str]| {
        let answer = Command::new("curl")
            .args(["-sS", "-H", &format!("X-Request-Id: {id}")])
            .args(["-H", &format!("traceparent: 00-{trace}-b7ad6b7169203331-01")])
            .args(more)
            .output();
        serde_json::from_slice::<serde_json::Value>(&answer.unwrap().stdout).unwrap()
    };
    let job = ask(
        "submits",
        &[
            "-H",
            "Prefer: respond-async",
            "--data-binary",
            &format!("@{}", pdb.display()),
            &format!("http://{}/v1/meshes", service.addr),
        ],
    );
    let job = job["jobID"].as_str().unwrap().to_owned();
    let done = ask("polls", &[&format!("http://{}/v1/jobs/{job}?wait=30", service.addr)]);
    assert_eq!(done["status"], "successful", "{done}");
    let result = done["result"].as_str().unwrap().to_owned();
    let url = format!("http://{}/v1/results/{result}", service.addr);
    for (id, more) in [("whole", &[][..]), ("part", &["-r", "0-9"]), ("head", &["-I"]), ("again", &[])] {
        let header = format!("X-Request-Id: {id}");
        let curl = Command::new("curl").args(["-sSf", "-o", "/dev/null", "-H", &header, &url]).args(more).status();
        assert!(curl.unwrap().success(), "{id}");
    }
    let (code, log) = service.stop("TERM");
    assert_eq!(code, Some(0), "{log}");
    for secret in [&job, &result[..64], done["structure"].as_str().unwrap()] {
        let leak = log.lines().find(|line| line.contains(&secret[..9]));
        assert_eq!(leak, None, "the log contains {secret}");
    }

    let lines: Vec<serde_json::Value> = log.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |key: &str, value: &str| -> Vec<_> { lines.iter().filter(|l| l["span"][key] == value).collect() };
    for id in ["submits", "polls", "whole", "part", "head", "again"] {
        let answered: Vec<_> = of("request_id", id).into_iter().filter(|l| l["message"] == "answered").collect();
        assert_eq!(answered.len(), 1, "one line per request\n{log}");
        assert_eq!(answered[0]["complete"], true, "{log}");
        assert!(answered[0]["ms"].is_number() && answered[0]["status"].is_u64(), "{}", answered[0]);
    }
    // The lines of the job name the request that submitted it, not the one that polled it.
    let of_job = of("job_id", &format!("{}…", &job[..8]));
    assert!(!of_job.is_empty(), "no line of the job\n{log}");
    for line in of_job {
        assert_eq!((&line["span"]["request_id"], &line["span"]["trace_id"]), (&"submits".into(), &trace.into()));
    }
}

#[test]
#[cfg(target_os = "linux")]
fn stored_data_is_readable_by_its_user_only() {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = Folder::new();
    let service = Service::start(&folder, &["--archive", "samples"]);
    let pdb = folder.file("rod.pdb", cli_support::rod());
    let upload = format!("@{}", pdb.display());
    for prefer in ["Prefer: respond-async", "Prefer: handling=lenient"] {
        let url = format!("http://{}/v1/meshes", service.addr);
        let args = ["-sSf", "-o", "/dev/null", "-H", prefer, "--data-binary", &upload, &url];
        assert!(Command::new("curl").args(args).status().unwrap().success());
    }
    assert_eq!(service.stop("TERM").0, Some(0));
    let (mut left, mut n) = (vec![folder.path("data")], 0);
    while let Some(path) = left.pop() {
        let meta = std::fs::metadata(&path).unwrap();
        assert_eq!(meta.permissions().mode() & 0o077, 0, "{}", path.display());
        if meta.is_dir() {
            left.extend(std::fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        }
        n += 1;
    }
    assert!(n >= 8, "{n} files and folders");
}

#[test]
#[cfg(target_os = "linux")]
fn the_limit_of_open_files_is_raised() {
    use std::io::{BufRead as _, BufReader};
    let folder = Folder::new();
    let binary = cli_support::molmesh();
    let mut child = Command::new("sh")
        .args(["-c", "ulimit -Sn 256 && exec \"$@\"", "sh"])
        .arg(binary.get_program())
        .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
        .arg(folder.path("data"))
        .envs(binary.get_envs().filter_map(|(name, value)| Some((name, value?))))
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    // The service raises its limit before it prints its banner.
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let started = lines.any(|line| line.unwrap().trim_start().starts_with("try "));
    let limits = std::fs::read_to_string(format!("/proc/{}/limits", child.id()));
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(started);
    let limits = limits.unwrap();
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files")).unwrap();
    let [soft, hard] = [0, 1].map(|n| line.split_whitespace().nth(n).unwrap());
    assert!(soft == hard && soft != "256", "{line}");
}

#[test]
fn flags_reach_the_service() {
    let folder = Folder::new();
    let service = Service::start(&folder, &["--set", "limits.atoms=5", "--backend", "reference"]);
    assert!(service.banner.contains("reference: "), "{}", service.banner);
    let pdb = folder.file("rod.pdb", cli_support::rod());
    let url = format!("http://{}/v1/meshes", service.addr);
    let answer =
        Command::new("curl").args(["-sS", "--data-binary"]).arg(format!("@{}", pdb.display())).arg(url).output();
    let problem: serde_json::Value = serde_json::from_slice(&answer.unwrap().stdout).unwrap();
    assert_eq!(problem["limit"], 5, "{problem}");
}

#[test]
fn second_service_on_a_data_folder_is_refused() {
    let folder = Folder::new();
    let first = Service::start(&folder, &[]);
    let data = folder.path("data");
    let before = std::fs::read(data.join("lock")).unwrap();
    let serve = ["serve", "--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--data-dir"];
    let refused = run(serve.iter().copied().chain([data.to_str().unwrap()]));
    assert_code(&refused, 8);
    let message = stderr(&refused);
    for part in [data.to_str().unwrap(), "server.data_dir", &format!("pid {}", first.pid()), &first.addr, "--data-dir"]
    {
        assert!(message.contains(part), "no `{part}` in {message}");
    }
    assert_eq!(std::fs::read(data.join("lock")).unwrap(), before, "the second service changes nothing");
    let doctor = run(["doctor", "--report", "json", "--listen", "127.0.0.1:0", "--data-dir", data.to_str().unwrap()]);
    assert!(cli_support::stdout(&doctor).contains(&format!("pid {}", first.pid())), "{}", stderr(&doctor));
    // Another folder is allowed.
    drop(Service::start(&Folder::new(), &[]));
    // The lock ends with the process, even if it is killed.
    assert_eq!(first.stop("KILL").0, None);
    let third = Service::start(&folder, &[]);
    assert_eq!(third.stop("TERM").0, Some(0));
    assert_eq!(Service::start(&folder, &[]).stop("TERM").0, Some(0));
}

#[test]
fn failed_starts_exit_with_a_reason() {
    let folder = Folder::new();
    let service = Service::start(&folder, &[]);
    let in_use = run(["serve", "--listen", &service.addr, "--set", "server.metrics_listen=none"]);
    assert_code(&in_use, 1);
    assert!(stderr(&in_use).contains(&service.addr), "{}", stderr(&in_use));
    for set in ["limits.atomz=5", "atoms", "limits.atoms=many", "limits.atoms=0"] {
        let refused = run(["serve", "--listen", "127.0.0.1:0", "--set", set]);
        assert_code(&refused, 2);
    }
    assert_code(&run(["serve", "--listen", "127.0.0.1:0", "--backend", "gpu", "--devices", "77"]), 6);
    assert_code(&run(["serve", "--config", "/no/such/file.toml"]), 2);
}

/// Runs `curl` and parses its JSON output.
#[cfg(target_os = "linux")]
fn curl(args: &[&str]) -> serde_json::Value {
    let answer = Command::new("curl").arg("-sS").args(args).output().unwrap();
    serde_json::from_slice(&answer.stdout).unwrap_or_else(|e| panic!("{e}: {}", stderr(&answer)))
}

#[cfg(target_os = "linux")]
#[test]
fn memory_of_a_structure_is_returned() {
    let folder = Folder::new();
    let service = Service::start(&folder, &["--devices", "cpu", "--set", "limits.structure_cache_bytes=0"]);
    let before = service.memory("VmRSS");
    let atoms: Vec<[f64; 3]> =
        (0..1_000_000_u32).map(|i| [i % 100, i / 100 % 100, i / 10_000].map(f64::from)).collect();
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(cli_support::pdb(&atoms).as_bytes()).unwrap();
    let input = folder.file("large.pdb.gz", encoder.finish().unwrap());
    let url = format!("http://{}/v1/structures", service.addr);
    let structure = curl(&["--data-binary", &format!("@{}", input.display()), &url]);
    assert_eq!(structure["atoms"], 1_000_000, "{structure}");
    assert!(service.memory("VmHWM") > before + 100, "{} MiB", service.memory("VmHWM"));
    service.assert_memory_returns(before + 60);
}

#[cfg(target_os = "linux")]
#[test]
fn memory_of_a_large_mesh_is_returned() {
    let folder = Folder::new();
    // The structure is not kept in memory, and the result is too large for that.
    let service = Service::start(&folder, &["--devices", "cpu", "--set", "limits.structure_cache_bytes=0"]);
    let before = service.memory("VmRSS");
    let input = folder.file("block.pdb", cli_support::block(60));
    let (body, output) = (format!("@{}", input.display()), folder.path("block.stl"));
    let url = format!("http://{}/v1/meshes?resolution=0.3&format=stl", service.addr);
    let args = ["-sSf", "--data-binary", &body, &url, "-o", output.to_str().unwrap()];
    assert!(Command::new("curl").args(args).status().unwrap().success());
    let file = std::fs::metadata(&output).unwrap().len() >> 20;
    assert!(service.memory("VmHWM") > before + 100, "{} MiB for {file} MiB", service.memory("VmHWM"));
    service.assert_memory_returns(before + 60);
}

#[cfg(target_os = "linux")]
#[test]
fn cancelled_job_returns_its_memory() {
    let folder = Folder::new();
    let service = Service::start(&folder, &["--devices", "cpu", "--set", "limits.candidate_pairs=1000000000"]);
    let before = service.memory("VmRSS");
    // Most candidate lists are long enough to be freed when their tile is finished. 1,000 atoms may have one position.
    let positions: Vec<_> = (0..80_000_u32).map(|i| [f64::from(i / 1000) * 0.001, 0.0, 0.0]).collect();
    let input = folder.file("near.pdb", cli_support::pdb(&positions));
    let body = format!("@{}", input.display());
    let url = format!("http://{}/v1/meshes?radius_scale=10", service.addr);
    let job = curl(&["-H", "Prefer: respond-async", "--data-binary", &body, &url]);
    let job = format!("http://{}/v1/jobs/{}", service.addr, job["jobID"].as_str().unwrap());
    let end = Instant::now() + Duration::from_mins(1);
    while service.memory("VmRSS") <= before + 120 {
        assert!(Instant::now() < end, "the job does not allocate: {} MiB, {before} before", service.memory("VmRSS"));
        std::thread::sleep(Duration::from_millis(50));
    }
    assert_eq!(curl(&["-X", "DELETE", &job])["status"], "dismissed");
    service.assert_memory_returns(before + 60);
}
