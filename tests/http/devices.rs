//! Devices over HTTP: detected devices are listed, failures are reported and counted, fallbacks are named.

use crate::http_support;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use http_support::{Fake, Mode, SAMPLE, log_lines, send, start_on, wait_for};
use molmesh::surface::{
    Backend, BackendIdentity, BackendJob, DeviceFacts, DeviceKind, DeviceStatus, Exceeded, FoundDevice, Limit,
    MeshOutput, SurfaceError,
};

/// Backend with two devices, the second of which can fail.
struct Devices {
    fake: Arc<Fake>,
    /// Reason of a fallback to another backend.
    fallback_reason: Mutex<Option<&'static str>>,
    /// Arithmetic of the first device, and of the serving device if it is another one.
    arithmetic: Mutex<&'static str>,
    served: Mutex<Option<&'static str>>,
    error: Mutex<Option<SurfaceError>>,
    second_is_down: AtomicBool,
    /// The warm-up waits for this.
    warm: AtomicBool,
}

impl Devices {
    fn new() -> Arc<Self> {
        Arc::new(Self {
            fake: Fake::new(Mode::Octahedra),
            fallback_reason: Mutex::default(),
            arithmetic: Mutex::new("card 1, driver 1"),
            served: Mutex::default(),
            error: Mutex::default(),
            second_is_down: AtomicBool::new(false),
            warm: AtomicBool::new(true),
        })
    }
}

impl Backend for Devices {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn arithmetic(&self) -> String {
        self.arithmetic.lock().unwrap().to_owned()
    }

    fn describe(&self) -> String {
        "two devices".to_owned()
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        if let Some(error) = self.error.lock().unwrap().clone() {
            return Err(error);
        }
        let fallback_reason = self.fallback_reason.lock().unwrap().map(str::to_owned);
        let (backend, device) = if fallback_reason.is_some() { ("cpu", "the processor") } else { ("gpu", "card 1") };
        let arithmetic = match &fallback_reason {
            Some(_) => "cpu".to_owned(),
            None => self.served.lock().unwrap().map_or_else(|| self.arithmetic(), str::to_owned),
        };
        let made_by = Some(BackendIdentity { backend, arithmetic, device: device.to_owned(), fallback_reason });
        Ok(MeshOutput { made_by, ..self.fake.write(job)? })
    }

    fn warm_up(&self) -> Result<(), SurfaceError> {
        while !self.warm.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(())
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        let down = self.second_is_down.load(Ordering::SeqCst).then(|| "device lost by a test".to_owned());
        let device = |number: usize, down: Option<String>| DeviceStatus {
            number,
            name: format!("card {number}"),
            rebuilds: if down.is_some() { 3 } else { 0 },
            down,
            waiting: 0,
            busy: Duration::from_millis(1500),
            lost: 5,
            hung: 5,
            finished: 11,
            failed: 2,
            shared: 4,
            partitions: 3,
            held_bytes: 1 << 20,
        };
        vec![device(0, None), device(1, down)]
    }
}

fn found() -> Vec<FoundDevice> {
    let device = |number: usize, selected: bool, reason: &str| FoundDevice {
        number,
        facts: DeviceFacts {
            name: format!("card {number}"),
            kind: DeviceKind::Discrete,
            api: "vulkan",
            driver: "driver 1.2".to_owned(),
            bus: String::new(),
            binding_bytes: 2 << 30,
            buffer_bytes: 4 << 30,
            workgroup_bytes: 48 << 10,
            workgroup_size: 1024,
            storage_buffers: 16,
            timestamps: true,
            subgroups: Some([32, 32]),
        },
        selected,
        reason: reason.to_owned(),
    };
    vec![device(0, true, "discrete"), device(1, true, "discrete"), device(2, false, "not in --devices 0,1")]
}

#[test]
fn devices_are_listed_with_their_reasons() {
    let backend = Devices::new();
    let server = start_on(Arc::clone(&backend) as _, found(), |_| {});
    wait_for("ready", || server.get("/readyz").status == 200);
    let can = server.get("/v1/capabilities").json();
    let member = |name: &str| -> Vec<serde_json::Value> {
        can["devices"].as_array().unwrap().iter().map(|device| device[name].clone()).collect()
    };
    assert_eq!(member("taken"), [true, true, false]);
    assert_eq!(member("up"), [true, true, false]);
    assert_eq!(member("reason"), ["discrete", "discrete", "not in --devices 0,1"]);
    assert_eq!(can["devices"][0]["binding_bytes"], 2_u64 << 30);
    assert_eq!(can["devices"][0]["subgroups"], serde_json::json!([32, 32]));
    // 16 concurrent jobs per device, because only queued jobs share a submission.
    assert_eq!(can["limits"]["workers"], 32);
    backend.second_is_down.store(true, Ordering::SeqCst);
    let device = &server.get("/v1/capabilities").json()["devices"][1];
    assert_eq!((&device["up"], &device["reason"]), (&false.into(), &"device lost by a test".into()));
    let ready = server.get("/readyz").text();
    assert!(ready.contains("1 of 2 devices are in service; 1: device lost by a test"), "{ready}");
}

#[test]
fn a_service_without_devices_reports_it() {
    let server = http_support::start(Fake::new(Mode::Octahedra), |_| {});
    let can = server.get("/v1/capabilities").json();
    assert_eq!((can["devices"].as_array().unwrap().len(), &can["limits"]["workers"]), (0, &2.into()));
}

#[test]
fn not_ready_before_the_devices_are_warm() {
    let backend = Devices::new();
    backend.warm.store(false, Ordering::SeqCst);
    let server = start_on(Arc::clone(&backend) as _, found(), |_| {});
    server.get("/readyz").problem(503, "not-ready");
    backend.warm.store(true, Ordering::SeqCst);
    wait_for("ready", || server.get("/readyz").status == 200);
}

#[test]
fn fallbacks_are_reported_in_response_report_log_and_metrics() {
    let backend = Devices::new();
    let server = start_on(Arc::clone(&backend) as _, found(), |_| {});
    wait_for("ready", || server.get("/readyz").status == 200);
    let before = server.metric("molmesh_jobs_fallback_total", &[]);
    let well = server.post("/v1/meshes", &[], SAMPLE);
    assert_eq!(
        (well.header("molmesh-backend"), well.header("molmesh-backend-reason")),
        (Some("gpu"), Some("set by a test"))
    );
    let report = server.post("/v1/report", &[], SAMPLE).json();
    assert_eq!((&report["device"], report.get("fallback")), (&"card 1".into(), None));

    *backend.fallback_reason.lock().unwrap() = Some("the card is on fire 7431");
    // The first result is stored and would be sent for the same request.
    let other = http_support::sample(1);
    let fallback = server.post("/v1/meshes", &[], &other);
    assert_eq!(fallback.header("molmesh-backend"), Some("cpu"));
    assert_eq!(fallback.header("molmesh-backend-reason"), Some("set by a test; but the card is on fire 7431"));
    *backend.fallback_reason.lock().unwrap() = None;
    let again = server.post("/v1/meshes", &[], &other);
    assert_eq!(again.header("molmesh-backend"), Some("gpu"), "the result of the fallback is not reused");
    assert_ne!(fallback.header("etag"), again.header("etag"), "different bytes with the same ETag");
    *backend.fallback_reason.lock().unwrap() = Some("the card is on fire 7431");
    let report = server.post("/v1/report", &[], &other).json();
    assert_eq!((&report["backend"], &report["fallback"]), (&"cpu".into(), &"the card is on fire 7431".into()));
    assert_eq!(report["device"], "the processor");
    assert_eq!(log_lines("on fire 7431").iter().filter(|line| line.contains("fell back")).count(), 2);
    assert!((server.metric("molmesh_jobs_fallback_total", &[]) - before - 2.0).abs() < 0.5);
}

#[test]
fn etags_depend_on_device_and_driver() {
    let backend = Devices::new();
    let server = start_on(Arc::clone(&backend) as _, found(), |_| {});
    wait_for("ready", || server.get("/readyz").status == 200);
    let structure = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let path = format!("{structure}/surface.glb");
    let tag = |reply: &http_support::Reply| reply.header("etag").unwrap().to_owned();
    // The result is stored before its URL is requested.
    let ask = || {
        let reply = server.get(&path);
        assert_eq!(server.get(reply.header("content-location").unwrap()).status, 200);
        tag(&reply)
    };
    let predicted = tag(&send(server.addr, "HEAD", &path, &[], b""));
    // Results of another device are stored under another key.
    *backend.served.lock().unwrap() = Some("card 2, driver 1");
    let second = ask();
    assert_ne!(second, predicted);
    let later = [("prefer", "respond-async")];
    let job = server.post("/v1/meshes?format=ply", &later, SAMPLE).json()["jobID"].as_str().unwrap().to_owned();
    assert_eq!(server.get(&format!("/v1/jobs/{job}?wait=20")).json()["status"], "successful");
    let of_job = server.get(&format!("/v1/jobs/{job}/result")).header("location").unwrap().to_owned();
    *backend.served.lock().unwrap() = None;
    assert_eq!(ask(), predicted);
    let first = server.post("/v1/meshes?format=ply", &[], SAMPLE);
    assert_ne!(first.header("content-location").unwrap(), of_job);
    // A new driver makes different bytes, so earlier results and ETags do not match.
    *backend.arithmetic.lock().unwrap() = "card 1, driver 2";
    let again = send(server.addr, "GET", &path, &[("if-none-match", &predicted)], b"");
    assert_eq!(again.status, 200);
    assert!(![predicted, second].contains(&tag(&again)));
    let unchanged = send(server.addr, "GET", &path, &[("if-none-match", &tag(&again))], b"");
    assert_eq!(unchanged.status, 304);
}

#[test]
fn devices_are_counted_and_their_loss_is_logged_once() {
    let backend = Devices::new();
    let server = start_on(Arc::clone(&backend) as _, found(), |_| {});
    wait_for("ready", || server.get("/readyz").status == 200);
    let value = |name: &str, labels: &[&str]| server.metric(name, labels);
    backend.second_is_down.store(true, Ordering::SeqCst);
    let lines = log_lines("device lost by a test").len();
    for _ in 0..3 {
        assert_eq!(server.post("/v1/report", &[], SAMPLE).status, 200);
    }
    // The response is sent before the job is counted.
    wait_for("the log", || log_lines("device lost by a test").len() > lines);
    for (name, labels, expected) in [
        ("molmesh_device_jobs_total", &["device=\"0\"", "outcome=\"finished\""][..], 11.0),
        ("molmesh_device_jobs_total", &["device=\"1\"", "outcome=\"failed\""], 2.0),
        ("molmesh_device_shared_submissions_total", &["device=\"0\""], 4.0),
        ("molmesh_device_partitions_total", &["device=\"1\""], 3.0),
        ("molmesh_device_memory_bytes", &["device=\"1\""], f64::from(1 << 20)),
    ] {
        assert!((value(name, labels) - expected).abs() < 0.5, "{name}: {}", value(name, labels));
    }
    std::thread::sleep(Duration::from_millis(50));
    assert_eq!(log_lines("device lost by a test").len(), lines + 1);
}

#[test]
fn device_failures_have_their_own_problem_types() {
    let backend = Devices::new();
    let server = start_on(Arc::clone(&backend) as _, found(), |_| {});
    wait_for("ready", || server.get("/readyz").status == 200);
    let post = || server.post("/v1/meshes", &[], SAMPLE);
    *backend.error.lock().unwrap() =
        Some(Exceeded { actual: Some(900), ..Exceeded::new(Limit::DeviceBytes, 500) }.suggest(0.75).error());
    let problem = post().problem(422, "device-memory");
    assert_eq!((&problem["limit"], &problem["actual"]), (&500.into(), &900.into()));
    assert_eq!(problem["suggested_resolution"], 0.75);
    *backend.error.lock().unwrap() = Some(SurfaceError::Device { why: "queue family 5512 burned".to_owned() });
    let answer = post();
    assert!(answer.header("retry-after").is_some());
    let problem = answer.problem(503, "device-failed");
    // Not checked by the number, which a request id may contain.
    assert!(!problem.to_string().contains("burned"), "messages of drivers belong in the log: {problem}");
    assert_eq!(log_lines("queue family 5512").len(), 1);
    *backend.error.lock().unwrap() = Some(SurfaceError::Deadline);
    post().problem(504, "deadline");
}
