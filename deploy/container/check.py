#!/usr/bin/env python3
"""Checks the content and the operation of the images molmesh:cpu and molmesh:gpu.

Each check has a negative control: a broken image (`molmesh:broken`, made here) or an event that it must report. Needs
root and docker or podman on this machine: requests enter through the container's own network, which has no outside
access.
"""

import argparse
import io
import json
import os
import pathlib
import shutil
import stat
import subprocess
import sys
import tarfile
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent.parent
USER = 65532
# Bytes of all layers, as the engine counts them, without the program.
MAX_BYTES = {"cpu": 85_000_000, "gpu": 92_000_000}
PROGRAM = "/usr/local/bin/molmesh"
READY_SECONDS = 120
STOP_SECONDS = 60
VOLUME = "molmesh-check"
NAME = "molmesh-check"
BROKEN = "molmesh:broken"
LIBRARIES = "/usr/lib/x86_64-linux-gnu"

def docker_answers():
    return shutil.which("docker") and subprocess.run(["docker", "info"], capture_output=True, check=False).returncode == 0


# Same choice as in engine.sh, which build.sh uses.
ENGINE, RUN = [os.environ.get("ENGINE") or ("docker" if docker_answers() else "podman")], []
if ENGINE == ["podman"]:
    if runc := shutil.which("runc"):
        ENGINE += ["--runtime", runc]
    # Explicit limits, since containers cannot exceed those of the host. Only declared folders are writable.
    RUN = ["--ulimit", "nofile=1024:1024", "--ulimit", "nproc=4096:4096", "--read-only-tmpfs=false", "--no-healthcheck"]
SAFE = ["--cap-drop", "ALL", "--security-opt", "no-new-privileges", "--network", "none"]


def engine(*arguments, code=0, text=True, stdin=None):
    """Runs the engine and fails unless it exits with `code`; None accepts any exit status."""
    done = subprocess.run([*ENGINE, *arguments], capture_output=True, text=text, input=stdin, check=False)
    if code is not None and done.returncode != code:
        output = done.stderr if text else done.stderr.decode(errors="replace")
        raise Failed(f"{' '.join(arguments)} ended with {done.returncode}, not {code}: {output.strip()[-2000:]}")
    return done


class Failed(Exception):
    """A failed check."""


def need(holds, why):
    if not holds:
        raise Failed(why)


# ------------------------------------------------------------------------------------------------ content of an image


class Image:
    """An image: its configuration, and every file of its root by path."""

    def __init__(self, name, kind):
        self.name, self.kind = name, kind
        [found] = json.loads(engine("image", "inspect", name).stdout)
        self.size, self.config = found["Size"], found["Config"]
        # docker stores the health check in the configuration, podman next to it.
        self.health = (self.config.get("Healthcheck") or found.get("Healthcheck") or {}).get("Test") or []
        made = engine("create", "--no-healthcheck", name).stdout.strip()
        try:
            packed = engine("export", made, text=False).stdout
        finally:
            engine("rm", "--volumes", made)
        self.archive = tarfile.open(fileobj=io.BytesIO(packed))
        self.files = {"/" + member.name.strip("./"): member for member in self.archive}
        self.program = self.files[PROGRAM].size

    def read(self, path):
        need(path in self.files, f"{path} is not there")
        return self.archive.extractfile(self.files[path]).read()


def runs_as_nobody(image):
    need(image.config["User"] == f"{USER}:{USER}", f"runs as `{image.config['User']}`")
    passwd = image.read("/etc/passwd").decode()
    need(f"molmesh:x:{USER}:{USER}:" in passwd, "the user has no name")


def is_small(image):
    rest, limit = image.size - image.program, MAX_BYTES[image.kind]
    need(rest <= limit, f"{rest:,} bytes without the program, {limit:,} are allowed")


def is_labelled(image):
    labels = image.config.get("Labels") or {}
    for name in ("title", "description", "licenses", "version", "revision", "created"):
        need(labels.get(f"org.opencontainers.image.{name}", "unknown") not in ("", "unknown"), f"no label {name}")


def has_one_volume_and_its_ports(image):
    volumes, ports = image.config.get("Volumes") or {}, image.config.get("ExposedPorts") or {}
    need(list(volumes) == ["/data"], f"volumes: {list(volumes)}")
    need(sorted(ports) == ["8080/tcp", "9090/tcp"], f"ports: {sorted(ports)}")
    data = image.files["/data"]
    need((data.uid, data.gid, data.mode & 0o777) == (USER, USER, 0o750), f"/data is {data.uid}:{data.gid} {data.mode:o}")


def stops_by_draining(image):
    need(image.config.get("StopSignal") in ("SIGTERM", "15"), f"stops by {image.config.get('StopSignal')}")


def checks_its_health(image):
    need(image.health == ["CMD", "molmesh", "healthcheck"], f"its health check is {image.health}")


def has_no_setuid(image):
    found = [path for path, m in image.files.items() if m.isfile() and m.mode & (stat.S_ISUID | stat.S_ISGID)]
    need(not found, f"setuid or setgid: {found}")


def belongs_to_root(image):
    """Requires that the image's user can change only /data."""
    mine = [path for path, m in image.files.items() if USER in (m.uid, m.gid) and path != "/data"]
    need(not mine, f"belongs to {USER}: {mine}")
    sticky = (stat.S_ISVTX, stat.S_IWOTH)
    loose = [p for p, m in image.files.items() if not m.issym() and m.mode & sticky[1] and not m.mode & sticky[0]]
    need(not loose, f"writable for all users: {loose}")


def has_licences(image):
    doc = "/usr/share/doc/molmesh/"
    for name in ("LICENSE-MIT", "LICENSE-APACHE"):
        need(image.read(doc + name) == (ROOT / name).read_bytes(), f"{name} is not ours")
    notices = image.read(doc + "THIRD-PARTY.txt").decode()
    for part in ("  tokio ", "  ring ", "Swagger UI", "the Rust standard library", "Permission is hereby granted"):
        need(part in notices, f"the notices lack `{part}`")


def has_certificates(image):
    need("/var/lib/dpkg/status.d/ca-certificates" in image.files, "no package of certificates is recorded")
    n = image.read("/etc/ssl/certs/ca-certificates.crt").count(b"BEGIN CERTIFICATE")
    need(n >= 50, f"{n} certificates")


def has_no_build_tools(image):
    tools = ("/usr/bin/gcc", "/usr/bin/python3", "/usr/local/cargo", "/root/.cargo", "/build", "/stage")
    rest = [p for p in image.files if p in tools or p.startswith("/var/lib/apt/lists/") and image.files[p].isfile()]
    need(not rest, f"left over: {rest[:9]}")


def has_what_its_kind_needs(image):
    wanted = [f"{LIBRARIES}/{name}" for name in ("libvulkan.so.1", "libEGL.so.1", "libX11.so.6", "libXext.so.6")]
    wanted += ["/usr/share/vulkan/icd.d/nvidia_icd.json", "/usr/share/glvnd/egl_vendor.d/10_nvidia.json"]
    there = [path for path in wanted if path in image.files]
    environment = dict(pair.split("=", 1) for pair in image.config["Env"])
    capabilities = environment.get("NVIDIA_DRIVER_CAPABILITIES", "").split(",")
    if image.kind == "cpu":
        need(not there and capabilities == [""], f"a CPU's image has {there} {capabilities}")
        return
    need(there == wanted, f"lacks {set(wanted) - set(there)}")
    need({"graphics", "utility", "compute"} <= set(capabilities), f"capabilities: {capabilities}")
    for path in wanted[4:]:
        need(json.loads(image.read(path))["ICD"]["library_path"].startswith("lib"), path)
    for path in wanted[:4]:
        output = engine("run", "--rm", *RUN, *SAFE, "--entrypoint", "ldd", image.name, path).stdout
        need("=>" in output and "not found" not in output, f"{path} lacks libraries: {output}")


CONTENT_CHECKS = [
    runs_as_nobody,
    is_small,
    is_labelled,
    has_one_volume_and_its_ports,
    stops_by_draining,
    checks_its_health,
    has_no_setuid,
    belongs_to_root,
    has_licences,
    has_certificates,
    has_no_build_tools,
    has_what_its_kind_needs,
]


def broken(target):
    """Builds an image that every content check must reject."""
    recipe = f"""FROM molmesh:{target}
USER 0:0
RUN chmod u+s /usr/bin/ldd && mkdir -m 0777 /loose && touch /usr/bin/gcc && head -c 60000000 /dev/urandom >/ballast \\
    && cp /ballast {PROGRAM} && rm /usr/share/doc/molmesh/THIRD-PARTY.txt /etc/ssl/certs/ca-certificates.crt \\
    && rm -f {LIBRARIES}/libEGL.so.1
LABEL org.opencontainers.image.revision="unknown"
ENV NVIDIA_DRIVER_CAPABILITIES=utility
EXPOSE 22
STOPSIGNAL SIGKILL
HEALTHCHECK NONE
"""
    how = ["--format", "docker", "--isolation", "chroot", "--network", "host"] if ENGINE[0] == "podman" else []
    engine("build", *how, "--tag", BROKEN, "-", stdin=recipe)
    return Image(BROKEN, target)


# ---------------------------------------------------------------------------------------------- a running container


class Container:
    """A running container. Its volume remains when it is removed."""

    def __init__(self, image, *flags, command=(), volume=True):
        engine("rm", "--force", "--volumes", NAME, code=None)
        data = ["--volume", f"{VOLUME}:/data"] if volume else []
        engine("run", "--detach", "--name", NAME, *RUN, *SAFE, *data, *flags, image, *command)

    def state(self):
        [found] = json.loads(engine("container", "inspect", NAME).stdout)
        return found["State"]

    def run(self, *command, code=0):
        return engine("exec", NAME, *command, code=code)

    def wait_until_healthy(self, test):
        end = time.monotonic() + READY_SECONDS
        while self.run(*test, code=None).returncode != 0:
            need(self.state()["Running"], f"ended: {self.logs()[-3000:]}")
            need(time.monotonic() < end, f"not healthy after {READY_SECONDS} s: {self.logs()[-3000:]}")
            time.sleep(0.2)

    def curl(self, path, *flags, port=8080):
        """Sends one request from the container's network and returns the status and the body."""
        inside = ["nsenter", "--target", str(self.state()["Pid"]), "--net"]
        command = ["curl", "-sS", "--max-time", "60", "-w", "\n%{http_code}", f"http://127.0.0.1:{port}{path}", *flags]
        done = subprocess.run([*inside, *command], capture_output=True, check=False)
        need(done.returncode == 0, f"curl {path}: {done.stderr.decode()}")
        body, _, status = done.stdout.rpartition(b"\n")
        return int(status), body

    def logs(self):
        done = engine("logs", NAME, code=None)
        return done.stdout + done.stderr

    def written(self):
        """Returns files that were added or changed outside of volumes, without folders made for mounts."""
        lines = [line.split(" ", 1) for line in engine("diff", NAME).stdout.splitlines()]
        made_for_mounts = {"/data", "/dev", "/etc", "/proc", "/run", "/run/secrets", "/sys", "/etc/mtab"}
        given = {"/etc/hosts", "/etc/hostname", "/etc/resolv.conf", "/run/.containerenv", "/.dockerenv"}
        return [path for _, path in lines if path not in made_for_mounts | given]

    def stop(self):
        """Sends SIGTERM and returns the exit status."""
        engine("stop", "-t", str(STOP_SECONDS), NAME)
        return self.state()["ExitCode"]

    def remove(self):
        engine("rm", "--force", "--volumes", NAME, code=None)


def privileges(container):
    lines = pathlib.Path(f"/proc/{container.state()['Pid']}/status").read_text().splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    return status["Uid"].split()[0], status["CapBnd"], status["NoNewPrivs"]


def serves(image):
    """Checks the life of a service: readiness, a mesh, a restart, the stored mesh, an orderly stop."""
    engine("volume", "rm", "--force", VOLUME, code=None)
    test = image.health[1:]
    container = Container(image.name, "--read-only")
    container.wait_until_healthy(test)
    need(container.run(*test, "--url", "http://127.0.0.1:1/", code=1).returncode == 1, "control: a health check of no service succeeded")
    uid, capabilities, no_new = privileges(container)
    need((uid, int(capabilities, 16), no_new) == (str(USER), 0, "1"), f"uid {uid}, {capabilities}, {no_new}")
    status, glb = container.curl("/v1/meshes", "--data-binary", f"@{ROOT}/samples/4pti.pdb")
    need(status == 200 and glb.startswith(b"glTF\x02\x00\x00\x00"), f"a mesh: {status} {glb[:300]!r}")
    status, job = container.curl("/v1/meshes?resolution=0.7", "--data-binary", f"@{ROOT}/samples/4pti.pdb", "-H", "Prefer: respond-async")
    need(status == 202, f"an asynchronous job: {status} {job[:300]!r}")
    address = json.loads(job)["jobID"]
    end = time.monotonic() + READY_SECONDS
    while json.loads(container.curl(f"/v1/jobs/{address}?wait=20")[1])["status"] != "successful":
        need(time.monotonic() < end, "the asynchronous job does not end")
    status, first = container.curl(f"/v1/jobs/{address}/result", "-L")
    need(status == 200 and first.startswith(b"glTF"), f"its result: {status}")
    status, metrics = container.curl("/metrics", port=9090)
    need(status == 200 and b"molmesh_build_info" in metrics, f"metrics: {status}")
    need(not container.written(), f"written outside of /data: {container.written()}")
    code = container.stop()
    need(code == 0, f"SIGTERM: exit {code}: {container.logs()[-2000:]}")

    # Another container with the same volume.
    container = Container(image.name)
    container.wait_until_healthy(test)
    status, again = container.curl(f"/v1/jobs/{address}/result", "-L")
    need((status, again) == (200, first), f"after a restart: {status}")
    need(container.curl("/v1/jobs/0123456789abcdef0123456789abcdef")[0] == 404, "control: an unknown job")
    status, _ = container.curl("/v1/meshes", "--data-binary", f"@{ROOT}/samples/1crn.cif")
    need(status == 200, f"a mesh: {status}")
    need(not container.written(), f"written outside of /data: {container.written()}")
    need(container.stop() == 0, "SIGTERM after a restart")


def runs_doctor(image):
    done = engine("run", "--rm", *RUN, *SAFE, "--read-only", image.name, "doctor", "--report", "json")
    document = json.loads(done.stdout)
    backends = {backend["name"]: backend for backend in document["backends"]}
    need(document["ok"] and document["molmesh"]["gpu"], f"doctor: {document}")
    need(backends["cpu"]["ok"] and not backends["gpu"]["ok"] and backends["gpu"]["detail"], f"backends: {backends}")
    names_driver = any("nvidia_icd.json" in driver for driver in document["machine"]["drivers"])
    need(names_driver == (image.kind == "gpu"), f"drivers: {document['machine']['drivers']}")


def reports_faults(image):
    """Negative controls of the checks above."""
    container = Container(image.name, "--user", "0:0", "--entrypoint", "sh", command=["-c", "echo x >/var/tmp/x; exit 3"])
    end = time.monotonic() + READY_SECONDS
    while container.state()["Running"]:
        need(time.monotonic() < end, "a short command does not end")
        time.sleep(0.1)
    need("/var/tmp/x" in container.written(), f"a file that was written is not seen: {container.written()}")
    need(container.state()["ExitCode"] == 3, "an exit status is not seen")
    # The service must not start without a writable folder.
    flags = ["--read-only", "--tmpfs", "/data:ro,size=1m"]
    container = Container(image.name, *flags, volume=False)
    while container.state()["Running"]:
        need(time.monotonic() < end, f"it runs without its volume: {container.logs()[-2000:]}")
        time.sleep(0.1)
    need(container.state()["ExitCode"] != 0, "exit code 0 without the volume")
    container.remove()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", default=["cpu", "gpu"], metavar="cpu|gpu")
    parser.add_argument("--max-program", type=int, metavar="BYTES", help="largest allowed size of the program")
    options = parser.parse_args()
    failures = 0

    def has_a_small_program(image):
        need(image.program <= options.max_program, f"{image.program:,} bytes, {options.max_program:,} are allowed")

    content_checks = CONTENT_CHECKS + [has_a_small_program] * (options.max_program is not None)

    def report(target, check, *arguments, fails=False):
        nonlocal failures
        started = time.monotonic()
        name = check.__name__.replace("_", " ")
        try:
            check(*arguments)
            passed, why = not fails, "control: the broken image was accepted" if fails else ""
        except Failed as failed:
            passed, why = fails, f"{failed}"
        except (LookupError, ValueError, OSError) as error:
            passed, why = False, repr(error)
        failures += not passed
        mark = ("objects" if fails else "ok") if passed else "FAILED"
        print(f"{target:4} {mark:8} {name} ({time.monotonic() - started:.1f} s){'' if passed and not fails else ': ' + why[:1500]}", flush=True)

    for target in options.targets:
        image = Image(f"molmesh:{target}", target)
        print(f"{target:4} {image.size:,} bytes, {image.program:,} of the program, {len(image.files):,} files", flush=True)
        for check in content_checks:
            report(target, check, image)
        bad = broken(target)
        for check in content_checks:
            report(target, check, bad, fails=True)
        engine("rmi", "--force", BROKEN)
        for check in (runs_doctor, serves, reports_faults):
            report(target, check, image)
    engine("rm", "--force", "--volumes", NAME, code=None)
    engine("volume", "rm", "--force", VOLUME, code=None)
    print(f"{failures} failed")
    sys.exit(failures != 0)


if __name__ == "__main__":
    main()
