"""What the load scripts share: a server that can be stopped and started on its port, and clients that ask for a mixture of
things, come back when they are told to or cut off, and compare every byte with what the command line makes of the same input.
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

# What goes wrong when a server is away, or goes while it is asked: the client comes again.
AWAY = (OSError, http.client.HTTPException)
RESOLUTIONS = ("0.6", "0.8", "1", "1.5", "2")
KERNELS = ("gaussian", "soft-object", "inverse-square")


class Server:
    """One service, again and again on the same port and the same data."""

    def __init__(self, binary, folder, port, extra=()):
        self.command = [binary, "serve", "--listen", f"127.0.0.1:{port}", "--metrics-listen", f"127.0.0.1:{port + 1}"]
        self.command += ["--data-dir", folder, "--set", "archive.url=none", *extra]
        self.port, self.log = port, os.path.join(folder, "log.txt")

    def start(self):
        """Starts it; seconds until it is ready."""
        begin = time.perf_counter()
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen(self.command, stdout=log, stderr=log)
        while True:
            try:
                if fetch(self.port, "GET", "/readyz")[0] == 200:
                    return time.perf_counter() - begin
            except AWAY:
                pass
            if self.process.poll() is not None:
                raise SystemExit(f"the server ended with {self.process.returncode}: see {self.log}")
            time.sleep(0.01)

    def stop(self):
        """SIGTERM; seconds until it is gone, and its exit code."""
        begin = time.perf_counter()
        self.process.terminate()
        return self.process.wait(), time.perf_counter() - begin

    def metric(self, name):
        """The sum of a metric's series."""
        text = fetch(self.port + 1, "GET", "/metrics")[2].decode()
        return sum(float(line.rpartition(" ")[2]) for line in text.splitlines() if re.match(rf"{name}[ {{]", line))


def fetch(port, method, path, body=None, headers=None, timeout=60):
    """Status, headers and body of one request on a connection of its own."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout)
    try:
        connection.request(method, path, body, {"connection": "close", **(headers or {})})
        response = connection.getresponse()
        return response.status, response.headers, response.read()
    finally:
        connection.close()


class Expected:
    """The bytes that each question must be answered with, made by `molmesh mesh` beforehand."""

    def __init__(self, binary, structures):
        self.inputs, self.files = [], {}
        for number, path in enumerate(structures):
            with open(path, "rb") as file:
                # A line that says nothing, in the words of the file's format.
                remark = b"# %032x\n" if ".cif" in path else b"REMARK 900 %032x\n"
                self.inputs.append((file.read(), remark))
            for resolution in RESOLUTIONS:
                for kernel in KERNELS:
                    command = [binary, "mesh", path, "--format", "glb", "-o", "-", "--resolution", resolution, "--kernel", kernel]
                    made = subprocess.run(command + ["--backend", "cpu"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, check=True)
                    self.files[number, resolution, kernel] = made.stdout

    def question(self, dice):
        """A structure, its bytes with a remark that makes them new, the query, and the answer."""
        number, resolution, kernel = key = dice.choice(list(self.files))
        structure, remark = self.inputs[number]
        return structure + remark % dice.getrandbits(128), f"resolution={resolution}&kernel={kernel}", self.files[key]


class Load:
    """Clients that ask until they are told to stop. `counts` says what came of it; anything under a name that begins with
    `bad` must not have happened."""

    def __init__(self, port, expected, clients, seed=1, every=0.0, later=float("inf")):
        self.port, self.expected = port, expected
        # Seconds after which jobs are looked at that nobody looked at at once; without end: by `settle`.
        self.later = later
        # Seconds between the beginnings of two questions, whoever asks; 0: as fast as they are answered.
        self.every, self.turn = every, time.monotonic()
        self.counts, self.lock, self.over = Counter(), threading.Lock(), threading.Event()
        # Each promise: when, the address of the job, and the answer.
        self.promised = []
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
        kinds = (self.mesh, self.mesh, self.promise, self.promise, self.upload, self.dismiss)
        while not self.over.is_set():
            with self.lock:
                self.turn = turn = max(self.turn + self.every, time.monotonic() - 1)
            if not self.over.wait(turn - time.monotonic() if self.every else 0):
                dice.choice(kinds)(dice)
                self.count("questions")
                self.settle(time.monotonic() - self.later)

    def ask(self, method, path, body=None, headers=None, good=(200,), patience=60.0):
        """Asks until there is an answer; None if there was none in time."""
        end = time.monotonic() + patience
        while time.monotonic() < end:
            try:
                status, heads, answer = fetch(self.port, method, path, body, headers)
            except http.client.IncompleteRead:
                # An answer had begun: it should have been whole.
                self.count("bad: answers cut off")
                continue
            except (ConnectionRefusedError, ConnectionResetError, http.client.RemoteDisconnected, BrokenPipeError) as why:
                self.count("away" if isinstance(why, ConnectionRefusedError) else "cut before an answer")
                time.sleep(0.02)
                continue
            if status in good:
                return status, heads, answer
            if status in (429, 503):
                self.count(f"told to wait ({status})")
                time.sleep(min(float(heads.get("retry-after", "1")), 2.0))
                continue
            self.count(f"bad: status {status} for {method} {path.split('?')[0][:24]}")
            return None
        self.count("bad: no answer in a minute")
        return None

    def compare(self, what, got, want):
        self.count(what)
        if got != want:
            self.count("bad: wrong bytes")

    def mesh(self, dice):
        """Requests a mesh with a wait. If it takes longer, the answer is a job, which is followed."""
        fresh, query, want = self.expected.question(dice)
        answer = self.ask("POST", f"/v1/meshes?{query}", fresh, {"prefer": "wait=10"}, good=(200, 202))
        if answer is None:
            return
        if answer[0] == 202:
            self.follow(answer[1]["location"], want)
        else:
            self.compare("meshes", answer[2], want)

    def promise(self, dice):
        """A job; half of them are looked at later."""
        fresh, query, want = self.expected.question(dice)
        answer = self.ask("POST", f"/v1/meshes?{query}", fresh, {"prefer": "respond-async"}, good=(202,))
        if answer is None:
            return
        self.count("jobs accepted")
        if dice.random() < 0.5:
            with self.lock:
                self.promised.append((time.monotonic(), answer[1]["location"], want))
        else:
            self.follow(answer[1]["location"], want)

    def follow(self, location, want):
        """The result of a job, by its status and then its bytes, whole or in two ranges."""
        end = time.monotonic() + 60
        while time.monotonic() < end:
            answer = self.ask("GET", f"{location}?wait=5")
            if answer is None:
                return
            if b'"successful"' in answer[2]:
                break
            if b'"failed"' in answer[2] or b'"dismissed"' in answer[2]:
                return self.count("bad: accepted jobs lost")
        else:
            return self.count("bad: accepted jobs lost")
        moved = self.ask("GET", f"{location}/result", good=(303,))
        if moved is None:
            return
        half = len(want) // 2
        first = self.ask("GET", moved[1]["location"], headers={"range": f"bytes=0-{half - 1}"}, good=(206,))
        rest = self.ask("GET", moved[1]["location"], headers={"range": f"bytes={half}-"}, good=(206,))
        if first and rest:
            self.compare("jobs done", first[2] + rest[2], want)

    def upload(self, dice):
        """A structure that stays, and meshes of it, the second from the cache."""
        fresh, query, want = self.expected.question(dice)
        made = self.ask("POST", "/v1/structures", fresh, good=(200, 201))
        if made is None:
            return
        for _ in range(2):
            answer = self.ask("GET", f"{made[1]['location']}/surface.glb?{query}", good=(200,))
            if answer:
                self.compare("meshes of uploads", answer[2], want)

    def dismiss(self, dice):
        """A job that nobody wants any more."""
        fresh, query, _ = self.expected.question(dice)
        answer = self.ask("POST", f"/v1/meshes?{query}", fresh, {"prefer": "respond-async"}, good=(202,))
        if answer and self.ask("DELETE", answer[1]["location"], good=(200, 204, 404, 409, 410)):
            self.count("jobs dismissed")

    def settle(self, until=float("inf")):
        """Follows what was promised until then and not looked at yet."""
        while True:
            with self.lock:
                if not self.promised or self.promised[0][0] > until:
                    return
                _, location, want = self.promised.pop(0)
            self.follow(location, want)

    def bad(self):
        return sum(n for what, n in self.counts.items() if what.startswith("bad"))

    def report(self):
        return "\n".join(f"{what:42} {n:9}" for what, n in sorted(self.counts.items()))


def folder():
    """Where a server keeps its things while it is measured."""
    return tempfile.mkdtemp(prefix="molmesh-load-")
