"""Server and clients shared by the load scripts.

The server can be restarted on its port. The clients send a mixture of requests, retry when a request is rejected or
interrupted, and compare all bytes with the output of the command line for the same input.
"""

import http.client
import os
import random
import re
import subprocess
import tempfile
import threading
import time
from collections import Counter

# Errors of a server that is stopped before or during a request. The client retries.
UNAVAILABLE = (OSError, http.client.HTTPException)
RESOLUTIONS = ("0.6", "0.8", "1", "1.5", "2")
KERNELS = ("gaussian", "soft-object", "inverse-square")


class Server:
    """Service that can be restarted on the same port with the same data."""

    def __init__(self, binary, folder, port, extra=()):
        self.command = [binary, "serve", "--listen", f"127.0.0.1:{port}", "--metrics-listen", f"127.0.0.1:{port + 1}"]
        self.command += ["--data-dir", folder, "--set", "archive.url=none", *extra]
        self.port, self.folder, self.log = port, folder, os.path.join(folder, "log.txt")

    def start(self):
        """Starts the service. Returns the time until it is ready, s."""
        begin = time.perf_counter()
        self.launch()
        while True:
            try:
                if fetch(self.port, "GET", "/readyz")[0] == 200:
                    return time.perf_counter() - begin
            except UNAVAILABLE:
                pass
            if self.process.poll() is not None:
                raise SystemExit(f"the server ended with {self.process.returncode}: see {self.log}")
            time.sleep(0.01)

    def launch(self):
        """Starts the process."""
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen(self.command, stdout=log, stderr=log)

    def stop(self):
        """Stops the service with SIGTERM. Returns its exit code and the time until it has ended, s."""
        begin = time.perf_counter()
        self.process.terminate()
        return self.process.wait(), time.perf_counter() - begin

    def metric(self, name):
        """Returns the sum of the series of a metric."""
        text = fetch(self.port + 1, "GET", "/metrics")[2].decode()
        return sum(float(line.rpartition(" ")[2]) for line in text.splitlines() if re.match(rf"{name}[ {{]", line))


def fetch(port, method, path, body=None, headers=None, timeout=60, client="127.0.0.1"):
    """Sends a request from the address of a client on a new connection. Returns status, headers and body."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout, source_address=(client, 0))
    try:
        connection.request(method, path, body, {"connection": "close", **(headers or {})})
        response = connection.getresponse()
        return response.status, response.headers, response.read()
    finally:
        connection.close()


class Expected:
    """Expected responses, computed before the load with `molmesh mesh`."""

    def __init__(self, binary, structures):
        self.inputs, self.files = [], {}
        for number, path in enumerate(structures):
            with open(path, "rb") as file:
                # A comment line in the format of the file.
                remark = b"# %032x\n" if ".cif" in path else b"REMARK 900 %032x\n"
                self.inputs.append((file.read(), remark))
            for resolution in RESOLUTIONS:
                for kernel in KERNELS:
                    command = [binary, "mesh", path, "--format", "glb", "-o", "-", "--resolution", resolution, "--surface", kernel]
                    made = subprocess.run(command + ["--backend", "cpu"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, check=True)
                    self.files[number, resolution, kernel] = made.stdout

    def next_request(self, dice):
        """Returns a structure with a unique remark, a query, and the expected bytes."""
        number, resolution, kernel = key = dice.choice(list(self.files))
        structure, remark = self.inputs[number]
        return structure + remark % dice.getrandbits(128), f"resolution={resolution}&surface={kernel}", self.files[key]


class Load:
    """Clients that send requests until `finish` is called. `counts` has the outcomes; names that begin with `bad` are
    errors."""

    def __init__(self, port, expected, clients, seed=1, every=0.0, later=float("inf")):
        self.port, self.expected = port, expected
        # Seconds after which deferred jobs are followed; infinite: only by `follow_deferred`.
        self.later = later
        # Seconds between the starts of two requests of all clients; 0: without pauses.
        self.every, self.turn = every, time.monotonic()
        self.counts, self.lock, self.over = Counter(), threading.Lock(), threading.Event()
        # Deferred jobs: time, URL, and expected bytes.
        self.deferred = []
        self.threads = [threading.Thread(target=self.client, args=(seed + n,)) for n in range(clients)]

    def start(self):
        for thread in self.threads:
            thread.start()

    def finish(self):
        self.over.set()
        for thread in self.threads:
            thread.join()

    def count(self, what, n=1):
        with self.lock:
            self.counts[what] += n

    def client(self, seed):
        dice = random.Random(seed)
        kinds = (self.mesh, self.mesh, self.start_job, self.start_job, self.upload, self.dismiss)
        while not self.over.is_set():
            with self.lock:
                self.turn = turn = max(self.turn + self.every, time.monotonic() - 1)
            if not self.over.wait(turn - time.monotonic() if self.every else 0):
                dice.choice(kinds)(dice)
                self.count("requests")
                self.follow_deferred(time.monotonic() - self.later)

    def send(self, method, path, body=None, headers=None, good=(200,), timeout=60.0):
        """Sends a request until it succeeds. Returns None if it does not succeed in time."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            try:
                status, heads, response = fetch(self.port, method, path, body, headers)
            except http.client.IncompleteRead:
                # A response that has started must be complete.
                self.count("bad: responses cut off")
                continue
            except (ConnectionRefusedError, ConnectionResetError, http.client.RemoteDisconnected, BrokenPipeError) as why:
                self.count("connection refused" if isinstance(why, ConnectionRefusedError) else "cut before a response")
                time.sleep(0.02)
                continue
            if status in good:
                return status, heads, response
            if status in (429, 503):
                self.count(f"rejected ({status})")
                time.sleep(min(float(heads.get("retry-after", "1")), 2.0))
                continue
            self.count(f"bad: status {status} for {method} {path.split('?')[0][:24]}")
            return None
        self.count("bad: no response in a minute")
        return None

    def compare(self, what, got, expected):
        self.count(what)
        if got != expected:
            self.count("bad: wrong bytes")

    def mesh(self, dice):
        """Requests a mesh with a wait. Follows the job if it takes longer."""
        fresh, query, expected = self.expected.next_request(dice)
        response = self.send("POST", f"/v1/meshes?{query}", fresh, {"prefer": "wait=10"}, good=(200, 202))
        if response is None:
            return
        if response[0] == 202:
            self.follow(response[1]["location"], expected)
        else:
            self.compare("meshes", response[2], expected)

    def start_job(self, dice):
        """Starts a job. Follows half of the jobs later."""
        fresh, query, expected = self.expected.next_request(dice)
        response = self.send("POST", f"/v1/meshes?{query}", fresh, {"prefer": "respond-async"}, good=(202,))
        if response is None:
            return
        self.count("jobs accepted")
        if dice.random() < 0.5:
            with self.lock:
                self.deferred.append((time.monotonic(), response[1]["location"], expected))
        else:
            self.follow(response[1]["location"], expected)

    def follow(self, location, expected):
        """Waits for a job and compares its result, which is read in two ranges."""
        end = time.monotonic() + 60
        while time.monotonic() < end:
            response = self.send("GET", f"{location}?wait=5")
            if response is None:
                return
            if b'"successful"' in response[2]:
                break
            if b'"failed"' in response[2] or b'"dismissed"' in response[2]:
                return self.count("bad: accepted jobs lost")
        else:
            return self.count("bad: accepted jobs lost")
        moved = self.send("GET", f"{location}/result", good=(303,))
        if moved is None:
            return
        half = len(expected) // 2
        first = self.send("GET", moved[1]["location"], headers={"range": f"bytes=0-{half - 1}"}, good=(206,))
        rest = self.send("GET", moved[1]["location"], headers={"range": f"bytes={half}-"}, good=(206,))
        if first and rest:
            self.compare("jobs done", first[2] + rest[2], expected)

    def upload(self, dice):
        """Uploads a structure and requests a mesh of it twice, the second time from the cache."""
        fresh, query, expected = self.expected.next_request(dice)
        made = self.send("POST", "/v1/structures", fresh, good=(200, 201))
        if made is None:
            return
        for _ in range(2):
            response = self.send("GET", f"{made[1]['location']}/surface.glb?{query}", good=(200,))
            if response:
                self.compare("meshes of uploads", response[2], expected)

    def dismiss(self, dice):
        """Starts a job and cancels it."""
        fresh, query, _ = self.expected.next_request(dice)
        response = self.send("POST", f"/v1/meshes?{query}", fresh, {"prefer": "respond-async"}, good=(202,))
        if response and self.send("DELETE", response[1]["location"], good=(200, 204, 404, 409, 410)):
            self.count("jobs dismissed")

    def follow_deferred(self, until=float("inf")):
        """Follows the jobs deferred before `until`."""
        while True:
            with self.lock:
                if not self.deferred or self.deferred[0][0] > until:
                    return
                _, location, expected = self.deferred.pop(0)
            self.follow(location, expected)

    def bad(self):
        return sum(n for what, n in self.counts.items() if what.startswith("bad"))

    def report(self):
        return "\n".join(f"{what:42} {n:9}" for what, n in sorted(self.counts.items()))


def folder():
    """Creates a temporary data folder for a server."""
    return tempfile.mkdtemp(prefix="molmesh-load-")
